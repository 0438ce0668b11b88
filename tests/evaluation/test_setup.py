"""Choices that make no sense together are refused."""

import pytest

from gnio_jax import evaluation
from gnio_jax.evaluation import Setup
from gnio_jax.types import InputError
from tests.support.estimators import CONFIG, LOOSE


def test_setups_that_make_no_sense(walks):
    for setup in (Setup(orientation="reference"), Setup("imu_only", orientation="device")):
        with pytest.raises(InputError, match="leave it out"):
            evaluation.resolve(setup)
    assert (
        evaluation.resolve(Setup()).orientation == "filter"
        and evaluation.resolve(LOOSE).orientation == "reference"
    )
    with pytest.raises(InputError, match="no device orientation"):
        evaluation.prepare(
            [walks[0]._replace(device_orientation=None)],
            CONFIG,
            Setup("integrate", orientation="device"),
        )
