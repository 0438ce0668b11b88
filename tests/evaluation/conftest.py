"""Walks, estimates and reports that the tests of evaluation share."""

import pytest

from gnio_jax.data.simulated import walks as simulated
from tests.support import tiny_run
from tests.support.estimates import estimate, reported
from tests.support.estimators import RATE, TRAINED
from tests.support.trajectories import lost


@pytest.fixture(autouse=True)
def few_dots(monkeypatch):
    """Pictures are drawn in a quarter of the time."""
    monkeypatch.setattr("gnio_jax.drawing.DOTS_PER_INCH", 30)


@pytest.fixture
def no_pictures(monkeypatch):
    """Where there would be pictures, their folder alone is made."""
    monkeypatch.setattr("gnio_jax.evaluation.plots.save_all", lambda folder, *_: folder.mkdir())


@pytest.fixture(scope="session")
def walks():
    """As a filter sees them of one length: none is a fifth shorter than the longest."""
    lengths = {1: 15.0, 2: 14.0, 3: 13.0}
    return [
        simulated.pedestrian(seed, seed, "handheld", seconds, RATE)
        for seed, seconds in lengths.items()
    ]


@pytest.fixture(scope="session")
def clean():
    return simulated.pedestrian(5, 5, "pocket", 15.0, RATE, imu_errors=False)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """The folder of a run of the smallest network."""
    with tiny_run.registry_entry():
        yield tiny_run.save(tmp_path_factory.mktemp("trained") / "run", TRAINED)


@pytest.fixture(scope="session")
def estimates():
    return [
        estimate("room 1/walk", 0),
        estimate("room 1:walk", 1),
        estimate("blind", 2, truth=False),
    ]


@pytest.fixture(scope="session")
def made_report(estimates):
    groups = {estimate.name: estimate.name[:4] for estimate in estimates}
    return reported(estimates, groups, {"blind": ["start: rough"]}, {"short": "0.5 s"})


@pytest.fixture(scope="session")
def with_divergence(estimates):
    """The walks again, the second lost after 20 s, and a third that is whole."""
    second = estimates[1]._replace(trajectory=lost(estimates[1].trajectory, 200))
    walks = [estimates[0], second, estimates[2], estimate("room 3", 3)]
    groups = {"room 1/walk": "A", "room 1:walk": "B", "blind": "C", "room 3": "D"}
    return walks, reported(walks, groups)
