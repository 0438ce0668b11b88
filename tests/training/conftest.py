"""One recording and one network of one shape for all trainings: compiled once."""

import pytest

from gnio_jax.training import loop
from tests.support import tiny_run
from tests.support.tlio_files import write_splits


@pytest.fixture(scope="package", autouse=True)
def registered():
    with tiny_run.registry_entry():
        yield


@pytest.fixture(scope="package")
def recording(tmp_path_factory):
    """A TLIO folder of three short walks."""
    return write_splits(tmp_path_factory.mktemp("tlio"))


@pytest.fixture(scope="package")
def finished(recording, tmp_path_factory):
    """The folder of a run of three epochs that nothing interrupted, and its outcome."""
    workdir = tmp_path_factory.mktemp("finished") / "run"
    return workdir, loop.train(tiny_run.config(recording, workdir))
