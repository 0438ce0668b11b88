"""Existing evaluations are used if they are the requested ones."""

import dataclasses

import pytest

from gnio_jax import config as configuration
from gnio_jax.config import EvaluateConfig
from gnio_jax.evaluation import report, reuse
from gnio_jax.evaluation.folder import read
from gnio_jax.networks.folder import write_weights
from gnio_jax.reporting import Lines
from tests.support.filter_settings import changed
from tests.support.reports import BASE, digest, report_of, write_report, write_run


@pytest.fixture
def run(tmp_path):
    """A run that has learnt from the recordings of a folder."""
    (tmp_path / "data").mkdir()
    config = dataclasses.replace(BASE, data_root=str(tmp_path / "data"))
    write_run(tmp_path / "run")
    configuration.save(tmp_path / "run" / "config.yaml", config)
    return tmp_path / "run"


def evaluation(run, **settings):
    """Write an evaluation of the run; without other settings it is the requested one."""
    all_settings = {
        "dataset": "tlio",
        "data_root": str(run.parent / "data"),
        "weights": digest(run),
        "filter": configuration.to_plain(BASE.filter),
        **settings,
    }
    folder = run / "eval" / f"tlio_test_{settings.get('estimator', 'ekf')}"
    return write_report(folder, report_of({"a": 1.0}, {"a": "x"}, **all_settings))


def find(run, **options):
    return reuse.find_existing(EvaluateConfig(str(run), plots=False, **options))


def test_existing_figures_are_used(run, monkeypatch):
    folder = evaluation(run)
    request = find(run)
    assert (request.folder, request.problem) == (folder, "")
    monkeypatch.setattr(reuse, "evaluate", None)
    assert reuse.load_or_evaluate(request, Lines()) == read(folder)


@pytest.mark.parametrize(
    "settings, problem",
    [
        ({"definitions": report.DEFINITIONS - 1}, "another version"),
        ({"weights": "0" * 64}, "of weights that the network has no more"),
        ({"weights": None}, "of weights that the network has no more"),
        ({"filter": {**configuration.to_plain(BASE.filter), "gravity": 9.0}}, "of another filter"),
        ({"alignment": "se3"}, "of alignment se3"),
    ],
)
def test_figures_with_another_meaning_are_made_again(run, monkeypatch, settings, problem):
    folder = evaluation(run, **settings)
    lines, requests = [], []

    def evaluate(config, progress, workers, **_):
        requests.append(config)
        evaluation(run)

    monkeypatch.setattr(reuse, "evaluate", evaluate)
    monkeypatch.setattr(Lines, "line", lambda self, text: lines.append(text))
    request = find(run)
    assert problem in request.problem and request.report is None
    assert reuse.load_or_evaluate(request, Lines()) == read(folder) and len(requests) == 1
    assert requests[0].filter == BASE.filter and problem in lines[0]
    assert find(run).problem == ""
    (folder / "metrics.json").write_text("{}")
    assert "is not a metrics.json" in find(run).problem


def test_figures_of_a_corrector_that_was_trained_again_are_not_used(run, tmp_path):
    """They have a digest of its weights, unless it comes with the network. A corrector that is gone
    was not trained again. `integrate` has the samples of the corrector, too."""
    corrector = write_run(tmp_path / "airimu")
    settings = dataclasses.replace(BASE.filter, corrector=str(corrector))
    config = configuration.load(run / "config.yaml")
    configuration.save(run / "config.yaml", dataclasses.replace(config, filter=settings))
    plain = configuration.to_plain(settings)
    evaluation(run, estimator="integrate", filter=plain, corrector_weights=digest(corrector))
    evaluation(run, filter=plain, corrector_weights=digest(corrector))
    assert find(run).problem == find(run, estimator="integrate").problem == ""
    write_run(corrector, step=9)
    assert "airimu has no more" in find(run).problem
    assert "airimu has no more" in find(run, estimator="integrate").problem
    evaluation(run, filter=plain, corrector_weights=None)
    assert find(run).problem == ""
    evaluation(run, filter=plain)  # from before the digest was kept
    assert "airimu has no more" in find(run).problem
    (corrector / "config.yaml").unlink()
    assert find(run).problem == ""
    evaluation(run, estimator="integrate", filter={"corrector": "another"})
    assert "of another filter" in find(run, estimator="integrate").problem


def test_figures_of_another_folder_are_never_used(run, tmp_path):
    """A run that was evaluated on A has no figures on B, whatever the names of the recordings. The
    figures of `integrate` have no filter, so its options do not matter."""
    evaluation(run)
    (tmp_path / "other").mkdir()
    request = find(run, data_root=str(tmp_path / "other"))
    assert request.report is None and request.config.data_root == str(tmp_path / "other")
    assert request.folder.name.startswith("tlio_test_ekf_other-")  # the figures of A stay
    (tmp_path / "link").symlink_to(tmp_path / "data")
    assert find(run, data_root=str(tmp_path / "link")).problem == ""
    evaluation(run, estimator="integrate", filter={"gravity": 9.0})
    assert find(run, estimator="integrate").problem == ""


def test_a_filter_that_was_trained_is_that_of_the_weights(run, monkeypatch):
    trained, requests = changed(noise={"gyro_density": 0.5}), []
    write_weights(run, {}, 1, 7, trained)

    def evaluate(config, progress, workers):
        requests.append(config.filter)
        evaluation(run, filter=configuration.to_plain(trained))

    monkeypatch.setattr(reuse, "evaluate", evaluate)
    reuse.load_or_evaluate(find(run), Lines())
    assert requests == [trained] and find(run).problem == ""
