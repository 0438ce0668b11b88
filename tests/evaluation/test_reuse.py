"""Which evaluations that are there may stand for a run."""

import dataclasses

import pytest

from gnio_jax import config as configuration
from gnio_jax.config import EvaluateConfig
from gnio_jax.errors import InputError
from gnio_jax.evaluation import report, reuse
from gnio_jax.evaluation.folder import read
from gnio_jax.reporting import Lines
from gnio_jax.training import checkpoint
from gnio_jax.training.checkpoint import Run
from tests.support.filter_settings import changed
from tests.support.reports import BASE, report_of, write_report, write_run


@pytest.fixture
def run(tmp_path):
    """A run on the recordings of a folder, and what its evaluation says of itself."""
    (tmp_path / "data").mkdir()
    config = dataclasses.replace(BASE, data_root=str(tmp_path / "data"))
    write_run(tmp_path / "run")
    configuration.save(tmp_path / "run" / "config.yaml", config)
    return tmp_path / "run"


def evaluation(run, **settings):
    """As it is when it may stand for the run."""
    own = {
        "dataset": "tlio",
        "data_root": str(run.parent / "data"),
        "step": 7,
        "filter": configuration.plain(BASE.filter),
        **settings,
    }
    folder = run / "eval" / f"tlio_test_{settings.get('estimator', 'ekf')}"
    return write_report(folder, report_of({"a": 1.0}, {"a": "x"}, **own))


def look(run, **options):
    return reuse.find_existing(EvaluateConfig(str(run), plots=False, **options))


def test_what_is_there_is_taken(run, monkeypatch):
    folder = evaluation(run)
    found = look(run)
    assert (found.folder, found.problem) == (folder, "")
    monkeypatch.setattr(reuse, "evaluate", None)
    assert reuse.load_or_evaluate(found, Lines()) == read(folder)
    (run / "checkpoints" / "best" / "7").rmdir()
    with pytest.raises(InputError, match="holds no checkpoint"):
        look(run)


@pytest.mark.parametrize(
    "settings, problem",
    [
        ({"definitions": report.DEFINITIONS - 1}, "another version"),
        ({"step": 6}, "of a checkpoint that the run has no more"),
        ({"filter": {**configuration.plain(BASE.filter), "gravity": 9.0}}, "of another filter"),
        ({"alignment": "se3"}, "of alignment se3"),
    ],
)
def test_what_means_something_else_is_made_anew(run, monkeypatch, settings, problem):
    folder = evaluation(run, **settings)
    lines, made = [], []

    def evaluate(config, progress, workers, **_):
        made.append(config)
        evaluation(run)

    monkeypatch.setattr(reuse, "evaluate", evaluate)
    monkeypatch.setattr(Lines, "line", lambda self, text: lines.append(text))
    found = look(run)
    assert problem in found.problem and found.report is None
    assert reuse.load_or_evaluate(found, Lines()) == read(folder) and len(made) == 1
    assert made[0].filter == BASE.filter and problem in lines[0]
    assert look(run).problem == ""
    (folder / "metrics.json").write_text("{}")
    assert "is not a metrics.json" in look(run).problem


def test_recordings_of_another_folder_are_never_taken(run, tmp_path):
    """A run that was evaluated on A has no figures on B, whatever the recordings are called. Those
    of `integrate` are of no filter: other options mean the same."""
    evaluation(run)
    (tmp_path / "other").mkdir()
    found = look(run, data_root=str(tmp_path / "other"))
    assert found.report is None and found.config.data_root == str(tmp_path / "other")
    assert found.folder.name.startswith("tlio_test_ekf_other-")  # those of A stay where they are
    (tmp_path / "link").symlink_to(tmp_path / "data")
    assert look(run, data_root=str(tmp_path / "link")).problem == ""
    evaluation(run, estimator="integrate", filter={"gravity": 9.0})
    assert look(run, estimator="integrate").problem == ""


def test_a_run_whose_filter_was_trained_is_restored_once(run, monkeypatch):
    config = configuration.load(run / "config.yaml")
    through = dataclasses.replace(config.through_filter, learn=("noise",))
    configuration.save(
        run / "config.yaml", dataclasses.replace(config, through_filter=through, init_from="walks")
    )
    own = Run(dataclasses.replace(config, filter=changed(noise={"gyro_density": 0.5})), *[None] * 4)
    restored, given = [], []
    monkeypatch.setattr(checkpoint, "load_run", lambda *asked: restored.append(asked) or own)

    def evaluate(config, progress, workers, run):
        given.append((config.filter, run))
        evaluation(folder, filter=configuration.plain(own.config.filter))

    folder = run
    monkeypatch.setattr(reuse, "evaluate", evaluate)
    reuse.load_or_evaluate(look(run), Lines())
    assert given == [(own.config.filter, own)] and restored == [(run, "best")]
    assert look(run).run is None  # nothing is left to be made
