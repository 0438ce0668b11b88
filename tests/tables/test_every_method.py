"""Every method of the comparison, from its training to its row."""

import csv
import dataclasses
import os

import numpy as np
import pytest

from gnio_jax import config as configuration
from gnio_jax.config import ModelConfig, TablesConfig
from gnio_jax.reporting import Silence
from gnio_jax.tables import cost, experiments, make
from gnio_jax.training import loop
from tests.support import small_tables
from tests.support.networks import SMALL

METHODS = make.networks(TablesConfig("comparison", methods="all"))
SIBLINGS = {"eqnio_ronin", "imot", "trunk_fourier", "trunk_rep", "trunk_wavelet"}
"""Networks of which another row has all but a part that has its own tests. They run with
GNIO_EVERY_NETWORK=1."""
METHOD = experiments.method
IN_CONFIG = {field.name for field in dataclasses.fields(ModelConfig)}


def smallest(network, base):
    """The row's settings with the smallest options of its network."""
    config = METHOD(network, base)
    if network == "ridi":  # it keeps as many support vectors as it needs
        return config
    options = SMALL[config.model.name.removesuffix("_text")]
    fields = {name: value for name, value in options.items() if name in IN_CONFIG}
    fields |= experiments.SYSTEMS.get(network, experiments.System(network)).options
    others = {name: value for name, value in options.items() if name not in IN_CONFIG}
    return dataclasses.replace(
        config, model=dataclasses.replace(config.model, **fields, options=others)
    )


@pytest.fixture(scope="module")
def base(tmp_path_factory):
    file = tmp_path_factory.mktemp("every_method") / "base.yaml"
    configuration.save(file, small_tables.base(100.0, epochs=1))
    return file


@pytest.mark.slow
@pytest.mark.parametrize("network", METHODS)
def test_a_method_is_trained_calibrated_and_measured_on_the_windows_of_the_base(
    network, base, tmp_path, monkeypatch
):
    if network in SIBLINGS and not os.environ.get("GNIO_EVERY_NETWORK"):
        pytest.skip("takes half a minute; set GNIO_EVERY_NETWORK=1")
    if network == "ridi":
        pytest.importorskip("sklearn", reason="needs gnio-jax[ridi]")
    small_tables.patch(monkeypatch)
    monkeypatch.setattr(experiments, "method", smallest)
    monkeypatch.setattr(cost, "interval_seconds", lambda trained: 1e-3)  # has a test of its own
    options = TablesConfig("comparison", base=str(base), calibrate=True, seeds=1, methods=network)
    options = dataclasses.replace(options, out=tmp_path)
    text = make.make(options, Silence())
    with monkeypatch.context() as finished:
        finished.setattr(loop, "train_all", None)  # nothing is trained again
        assert make.make(options, Silence()) == text
    assert f"| {network} | " in text
    with (tmp_path / "comparison_test_ekf_calibrated.csv").open(encoding="utf-8") as file:
        rows = {row["metric"]: row for row in csv.DictReader(file)}
    assert np.isfinite(float(rows["ate"]["mean"])) and float(rows["nis"]["mean"]) > 0
    assert rows["ate"]["diverged"] == "0" and int(rows["ate"]["parameters"]) > 0
    trained, calibrated = (
        configuration.load(tmp_path / "runs" / f"{network}_s0{ending}" / "config.yaml")
        for ending in ("", "_calibrated")
    )
    name = experiments.SYSTEMS.get(network, experiments.System(network)).network
    assert trained.model == calibrated.model and trained.model.name == name
    noises = (run.filter.noise.measurement_scale for run in (trained, calibrated))
    assert len({*noises}) == 2
