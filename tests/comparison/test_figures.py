"""Figures of runs that are there already."""

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
    settings = {"step": step} | ({} if definitions is None else {"definitions": definitions})
    sequences = {
        "a": {"ate": 1.0, "group": "x"},
        "b": {"ate": 1.0} | ({"group": "y"} if group else {}),
    }
    path.write_text(json.dumps({"settings": settings, "sequences": sequences}))
    monkeypatch.setattr(figures.evaluation, "evaluate", lambda config, **_: path.write_text("{}"))
    found = figures.of_run(tmp_path, "test", "ekf", Lines())
    assert found.folder == path.parent and (found.figures != {}) == kept
