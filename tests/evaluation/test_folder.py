"""The folder of an evaluation: what is written is read back, and divergence is in every file."""

import csv
import json

import numpy as np
import pytest

from gnio_jax import evaluation
from gnio_jax.config import TrainConfig
from gnio_jax.evaluation import Trajectory, folder, page, score
from gnio_jax.evaluation.views import make_view
from tests.support.estimates import SETTINGS, reported


def write(path, report, estimates, plots=False):
    """Write the folder; the result is its metrics.json."""
    folder.write(path, report, estimates, TrainConfig(), plots=plots)

    def strict(constant):
        raise AssertionError(f"{constant} is not JSON")

    return json.loads((path / "metrics.json").read_text(), parse_constant=strict)


def rows(path):
    with open(path / "metrics.csv", newline="") as file:
        return list(csv.DictReader(file))


def test_a_report_is_read_back_as_it_was_written(tmp_path, estimates, made_report, with_divergence):
    report = made_report._replace(placements={"room 1/walk": "in a hand"})
    walks, expected = with_divergence
    write(tmp_path / "a", expected, walks)
    assert evaluation.load(tmp_path / "a") == expected
    content = write(tmp_path / "e", report, estimates)
    assert evaluation.load(tmp_path / "e") == report
    first, _, blind = content["sequences"].values()
    assert first["placement"] == "in a hand" and "placement" not in blind
    assert first["ate"] == report.scores["room 1/walk"].values["ate"]
    assert first["reasons"] == {} and first["infinite"] == [] and first["diverged"] is False
    assert first["accepted"] == pytest.approx(90, abs=0.5) and first["nis"] == 1.0
    assert blind["ate"] is None and blind["reasons"]["ate"] == "no trusted reference"
    assert blind["notes"] == ["start: rough"] and blind["nis"] == 1.0
    ates = [content["sequences"][f"room 1{c}walk"]["ate"] for c in "/:"]
    assert content["mean"]["ate"] == pytest.approx(np.mean(ates))
    assert content["n"]["ate"] == 2 and content["interval"]["ate"] is None
    assert content["interval"]["nis"] is None and content["left_out"] == {"short": "0.5 s"}
    assert content["reference_rows"]["never_moves"]["mean"]["path_length_ratio"] == 0
    lines = rows(tmp_path / "e")
    assert float(lines[0]["ate"]) == first["ate"]
    assert lines[2]["ate"] == "" and lines[2]["sequence"] == "blind"
    trajectories, references = (
        sorted(path.name for path in (tmp_path / "e" / kind).iterdir())
        for kind in ("trajectories", "references")
    )
    assert trajectories == ["blind.txt", "room_1_walk.txt", "room_1_walk_.txt"]
    assert references == trajectories[1:]


def test_a_name_may_have_bytes_that_are_no_text(tmp_path, estimates, made_report):
    """As a file whose name another system has written."""
    names = {estimate.name: f"{estimate.name}\udcff" for estimate in estimates}
    odd = [estimate._replace(name=names[estimate.name]) for estimate in estimates]
    fields = ("scores", "groups", "notes", "placements")
    named = {
        field: {names[name]: value for name, value in getattr(made_report, field).items()}
        for field in fields
    }
    rows = {
        row: {names[name]: measures for name, measures in scores.items()}
        for row, scores in made_report.reference_rows.items()
    }
    recordings = {names[name]: 60.0 for name in made_report.scores}
    settings = made_report.settings | {"recordings": recordings}
    report = made_report._replace(**named, reference_rows=rows, settings=settings)
    write(tmp_path / "odd", report, odd)
    assert evaluation.load(tmp_path / "odd") == report


def test_the_states_hold_all_results_of_the_estimator(tmp_path, estimates):
    walk, summed = estimates[0], estimates[1]._replace(filtered=None, states=None)
    write(tmp_path, reported([walk, summed]), [walk, summed])
    first, second = (np.load(tmp_path / "states" / f"room_1_walk{end}.npz") for end in ("", "_"))
    names = "time position orientation displacement displacement_covariance gate "
    names += "position_covariance nis accepted velocity gyro_bias accel_bias std innovation"
    displacements, gate = walk.displacements, walk.displacements.diagnostics["gate"]
    values = [*walk.trajectory, displacements.value, displacements.covariance, gate]
    values += [*walk.filtered, *walk.states]
    expected = dict(zip(names.split(), values, strict=True))
    assert set(first) == expected.keys() and set(second) == {*list(expected)[:6]}
    for name, values in expected.items():
        np.testing.assert_array_equal(first[name], values)


def test_trajectories_are_read_back_at_the_stamps_of_the_estimate(tmp_path, estimates, made_report):
    whole, rows = estimates[0], np.arange(400)
    holes, ends = (rows >= 20) & (rows < 30), rows >= 390

    def without(trajectory, rows):
        parts = (np.where(rows[:, None], np.nan, part) for part in trajectory[1:])
        return Trajectory(trajectory.time, *parts)

    path, reference = without(whole.trajectory, ends), without(whole.reference, holes)
    walks = [whole._replace(trajectory=path, reference=reference), *estimates[1:]]
    write(tmp_path / "e", made_report, walks)
    first, _, blind = folder.read_estimates(tmp_path / "e", list(made_report.scores))
    assert len(first.trajectory.time) == 390
    np.testing.assert_allclose(first.trajectory.position, path.position[:390], atol=1e-8)
    np.testing.assert_allclose(first.reference.position, reference.position[:390], atol=1e-8)
    assert not blind.reference.known.any() and blind.waypoints is None


def test_divergence_is_in_the_files(tmp_path, with_divergence):
    walks, report = with_divergence
    content = write(tmp_path / "e", report, walks)
    lost = content["sequences"]["room 1:walk"]
    assert lost["ate"] is None and "ate" in lost["infinite"] and lost["diverged"] is True
    assert lost["reasons"]["ate"] == "the estimate is not finite from 20.0 s on"
    groups = {name: fields["group"] for name, fields in content["sequences"].items()}
    assert groups == report.groups
    assert content["diverged"]["ate"] == 1 and content["n"]["ate"] == 2
    ates = [content["sequences"][name]["ate"] for name in ("room 1/walk", "room 3")]
    assert content["mean"]["ate"] == pytest.approx(np.mean(ates))
    assert content["median"]["ate"] == max(ates)  # of two finite and an infinite one
    assert (content["interval"]["ate"], content["groups"]["ate"]) == (None, 2)
    assert [row["ate"] for row in rows(tmp_path / "e")][1:3] == ["inf", ""]
    assert content["reference_rows"]["never_moves"]["diverged"]["ate"] == 0


def test_an_existing_page_is_drawn_again_with_the_new_figures(
    tmp_path, estimates, made_report, no_pictures
):
    path, walks = tmp_path / "e", estimates[:1]
    first = made_report._replace(scores=score(walks))
    write(path, first, walks)
    assert not (path / "report.html").exists() and not (path / "plots").exists()
    write(path, first, walks, plots=True)
    other_walks = [walks[0]._replace(trajectory=estimates[1].trajectory)]
    second = made_report._replace(scores=score(other_walks))
    write(path, second, other_walks)
    ates = [report.scores["room 1/walk"].values["ate"] for report in (first, second)]
    assert f"<td>{ates[1]:.2f}</td>" in (path / "report.html").read_text(encoding="utf-8")
    assert ates[0] != ates[1] and (path / "plots").is_dir()


def test_other_evaluations_of_the_run_are_read_and_shown(
    tmp_path, estimates, made_report, no_pictures
):
    settings = SETTINGS | {"model": "gnio", "checkpoint": "best", "step": 7}
    settings |= {"rate": 100.0, "window_seconds": 1.0, "context_seconds": 0.0}
    summed = {"estimator": "integrate", "coupling": None, "orientation_source": "device"}
    evaluations = {
        "ours": {},
        "summed": summed,
        "again": {},
        "older": {"definitions": 1},
        "other": {"step": 8},
        "another": {"split": "val"},
        "elsewhere": {"data_root": "/elsewhere"},
        "longer": {"recordings": {**SETTINGS["recordings"], "blind": 50.0}},
    }
    for name, changes in evaluations.items():
        report = made_report._replace(settings=settings | changes)
        folder.write(tmp_path / name, report, estimates, TrainConfig(), plots=False)
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "metrics.json").write_text("{")
    others = folder.read_others(tmp_path / "ours", settings)
    assert [*others] == ["again", "integrate, device orientation"]
    first = page.describe_report(*others["again"])
    assert first.figures == {name: measures.values for name, measures in made_report.scores.items()}
    views = {view.name: view for view in first.views}
    whole = make_view(estimates[0])
    np.testing.assert_allclose(views["room 1/walk"].position, whole.position, atol=1e-6)
    np.testing.assert_allclose(views["room 1/walk"].reference, whole.reference, atol=1e-8)
    assert not views["blind"].has_reference and first.remarks[0] == "blind: start: rough"
    assert first.summary["never moves"]["path_length_ratio"] == 0
    write(tmp_path / "ours", made_report._replace(settings=settings), estimates, plots=True)
    text = (tmp_path / "ours" / "report.html").read_text(encoding="utf-8")
    assert all(f">{name}<" in text for name in others)
