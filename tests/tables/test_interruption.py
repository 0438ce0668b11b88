"""A table that Ctrl-C interrupts, again and again."""

import csv
import dataclasses
import importlib
import signal

import pytest

from gnio_jax import config as configuration
from gnio_jax.calibration import run as calibration_run
from gnio_jax.config import TablesConfig
from gnio_jax.reporting import Silence
from gnio_jax.tables import cost, make
from gnio_jax.tables.runs import Interrupted
from tests.support import small_tables, tiny_run


@pytest.fixture
def options(tmp_path, monkeypatch):
    """Two seeds of the smallest network."""
    small_tables.patch(monkeypatch)
    file = tmp_path / "base.yaml"
    configuration.save(file, small_tables.base(50.0, epochs=2))
    with tiny_run.registry_entry():
        yield TablesConfig("comparison", base=str(file), calibrate=True, seeds=2, methods="tiny")


@pytest.fixture(autouse=True)
def ctrl_c():
    """A shell starts what is in the background with Ctrl-C ignored, and Python leaves it so."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def figures(options, out):
    """The lines of the table's CSV, without the times."""
    make.make(dataclasses.replace(options, out=out), Silence())
    with (out / "comparison_test_ekf_calibrated.csv").open(encoding="utf-8") as file:
        return [{**row, "interval_ms": ""} for row in csv.DictReader(file)]


def interrupt(*_, **__):
    signal.raise_signal(signal.SIGINT)


@pytest.mark.slow
def test_an_interrupted_table_continues_and_has_the_figures_of_one_that_was_not(
    options, tmp_path, monkeypatch
):
    """It is interrupted in the training of the second seed, in a calibration, and in an
    evaluation."""
    measured, passes, real = [], [], cost.interval_seconds

    def interval_seconds(trained):
        measured.append(trained.name)
        return real(trained) if len(measured) == 1 else 1e-3

    def interrupt_second_seed():
        passes.append("step 5")
        if len(passes) == 2:
            interrupt()

    monkeypatch.setattr(cost, "interval_seconds", interval_seconds)
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    expected = figures(options, whole)
    with tiny_run.stopped_at(5, interrupt_second_seed), pytest.raises(Interrupted) as stop:
        figures(options, parts)
    assert stop.value.args == (signal.SIGINT,)
    first, second = (parts / "runs" / f"tiny_s{seed}" / "metrics.jsonl" for seed in range(2))
    assert len(first.read_text().splitlines()) == 2
    assert not second.exists() or len(second.read_text().splitlines()) < 2
    trained = first.stat().st_mtime_ns
    evaluation = importlib.import_module("gnio_jax.evaluation.evaluate")
    for module, name in ((calibration_run, "fit_considered"), (evaluation, "score")):
        with monkeypatch.context() as patch:
            patch.setattr(module, name, interrupt)
            with pytest.raises(KeyboardInterrupt):
                figures(options, parts)
    assert figures(options, parts) == expected
    assert first.stat().st_mtime_ns == trained and measured == ["tiny_s0", "tiny_s0"]
    for seed in range(2):
        tiny_run.assert_same_runs(*(out / "runs" / f"tiny_s{seed}" for out in (whole, parts)))
