"""The files of an evaluation parse back, and a broken evaluation leaves none."""

import csv
import json

import numpy as np
import pytest
from rich.console import Console
from scipy.spatial.transform import Rotation

from gnio_jax.evaluation import plots, report
from gnio_jax.evaluation.metrics import Trajectory
from gnio_jax.evaluation.odometry import Estimate, never_moves

SETTINGS = {
    "dataset": "made",
    "split": "test",
    "estimator": "ekf",
    "coupling": "tight",
    "orientation_source": "filter",
    "initial_state": "reference",
    "gyro_bias": "zero",
    "imu_compensated": "no",
    "alignment": "origin",
}


def estimate(name, seed, n=400, truth=True):
    random = np.random.default_rng(seed)
    angle = np.arange(n) * 0.02
    angle[150:220] = angle[150]
    angle[220:] -= angle[220] - angle[150]
    position = np.stack([8 * np.cos(angle), 8 * np.sin(angle), 0.1 * angle], 1)
    orientation = Rotation.from_euler("z", angle[:, None]).as_quat(scalar_first=True)
    time = 1.5e9 + np.arange(n) * 0.1
    reference = Trajectory(time, position if truth else position * np.nan, orientation)
    moved = position + np.cumsum(random.normal(0, 0.03, (n, 3)), 0)
    displacement = np.full((n, 3), np.nan)
    displacement[11:] = np.array([1.6, 0, 0]) + random.normal(0, 0.1, (n - 11, 3))
    spread = 0.03 * np.sqrt(np.arange(n) + 1)
    accepted = np.where(np.arange(n) < 11, np.nan, (np.arange(n) % 10 > 0).astype(float))
    return Estimate(
        name,
        Trajectory(time, moved, orientation),
        reference,
        displacement,
        np.full((n, 3), 0.3),
        {"gate": np.tanh(displacement)},
        std=np.repeat(spread[:, None], 15, 1),
        position_covariance=spread[:, None, None] ** 2 * np.eye(3),
        accepted=accepted,
        nis=np.where(np.isnan(accepted), np.nan, 3.0),
    )


@pytest.fixture(scope="module")
def estimates():
    return [
        estimate("room 1/walk", 0),
        estimate("room 1:walk", 1),
        estimate("blind", 2, truth=False),
    ]


@pytest.fixture(scope="module")
def made(estimates):
    groups = {e.name: e.name[:4] for e in estimates}
    return report.Report(
        SETTINGS,
        report.score(estimates, groups),
        {"never_moves": report.score(never_moves(estimates), groups)},
        {"blind": ["start: rough"]},
        {"short": "0.5 s"},
    )


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
    report.write_tum(tmp_path / "broken.txt", broken)
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
    ours = (
        report.score(estimates[:1], {"room 1/walk": 0}, "none")
        .sequences["room 1/walk"]
        .values["ate"]
    )
    assert ours == pytest.approx(metric.get_statistic(evo.StatisticsType.rmse), rel=1e-7)


def test_table_says_what_matters(made):
    console = Console(width=160, record=True, file=open("/dev/null", "w"))
    console.print(report.table(made))
    text = console.export_text()
    for words in (
        "room 1/walk",
        "ATE 2-D",
        "mean",
        "95 % interval",
        "never_moves",
        "window orientation: filter",
        "initial state: reference",
        "gyro bias: zero",
        "IMU compensated: no",
        "blind: start: rough",
        "left out: short",
        "–",
    ):
        assert words in text
    assert f"{made.scores.summary.mean['ate']:.2f}" in text


@pytest.fixture(scope="module")
def with_divergence(estimates):
    """The walks again, the second lost after 20 s, and a third that is whole."""
    lost = estimates[1].trajectory
    there = np.arange(400)[:, None] < 200
    lost = Trajectory(lost.time, *(np.where(there, part, np.nan) for part in lost[1:]))
    of = [estimates[0], estimates[1]._replace(trajectory=lost), estimates[2], estimate("room 3", 3)]
    groups = {"room 1/walk": "A", "room 1:walk": "B", "blind": "C", "room 3": "D"}
    still = {"never_moves": report.score(never_moves(of), groups)}
    return of, report.Report(SETTINGS, report.score(of, groups), still, {}, {})


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
    assert read["interval"]["ate"] == pytest.approx(sorted(ates))
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
    found = report.Report(SETTINGS, report.score(lost, {lost[0].name: "B"}), {}, {}, {})
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
    found = report.Report(SETTINGS, report.score(of, {e.name: e.name for e in of}), {}, {}, {})
    assert found.scores.diverged == [] and found.scores.summary.count["ate"] == 2
    report.write(tmp_path, found, of)
    read = json.loads((tmp_path / "metrics.json").read_text())
    assert read["mean"]["diverged"] == 0 and read["mean"]["ate"] > 0
    assert read["mean"]["nees"] is None and "too large" in read["undefined"]["nees"]


def test_divergence_is_in_the_table(made, with_divergence):
    def text(of):
        console = Console(width=180, record=True, file=open("/dev/null", "w"))
        console.print(report.table(of))
        return console.export_text().splitlines()

    lines = text(with_divergence[1])
    cells = {line.split("  ")[1].strip(): line.split() for line in lines if line.startswith("  ")}
    assert "mean without 1 diverged" in cells and "mean" not in cells
    assert "1" in cells["diverged"] and cells["room 1:walk"].count("∞") >= 6
    assert any("∞: the estimate diverged" in line for line in lines)
    assert not any("diverged" in line for line in text(made))


@pytest.mark.parametrize("alignment", ["origin", "yaw_position", "se3"])
def test_the_distribution_of_errors_counts_what_diverged(tmp_path, with_divergence, alignment):
    of, found = with_divergence
    figure = plots.error_cdf(of, found._replace(settings=SETTINGS | {"alignment": alignment}))
    left, right = figure.axes
    of_one, of_all = left.get_lines()[1], left.get_lines()[3]
    assert of_one.get_ydata()[-1] == pytest.approx(0.5)  # the lost walk: 200 of 400 samples
    assert of_all.get_label() == "all samples"
    assert of_all.get_ydata()[-1] == pytest.approx(1000 / 1200)
    assert right.get_lines()[0].get_ydata()[-1] == pytest.approx(2 / 3)
    plots.save_all(tmp_path, of, found, 1.0)


def test_an_estimate_lost_before_the_reference_begins_is_drawn(estimates):
    """No row has both, so nothing aligns it: the error is not there, its bounds are."""
    whole, rows = estimates[0], np.arange(400)[:, None]
    path, reference = (
        Trajectory(of.time, *(np.where(there, part, np.nan) for part in of[1:]))
        for of, there in ((whole.trajectory, rows < 5), (whole.reference, rows >= 10))
    )
    figure = plots.position_error(whole._replace(trajectory=path, reference=reference))
    for axes in figure.axes:
        assert np.isnan(axes.get_lines()[0].get_ydata()).all()
        assert np.isfinite(axes.collections[0].get_paths()[0].vertices).all()


def test_a_folder_is_replaced_whole_or_not_at_all(tmp_path):
    folder = tmp_path / "eval" / "result"
    with report.replacing_folder(folder) as new:
        (new / "a").write_text("1")
    with pytest.raises(RuntimeError), report.replacing_folder(folder) as new:
        (new / "a").write_text("2")
        raise RuntimeError
    assert (folder / "a").read_text() == "1" and [p.name for p in folder.parent.iterdir()] == [
        "result"
    ]
    with report.replacing_folder(folder) as new:
        (new / "b").write_text("3")
    assert [p.name for p in folder.iterdir()] == ["b"] and [
        p.name for p in folder.parent.iterdir()
    ] == ["result"]


def test_plots_are_drawn(tmp_path, estimates, made):
    plots.save_all(tmp_path, estimates, made, 1.0)
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {
        "error_cdf.png",
        *(
            f"{stem}_{kind}.png"
            for stem in ("room_1_walk", "room_1_walk_")
            for kind in ("trajectory", "error", "displacement")
        ),
        "blind_trajectory.png",
        "blind_displacement.png",
    }
    assert all((tmp_path / name).read_bytes()[:4] == b"\x89PNG" for name in names)


def test_plots_say_what_they_show(estimates):
    figure = plots.trajectory(estimates[0], 1.234, 1.1)
    (axes,) = figure.axes
    assert (
        "1.23 m" in axes.get_title() and axes.get_aspect() == 1.0 and axes.get_xlabel() == "x (m)"
    )
    reference, path = axes.get_lines()[:2]
    np.testing.assert_array_equal(reference.get_xydata(), estimates[0].reference.position[:, :2])
    np.testing.assert_allclose(
        path.get_xydata()[0], estimates[0].reference.position[0, :2], atol=1e-12
    )

    figure = plots.displacement(estimates[0], 1.0)
    assert [a.get_ylabel() for a in figure.axes] == [
        "speed (m/s)",
        "displacement (m)",
        "gate γ (–)",
    ]
    truth, speed = figure.axes[0].get_lines()[:2]
    assert np.nanmax(truth.get_ydata()) == pytest.approx(1.6, abs=0.02)
    np.testing.assert_allclose(speed.get_xdata(), np.arange(400) * 0.1 - 0.5, atol=1e-6)
    shaded = figure.axes[0].patches
    assert (
        len(shaded) == 1
        and shaded[0].get_x() == pytest.approx(15, abs=0.5)
        and shaded[0].get_width() == pytest.approx(7, abs=1)
    )

    error = plots.position_error(estimates[0])
    band = error.axes[0].collections[0].get_paths()[0].vertices
    assert band[:, 1].max() == pytest.approx(3 * 0.03 * np.sqrt(400))
