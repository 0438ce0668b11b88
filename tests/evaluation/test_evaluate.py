"""The evaluate command from its options to its folder, on a tiny untrained network."""

import dataclasses
import importlib.util
import json
import runpy
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

from gnio_jax import data
from gnio_jax.config import EvaluateConfig
from gnio_jax.evaluation import evaluate, report
from gnio_jax.evaluation.evaluate import folder_name, folder_of, resolve
from gnio_jax.evaluation.reuse import find_existing
from tests.support.estimators import TRAINED, with_waypoints
from tests.support.filter_settings import changed
from tests.support.reports import report_of, write_report

ROOT = Path(__file__).parents[2]


@pytest.fixture
def workdir(trained, tmp_path):
    return Path(shutil.copytree(trained, tmp_path / "run"))


@pytest.fixture
def command(monkeypatch, walks):
    """evaluate.py on two walks and one that is too short: (arguments) -> None."""
    load = data.load
    first = walks[2]._replace(name="short", valid=np.arange(len(walks[2].time)) > 600)

    def short(name, root=None, split="test", workers=1, progress=None, left_out=None):
        is_default = (name, split) == ("synthetic", "test")
        if is_default:
            return [*walks[:2], first]
        return load(name, root, split, left_out=left_out)

    monkeypatch.setattr(data, "load", short)

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["evaluate.py", *map(str, arguments)])
        runpy.run_path(str(ROOT / "evaluate.py"), run_name="__main__")

    return call


def evaluate_run(workdir, **options):
    """An evaluation whose filter runs over two walks at a time, and its metrics.json."""
    options = {"batch_size": 2, "plots": False, **options}
    done = evaluate(EvaluateConfig(str(workdir), **options))
    return done, json.loads((done.folder / "metrics.json").read_text())


def test_end_to_end(workdir, command, capsys, tmp_path):
    command("--network", workdir)
    printed = capsys.readouterr()
    folder = workdir / "eval" / "synthetic_test_ekf"
    assert "\x1b" not in printed.out and printed.err == ""
    assert f"results: {folder}" in printed.out and "never_moves" in printed.out
    content = json.loads((folder / "metrics.json").read_text())
    assert list(content["sequences"]) == ["synthetic_1_handheld", "synthetic_2_handheld"]
    assert list(content["left_out"]) == ["short"]
    settings = content["settings"]
    assert (
        settings["coupling"] == "tight" and settings["epoch"] == 1 and settings["data_root"] is None
    )
    assert settings["filter"]["start"]["velocity"] == 0.7
    assert settings["recordings"]["synthetic_1_handheld"] == pytest.approx(15.0, abs=0.05)
    assert [one["group"] for one in content["sequences"].values()] == ["person 1", "person 2"]
    assert [one["placement"] for one in content["sequences"].values()] == ["handheld"] * 2
    assert content["mean"]["ate"] > 0 and settings["definitions"] == report.DEFINITIONS
    assert content["reference_rows"]["perfect_displacements"]["mean"]["ate"] < 0.1
    assert len(np.loadtxt(folder / "trajectories" / "synthetic_1_handheld.txt")) == 150
    assert len(list((folder / "plots").iterdir())) == 3
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert f"<code>python evaluate.py --network {workdir}</code>" in page
    assert f"page: {folder / 'report.html'}" in printed.out
    command("--network", workdir, "--estimator", "integrate", "--no-plots")
    rerun = ["--rerun", tmp_path / "w.rrd"] if importlib.util.find_spec("rerun") else []
    imu_only = ("--estimator", "imu_only", "--init", "static", "--no-plots", *rerun)
    assert "has learnt from" not in "".join(capsys.readouterr())
    (workdir / "splits.yaml").write_text("train: {synthetic_2_handheld: 1500, other: 1}")
    command("--network", workdir, *imu_only)
    output = "".join(capsys.readouterr())
    assert "the network has learnt from 1 of 3 recordings, e.g. synthetic_2_handheld" in output
    assert (tmp_path / "w.rrd").exists() == bool(rerun)
    names = {p.name for p in (workdir / "eval").iterdir()}
    others = {"synthetic_test_integrate", "synthetic_test_imu_only_static-init"}
    assert names == {"synthetic_test_ekf", *others}
    summed = workdir / "eval" / "synthetic_test_integrate"
    content = json.loads((summed / "metrics.json").read_text())
    settings = content["settings"]
    assert settings["orientation_source"] == "reference" and settings["coupling"] is None
    assert "nis" not in content["mean"] and not (summed / "plots").exists()
    assert not list((workdir / "eval").glob("synthetic_test_i*/report.html"))


def test_walks_with_waypoints_are_evaluated_with_walks_with_poses_and_alone(
    workdir, walks, monkeypatch, no_pictures
):
    posed = walks[:2]
    tapped = [with_waypoints(walk)._replace(name=f"tapped {k}") for k, walk in enumerate(posed)]
    loaded = [*posed, *tapped]
    monkeypatch.setattr(data, "load", lambda *_: loaded)
    done, content = evaluate_run(workdir, plots=True)
    first, _, second, _ = content["sequences"].values()
    assert "ate" in first and "leg_ratio" not in first and "reference" not in content["settings"]
    assert "ate" not in second and second["legs"] == 3 and second["waypoint_rms"] > 0
    assert second["nis"] > 0 and "waypoints, no poses" in second["notes"][0]
    rows = content["reference_rows"]
    assert rows["never_moves"]["mean"]["leg_ratio"] == 0
    assert [*rows["perfect_displacements"]["sequences"]] == [walk.name for walk in posed]
    assert "at waypoints" in (done.folder / "report.html").read_text(encoding="utf-8")
    taps = sorted(path.name for path in (done.folder / "waypoints").iterdir())
    assert taps == ["tapped_0.txt", "tapped_1.txt"]

    loaded[:] = tapped
    alone, _ = evaluate_run(workdir, estimator="imu_only")
    assert alone.report.settings["reference"] == "waypoints"
    assert alone.report.settings["initial_state"] == "static"
    assert list(alone.report.reference_rows) == ["never_moves"]


def test_a_damaged_recording_does_not_end_an_evaluation(workdir, command, walks, tmp_path, capsys):
    """The table, the page and the last line name it, and the table has the reason."""
    root = tmp_path / "own"
    for name, walk in zip("abcd", (*walks, walks[0]), strict=True):
        data.write_hdf5(root / f"{name}.h5", walk)
    for name in "cd":
        damaged = root / f"{name}.h5"
        damaged.write_bytes(damaged.read_bytes()[:5000])
    command("--network", workdir, "--dataset", "csv", "--data-root", root)
    printed = capsys.readouterr()
    reason = f"{damaged.with_name('c.h5')}: cannot be read as HDF5, it may be cut short"
    table = " ".join(printed.out.split())
    assert f"left out: c: {reason}" in table and "left out: d: " in table
    last = printed.out.splitlines()[-1]
    assert last.startswith("warning: 2 of 4 recordings were left out: c, d (the reasons are")
    assert f"warning: c: left out: {reason}" in printed.err
    folder = workdir / "eval" / "csv_test_ekf"
    content = json.loads((folder / "metrics.json").read_text())
    assert list(content["sequences"]) == ["a", "b"] and list(content["left_out"]) == ["c", "d"]
    assert content["left_out"]["c"].startswith(reason)
    assert "cannot be read as HDF5" in (folder / "report.html").read_text(encoding="utf-8")
    assert list(content["settings"]["contents"]) == ["a", "b", "c", "d"]


def test_figures_are_of_recordings_and_not_of_a_folder(workdir, walks, tmp_path):
    """Other recordings of the same names are evaluated anew; files that were only copied are the
    same ones."""
    root = tmp_path / "own"
    for name, walk in zip("ab", walks, strict=False):
        data.write_hdf5(root / f"{name}.h5", walk)
    options = {"dataset": "csv", "data_root": str(root)}
    evaluate_run(workdir, **options)
    request = EvaluateConfig(str(workdir), plots=False, **options)
    assert find_existing(request).problem == ""
    (root / "a.h5").touch()
    assert find_existing(request).problem == ""
    data.write_hdf5(root / "a.h5", walks[2])
    expected = f"its figures are of other recordings: recording a in {root} has changed since"
    assert find_existing(request).problem == expected
    evaluate_run(workdir, **options)
    assert find_existing(request).problem == ""


class Reached(Exception):
    """The stage that a test looks at."""


@pytest.mark.parametrize(
    "choice, least",
    [
        ({"coupling": "loose", "set": ("filter.raw_gyro_bias=0.02",)}, np.exp(-4.0)),
        (
            {
                "estimator": "integrate",
                "filter": dataclasses.replace(TRAINED.filter, raw_gyro_bias=0.02),
            },
            0.0,
        ),
    ],
)
def test_uncertainties_of_the_filter_reach_the_stages(workdir, walks, monkeypatch, choice, least):
    """These are the start, a raw gyro, and the smallest standard deviation of a displacement, which
    is 0 if displacements are summed."""
    module, arguments = sys.modules[evaluate.__module__], {}
    original = module.prepare

    def prepare(sequences, windows, ekf, **how):
        arguments.update(ekf=ekf)
        return original(sequences, windows, ekf, **how)

    def infer(*_, **how):
        arguments.update(how)
        raise Reached

    monkeypatch.setattr(module, "prepare", prepare)
    monkeypatch.setattr(module, "infer", infer)
    monkeypatch.setattr(data, "load", lambda *_: walks[:1])
    with pytest.raises(Reached):
        evaluate(EvaluateConfig(str(workdir), **choice))
    assert arguments["ekf"].start.velocity == 0.7 and arguments["ekf"].raw_gyro_bias == 0.02
    assert arguments.get("least_std", 0.0) == pytest.approx(least)


@pytest.mark.usefixtures("trained")
def test_the_name_of_a_folder_has_the_choices():
    slower = changed(TRAINED.filter, start={"velocity": 0.5})
    loose = {"coupling": "loose", "orientation": "device", "init": "static"}
    summed = {"estimator": "integrate", "orientation": "filter", "gyro_bias": "rest"}
    for options, name in (
        ({"orientation": "filter"}, "ekf"),
        ({"coupling": "loose", "orientation": "reference"}, "ekf_loose"),
        (loose, "ekf_loose_device-orientation_static-init"),
        (summed, "integrate_filter-orientation_rest-bias"),
        # A sum of displacements has no filter, but the corrector's samples.
        ({**summed, "filter": slower}, "integrate_filter-orientation_rest-bias"),
        (
            {**summed, "filter": dataclasses.replace(slower, corrector="a/b")},
            "integrate_filter-orientation_rest-bias_corrector-a-b",
        ),
        (
            {"filter": slower, "alignment": "se3", "checkpoint": "latest"},
            "ekf_se3-alignment_latest_start.velocity-0.5",
        ),
    ):
        config = resolve(EvaluateConfig("w", **options), TRAINED)
        assert folder_name(config, TRAINED) == f"synthetic_test_{name}"


@pytest.mark.usefixtures("trained")
def test_a_folder_of_many_choices_has_a_name_that_a_file_system_takes(tmp_path):
    root = tmp_path / ("ä" * 100) / ("ö" * 120)
    root.mkdir(parents=True)
    car = "filter.measurements.nonholonomic"
    numbers = ("lateral_std", "vertical_std", "yaw", "pitch", "roll", "lever_x", "lever_z")
    folders = []
    for last in (0.1, 0.2):
        words = tuple(f"{car}.{number}=0.123456" for number in numbers)
        words = (*words, "filter.start.tilt=0.0123", f"filter.start.accel_bias={last}")
        options = EvaluateConfig("w", dataset="csv", data_root=str(root), set=words)
        config = resolve(options, TRAINED)
        folder = folder_of(tmp_path / "run", config, TRAINED)
        write_report(folder, report_of({"a": 1.0}, {"a": "x"}, data_root="another", definitions=1))
        folders += [folder, folder_of(tmp_path / "run", config, TRAINED)]
    assert len(set(folders)) == 4
    for folder in folders:
        assert folder.name.startswith("csv_test_ekf_") and len(folder.name.encode()) < 230


@pytest.mark.usefixtures("trained")
def test_figures_of_other_recordings_keep_their_folder(tmp_path, monkeypatch):
    roots = [tmp_path / name / "csv" for name in "ABC"]
    for root in roots:
        root.mkdir(parents=True)

    def evaluated(**evaluate_run):
        config = resolve(EvaluateConfig("w", dataset="csv", **evaluate_run), TRAINED)
        folder = folder_of(tmp_path / "run", config, TRAINED)
        of = {"data_root": config.data_root, "definitions": 1}  # of an older version, too
        return write_report(folder, report_of({"a": 1.0}, {"a": "x"}, **of))

    folders = [evaluated(data_root=str(root)) for root in roots]
    assert folders[0].name == "csv_test_ekf" and len(set(folders)) == 3
    assert all(folder.name.startswith("csv_test_ekf_csv-") for folder in folders[1:])
    monkeypatch.chdir(tmp_path)
    for folder, root in zip(folders, roots, strict=True):
        assert evaluated(data_root=f"A/../{root.relative_to(tmp_path)}") == folder
        monkeypatch.setenv("GNIO_DATA", str(root.parent))
        assert evaluated() == folder
    shutil.rmtree(folders[0])
    assert evaluated(data_root=str(roots[1])) == folders[1]  # its figures stand in one place
    assert resolve(EvaluateConfig("w", data_root="A"), TRAINED).data_root is None  # it is computed


def test_options_default_to_those_of_the_run():
    config = resolve(EvaluateConfig("w", set=("filter.noise.measurement_scale=3",)), TRAINED)
    assert config.dataset == "synthetic" and config.orientation == "filter"
    assert config.filter == changed(TRAINED.filter, noise={"measurement_scale": 3.0})
    assert resolve(EvaluateConfig("w", coupling="loose"), TRAINED).orientation == "reference"
    settings = changed(start={"velocity": 0.2})
    assert resolve(EvaluateConfig("w", filter=settings), TRAINED).filter == settings


def test_mistakes_are_one_line_and_leave_nothing(workdir, command, capsys):
    for arguments, words in (
        (["--set", "workdir=B"], "--set workdir=B: is not a setting of the filter; write"),
        (["--orientation", "device"], "leave it out"),
        (["--checkpoint", "latest"], "holds no checkpoint"),
        (["--network", "/"], "holds no network"),
    ):
        with pytest.raises(SystemExit) as leaving:
            command("--network", workdir, *arguments)
        printed = capsys.readouterr()
        assert leaving.value.code == 2 and printed.out == ""
        assert printed.err.count("\n") == 1 and words in printed.err
        assert not (workdir / "eval").exists()
