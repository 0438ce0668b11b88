"""How long a table says that it will take."""

import dataclasses
from pathlib import Path

import pytest

from gnio_jax.config import ModelConfig, OptimConfig, TrainConfig
from gnio_jax.reporting import Lines
from gnio_jax.tables import duration, runs
from gnio_jax.tables.experiments import TableRow
from tests.support import tiny_run, tlio_files
from tests.support.reports import write_log


def test_the_time_is_that_of_a_step_for_all_steps_of_the_epochs_that_are_left(
    tmp_path, monkeypatch, capsys
):
    config = TrainConfig(model=ModelConfig("tlio", width=4), optim=OptimConfig(epochs=40))
    rows = [TableRow("a", "a", config), TableRow("b", "b", config)]
    rows.append(TableRow("c", "c", dataclasses.replace(config, model=ModelConfig("ridi"))))
    states = {"a_s0": "finished", "a_s1": "begun"}
    monkeypatch.setattr(runs, "run_state", lambda run: states.get(Path(run.workdir).name, "new"))
    monkeypatch.setattr(duration, "training_seconds", lambda config: 3000.0)
    (tmp_path / "runs" / "a_s1").mkdir(parents=True)
    write_log(tmp_path / "runs" / "a_s1", 10)
    assert duration.announce(rows, tmp_path, 2, Lines()) == 0.75 * 3000.0 + 6000.0
    assert "about 2 h 18 min (a 38 min, b 100 min, c without steps)" in capsys.readouterr().err
    monkeypatch.setattr(runs, "run_state", lambda run: "finished")
    assert duration.announce(rows, tmp_path, 2, Lines()) is None


def test_a_step_is_measured_on_the_recordings_themselves(tmp_path, monkeypatch):
    root = tlio_files.write_splits(tmp_path / "data")
    clock = iter([0.0, 100.0, 200.0, 206.0])  # the first step compiles
    monkeypatch.setattr(duration.time, "perf_counter", lambda: next(clock))
    with tiny_run.registry_entry():
        config = tiny_run.config(root, tmp_path / "run", epochs=3)
        seconds = duration.training_seconds(config)
    assert seconds == pytest.approx(6.0 / 3 * tiny_run.STEPS * 3)


def test_words_of_durations():
    assert [duration.spell(x) for x in (40.0, 720.0, 12_000.0)] == ["40 s", "12 min", "3 h 20 min"]
