"""Figures of runs that are there already."""

import dataclasses
import json

import pytest

from gnio_jax import config as configuration
from gnio_jax.comparison import figures
from gnio_jax.evaluation import report
from gnio_jax.reporting import Lines
from tests.support.tables import BASE


@pytest.mark.parametrize(
    "definitions, group, step, kept",
    [
        (report.DEFINITIONS, True, 7, True),
        (1, True, 7, False),
        (report.DEFINITIONS + 1, True, 7, False),
        (None, True, 7, report.DEFINITIONS == 2),
        (None, False, 7, False),
        (report.DEFINITIONS, True, 6, False),
    ],
)
def test_figures_of_other_definitions_or_steps_are_made_anew(
    tmp_path, monkeypatch, definitions, group, step, kept
):
    configuration.save(tmp_path / "config.yaml", BASE)
    (tmp_path / "checkpoints" / "best" / "7").mkdir(parents=True)
    path = tmp_path / "eval" / "tlio_test_ekf" / "metrics.json"
    path.parent.mkdir(parents=True)
    settings = {"step": step, "dataset": "tlio", "split": "test"} | (
        {} if definitions is None else {"definitions": definitions}
    )
    sequences = {
        "a": {"ate": 1.0, "group": "x"},
        "b": {"ate": 1.0} | ({"group": "y"} if group else {}),
    }
    found = {"settings": settings, "sequences": sequences, "mean": {"ate": 1.0, "diverged": 0}}
    path.write_text(json.dumps(found))
    monkeypatch.setattr(figures.evaluation, "evaluate", lambda *given: path.write_text("{}"))
    found = figures.of_run(tmp_path, "test", "ekf", Lines())
    assert found.folder == path.parent and (found.figures != {}) == kept


def test_figures_of_another_filter_or_damaged_ones_are_made_anew(tmp_path, monkeypatch):
    configuration.save(tmp_path / "config.yaml", BASE)
    (tmp_path / "checkpoints" / "best" / "7").mkdir(parents=True)
    path = tmp_path / "eval" / "tlio_test_ekf" / "metrics.json"
    path.parent.mkdir(parents=True)
    options = configuration.plain(BASE.filter)
    whole = {
        "settings": {
            "dataset": "tlio",
            "split": "test",
            "definitions": report.DEFINITIONS,
            "filter": options,
        },
        "sequences": {"a": {"ate": 1.0, "group": "x", "notes": ["it began while it moved"]}},
        "mean": {"ate": 1.0, "diverged": 0},
    }
    made = []

    def evaluate(*given):
        made.append(given)
        path.write_text(json.dumps(whole))

    monkeypatch.setattr(figures.evaluation, "evaluate", evaluate)
    other = {**whole, "settings": {**whole["settings"], "filter": {**options, "gravity": 9.0}}}
    elsewhere = {**whole, "settings": {**whole["settings"], "split": "val"}}
    texts = [
        json.dumps(other),
        json.dumps(elsewhere),
        json.dumps(whole)[:40],
        "{}",
        "[]",
        json.dumps({**whole, "mean": {}}),
        json.dumps({**whole, "sequences": {"a": {"ate": "1.0", "group": "x"}}}),
        json.dumps({**whole, "sequences": {"a": {"ate": float("nan"), "group": "x"}}}),
    ]
    for number, text in enumerate(texts):
        path.write_text(text)
        found = figures.of_run(tmp_path, "test", "ekf", Lines())
        assert found.figures == whole and len(made) == number + 1
    assert figures.of_run(tmp_path, "test", "ekf", Lines()).figures == whole
    assert len(made) == len(texts)


def test_integrate_takes_no_filter_and_pictures_are_drawn_anew(tmp_path, monkeypatch):
    """An evaluation of `integrate` with other options of the filter means the same."""
    configuration.save(tmp_path / "config.yaml", BASE)
    (tmp_path / "checkpoints" / "best" / "7").mkdir(parents=True)
    folder = tmp_path / "eval" / "tlio_test_integrate"
    (folder / "plots").mkdir(parents=True)
    options = {**dataclasses.asdict(BASE.filter), "gravity": 9.0}
    whole = {
        "settings": {
            "dataset": "tlio",
            "split": "test",
            "definitions": report.DEFINITIONS,
            "filter": options,
        },
        "sequences": {"a": {"ate": 1.0, "group": "x"}},
        "mean": {"ate": 1.0, "diverged": 0},
    }
    (folder / "metrics.json").write_text(json.dumps(whole))
    assert figures.missing(tmp_path, "test", "integrate") is None
    whole["settings"]["step"] = 6
    (folder / "metrics.json").write_text(json.dumps(whole))
    drawn, lines = [], []
    monkeypatch.setattr(
        figures.evaluation, "evaluate", lambda config, *given: drawn.append(config.plots)
    )
    monkeypatch.setattr(Lines, "line", lambda self, text: lines.append(text))
    figures.of_run(tmp_path, "test", "integrate", Lines())
    assert drawn == [True] and lines[0].endswith("is of a checkpoint that the run has no more")
