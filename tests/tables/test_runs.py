"""Runs that are there already."""

import dataclasses
import errno
import shutil
from types import SimpleNamespace

import pytest

from gnio_jax import config as configuration
from gnio_jax.config import CalibrateConfig
from gnio_jax.errors import InputError
from gnio_jax.networks.folder import read_settings
from gnio_jax.reporting import Lines
from gnio_jax.tables import runs
from gnio_jax.training import checkpoint
from tests.support import tiny_run, tlio_files
from tests.support.reports import BASE, digest, write_log, write_run


def test_a_calibration_is_of_the_best_weights_and_warns(tmp_path, monkeypatch, capsys):
    run, configs = tmp_path / "gnio_s0", []

    def calibrate(config, workers):
        configs.append(config)
        shutil.copytree(config.network, config.out)
        return SimpleNamespace(warnings=("larger errors",))

    monkeypatch.setattr(runs.calibration, "calibrate", calibrate)
    write_run(run)
    for _ in range(2):
        assert runs.calibrate_run(run, Lines()) == tmp_path / "gnio_s0_calibrated"
    expected = ["calibrating gnio_s0", "warning: gnio_s0_calibrated: larger errors"]
    assert capsys.readouterr().err.splitlines() == expected
    assert configs == [CalibrateConfig(str(run), out=str(tmp_path / "gnio_s0_calibrated"))]
    # The run goes on and finds better weights: what was fitted to the old ones is replaced.
    write_run(run, step=9)
    runs.calibrate_run(run, Lines())
    assert len(configs) == 2 and digest(tmp_path / "gnio_s0_calibrated") == digest(run)


def test_a_run_that_cannot_be_calibrated_is_measured_as_it_is(tmp_path, monkeypatch, capsys):
    """And the other rows of the table go on."""

    def calibrate(config, workers):
        raise InputError("the filter", "is not healthy")

    monkeypatch.setattr(runs.calibration, "calibrate", calibrate)
    run = tmp_path / "gnio_s0"
    write_run(run)
    assert runs.calibrate_run(run, Lines()) == run
    line = "warning: gnio_s0 is measured without calibration: the filter: is not healthy"
    assert line in capsys.readouterr().err.splitlines()


@pytest.mark.parametrize("rows, state", [(0, "begun"), (39, "begun"), (40, "finished")])
def test_a_run_is_finished_with_its_last_epoch(tmp_path, rows, state):
    config = dataclasses.replace(BASE, dataset="synthetic", workdir=str(tmp_path / "gnio_s0"))
    assert BASE.optim.epochs == 40 and runs.run_state(config) == "new"
    write_run(tmp_path / "gnio_s0")
    configuration.save(tmp_path / "gnio_s0" / "config.yaml", config)
    if rows:
        write_log(tmp_path / "gnio_s0", rows)
    assert runs.run_state(config) == state


def test_a_run_whose_last_weights_were_not_written_is_begun(tmp_path, monkeypatch):
    """Its disk was full at the end. It is resumed, and then it is finished."""
    root = tlio_files.write_splits(tmp_path / "data")
    config, real = tiny_run.config(root, tmp_path / "run", epochs=2), checkpoint.write_weights

    def write_weights(folder, variables, epoch, step, settings=None):
        if epoch == 2:
            raise OSError(errno.ENOSPC, "no space", str(folder))
        real(folder, variables, epoch, step, settings)

    with tiny_run.registry_entry():
        with monkeypatch.context() as patch, pytest.raises(OSError, match="no space"):
            patch.setattr(checkpoint, "write_weights", write_weights)
            runs.loop.train(config)
        assert runs.run_state(config) == "begun"
        runs.loop.train(config, resume=True)
        assert runs.run_state(config) == "finished"
    assert [row["epoch"] for row in tiny_run.rows(tmp_path / "run")] == [0, 1]
    assert read_settings(tmp_path / "run").epoch == 2


def test_a_run_of_other_recordings_is_refused(tmp_path, monkeypatch):
    """Its settings are the same, and so may be the names of the recordings."""
    for name in ("A", "B"):
        (tmp_path / name).mkdir()
    workdir = tmp_path / "gnio"
    config = dataclasses.replace(BASE, data_root=str(tmp_path / "A"), workdir=str(workdir))
    (seed_config,) = configuration.with_seeds(config, [0])
    write_run(tmp_path / "gnio_s0")
    configuration.save(tmp_path / "gnio_s0" / "config.yaml", seed_config)
    write_log(tmp_path / "gnio_s0", BASE.optim.epochs)
    monkeypatch.setattr(runs.loop, "train_all", None)
    runs.train(config, [0], Lines())
    other = dataclasses.replace(config, data_root=str(tmp_path / "B"))
    with pytest.raises(InputError, match=r"was trained on the recordings of .*A, not of .*B"):
        runs.train(other, [0], Lines())
