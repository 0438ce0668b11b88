"""The files of an evaluation parse back, and keep what diverged apart."""

import csv
import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax.evaluation import report, score
from gnio_jax.evaluation.trajectory import write_tum
from tests.support.estimates import SETTINGS


def test_files_parse_back(tmp_path, estimates, made):
    report.write(tmp_path, made, estimates)

    def strict(constant):
        raise AssertionError(f"{constant} is not JSON")

    found = json.loads((tmp_path / "metrics.json").read_text(), parse_constant=strict)
    assert found["sequences"].keys() == {"room 1/walk", "room 1:walk", "blind"}
    first = found["sequences"]["room 1/walk"]
    assert (
        first["ate"] == made.scores.sequences["room 1/walk"].values["ate"]
        and "undefined" not in first
    )
    assert first["accepted"] == pytest.approx(90, abs=0.5) and first["nis"] == 1.0
    blind = found["sequences"]["blind"]
    assert (
        blind["ate"] is None
        and blind["undefined"]["ate"] == "no trusted reference"
        and blind["notes"] == ["start: rough"]
    )
    assert blind["nis"] == 1.0
    assert found["mean"]["ate"] == pytest.approx(
        np.mean([found["sequences"][f"room 1{c}walk"]["ate"] for c in "/:"])
    )
    assert (
        found["n"]["ate"] == 2
        and found["interval"]["ate"] is None
        and len(found["interval"]["nis"]) == 2
    )
    assert found["settings"]["orientation_source"] == "filter" and found["left_out"] == {
        "short": "0.5 s"
    }
    assert found["reference_rows"]["never_moves"]["mean"]["path_length_ratio"] == 0

    with open(tmp_path / "metrics.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert (
        float(rows[0]["ate"]) == first["ate"]
        and rows[2]["ate"] == ""
        and rows[2]["sequence"] == "blind"
    )


def test_tum_files(tmp_path, estimates, made):
    report.write(tmp_path, made, estimates)
    files = sorted(path.name for path in (tmp_path / "trajectories").iterdir())
    assert files == ["blind.txt", "room_1_walk.txt", "room_1_walk_.txt"]
    assert sorted(path.name for path in (tmp_path / "references").iterdir()) == files[1:]
    rows = np.loadtxt(tmp_path / "trajectories" / "room_1_walk.txt")
    path = estimates[0].trajectory
    np.testing.assert_allclose(rows[:, 0], path.time, rtol=0, atol=1e-6)
    np.testing.assert_allclose(rows[:, 1:4], path.position, atol=1e-9)
    turns = Rotation.from_quat(rows[:, 4:]), Rotation.from_quat(path.orientation, scalar_first=True)
    np.testing.assert_allclose(turns[0].as_matrix(), turns[1].as_matrix(), atol=1e-8)
    broken = path._replace(position=np.where(np.arange(400)[:, None] < 390, path.position, np.nan))
    write_tum(tmp_path / "broken.txt", broken)
    assert np.loadtxt(tmp_path / "broken.txt").shape == (390, 8)


def test_evo_reads_the_trajectories(tmp_path, estimates, made):
    pytest.importorskip("evo.core.metrics")
    from evo.core import metrics as evo
    from evo.tools import file_interface

    report.write(tmp_path, made, estimates)
    pair = [
        file_interface.read_tum_trajectory_file(tmp_path / kind / "room_1_walk.txt")
        for kind in ("references", "trajectories")
    ]
    metric = evo.APE(evo.PoseRelation.translation_part)
    metric.process_data(tuple(pair))
    ours = score(estimates[:1], {"room 1/walk": 0}, "none").sequences["room 1/walk"].values["ate"]
    assert ours == pytest.approx(metric.get_statistic(evo.StatisticsType.rmse), rel=1e-7)


def test_divergence_is_in_the_files(tmp_path, with_divergence):
    of, found = with_divergence
    report.write(tmp_path, found, of)
    read = json.loads((tmp_path / "metrics.json").read_text())
    lost = read["sequences"]["room 1:walk"]
    assert lost["ate"] is None
    assert lost["undefined"]["ate"] == "the estimate is not finite from 20.0 s on"
    assert {name: one["group"] for name, one in read["sequences"].items()} == found.scores.groups
    assert read["mean"]["diverged"] == 1 and read["diverged"]["ate"] == 1 and read["n"]["ate"] == 2
    ates = [read["sequences"][name]["ate"] for name in ("room 1/walk", "room 3")]
    assert read["mean"]["ate"] == pytest.approx(np.mean(ates))
    assert read["median"]["ate"] == max(ates)  # of two finite and an infinite one
    middle, reach = np.mean(ates), 12.7062 * np.ptp(ates) / 2  # t of one degree of freedom
    assert read["interval"]["ate"] == pytest.approx([middle - reach, middle + reach], rel=1e-4)
    assert read["groups"]["ate"] == 2
    values = {name: report.read_metric(one, "ate") for name, one in read["sequences"].items()}
    assert values == {name: m.values["ate"] for name, m in found.scores.sequences.items()}
    assert values["room 1:walk"] == np.inf and values["blind"] is None
    with open(tmp_path / "metrics.csv", newline="") as file:
        assert [row["ate"] for row in csv.DictReader(file)][1:3] == ["inf", ""]
    assert read["reference_rows"]["never_moves"]["mean"]["diverged"] == 0


def test_every_column_is_of_the_same_sequences(with_divergence):
    """The lost walk is in no mean, not even with its coverage, what was accepted or its path."""
    _, found = with_divergence
    summary, sequences = found.scores.summary, found.scores.sequences
    for name in ("nees_coverage", "nis_coverage", "accepted", "path_length", "duration", "ate"):
        values = [sequences[walk].values[name] for walk in ("room 1/walk", "blind", "room 3")]
        there = [value for value in values if value is not None]
        assert summary.mean[name] == pytest.approx(np.mean(there)) and summary.count[name] == len(
            there
        )
        assert summary.diverged[name] == 1


def test_every_estimate_lost_has_a_reason_for_every_mean(tmp_path, with_divergence):
    lost = [with_divergence[0][1]]
    found = report.Report(SETTINGS, score(lost, {lost[0].name: "B"}), {}, {}, {})
    report.write(tmp_path, found, lost)
    read = json.loads((tmp_path / "metrics.json").read_text())
    assert all(value is None for name, value in read["mean"].items() if name != "diverged")
    assert read["undefined"].keys() == read["mean"].keys() - {"diverged"}
    assert read["undefined"]["path_length"] == "no estimate that did not diverge"


def test_a_bad_covariance_is_no_divergence(tmp_path, estimates):
    """Its trajectory stays in the means; only its NEES is infinite."""
    bad = estimates[0].position_covariance.copy()
    bad[200:] = np.nan
    of = [estimates[0]._replace(position_covariance=bad), estimates[1]]
    found = report.Report(SETTINGS, score(of, {e.name: e.name for e in of}), {}, {}, {})
    assert found.scores.diverged == [] and found.scores.summary.count["ate"] == 2
    report.write(tmp_path, found, of)
    read = json.loads((tmp_path / "metrics.json").read_text())
    assert read["mean"]["diverged"] == 0 and read["mean"]["ate"] > 0
    assert read["mean"]["nees"] is None and "not positive definite" in read["undefined"]["nees"]
