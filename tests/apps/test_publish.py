"""Publishing a network: its card, and the commands around it."""

import json
import math
import os
import shutil

import pytest

from gnio_jax.apps import publish as publishing
from gnio_jax.apps.publish import describe_data, describe_error, publish
from gnio_jax.errors import InputError
from gnio_jax.evaluation import report
from gnio_jax.evaluation.metrics import Measures
from gnio_jax.networks import find, read_network
from gnio_jax.networks.folder import read_card, read_text
from tests.support import tiny_run
from tests.support.reports import write_report

SETTINGS = {"dataset": "synthetic", "split": "test", "estimator": "ekf", "alignment": "origin"}
SETTINGS |= {"recordings": dict.fromkeys("abcd", 60.0), "filter": {}}
SETTINGS["definitions"] = report.DEFINITIONS
SCORES = {
    name: Measures(
        {"ate_2d": error, "yaw_rmse": None, "duration": 60.0},
        {"yaw_rmse": "no reference"},
        error > 9,
    )
    for name, error in (("a", 1.2), ("b", 1.3), ("c", 99.0), ("d", math.inf))
}
MEASURED = "typical error 1.25 m (2 groups) on walks of 60 s (synthetic_test_ekf; in a pocket 1.2; "
MEASURED += "in a hand 1.3)"
"""Two diverged."""
SAID = ("simulated walks", "CC0", ("Running | jumping.",))


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run of the smallest network, with the figures of one evaluation."""
    with tiny_run.registry_entry():
        folder = tiny_run.save(tmp_path_factory.mktemp("trained") / "walk", tiny_run.CONFIGURED)
        evaluation = folder / "eval" / "synthetic_test_ekf"
        evaluation.mkdir(parents=True)
        groups = {"a": "ann", "b": "bob", "c": "ann", "d": "bob"}
        carried = {"a": "in a pocket", "b": "in a hand", "c": "in a hand", "d": "in a hand"}
        settings = SETTINGS | {"weights": read_network(folder).digest}
        figures = report.Report(settings, SCORES, {}, groups, {}, {}, carried)
        (evaluation / "metrics.json").write_text(json.dumps(report.as_json(figures)))
        yield folder


@pytest.fixture(scope="module")
def published(run, tmp_path_factory):
    """A folder of published networks: `walk`, and `small.zip`."""
    folder = tmp_path_factory.mktemp("networks")
    publish(run, folder / "walk", "walk", *SAID)
    publish(run, folder / "small.zip", "small", *SAID)
    return folder


def test_the_card_has_what_the_publisher_and_the_evaluations_say(published, run, tmp_path):
    """Also of walks with waypoints, and to what the filter was fitted: by the network itself, or by
    another one whose filter it has taken over."""
    card = read_text(published / "walk")
    for words in (
        "Trained on: simulated walks",
        "- Running | jumping.",
        "gnio train --config config.yaml --workdir runs/walk --init-from runs/earlier "
        "--set data.poses_by=runs/first",
        "covariance of the filter: scale.",
        "| synthetic_test_ekf | 4 | 2 | 1.25 (2 groups) |",
    ):
        assert words in card
    assert "calibrate" not in card and "fitted" not in card
    assert publishing._shorten("/home/some body/first run") == "'runs/first run'"
    copy = shutil.copytree(run, tmp_path / "walk_calibrated")
    legs = [{"leg_ratio": ratio, "waypoint_rms": 2.0} for ratio in (0.75, 0.85, 0.75, 0.85)]
    scores = {name: Measures(leg, {}, False) for name, leg in zip("abcd", legs, strict=True)}
    settings = SETTINGS | {"weights": read_network(run).digest}
    figures = report.Report(settings, scores, {}, {name: name for name in scores}, {}, {})
    write_report(copy / "eval" / "mall_test_ekf", figures)
    for calibrated, shown in (("runs/half", "half"), ("walk", "walk"), ("other/run", "run")):
        (copy / "calibration.json").write_text(json.dumps({"run": calibrated, "split": "val"}))
        publish(copy, tmp_path / "package", "walk", *SAID)
        card = read_text(tmp_path / "package")
        assert f"gnio calibrate --network runs/{shown}\n" in card
        assert f"The filter is fitted to split `val` of run `{shown}`." in card
    (line,) = (row for row in card.splitlines() if row.startswith("| mall_test_ekf"))
    for fitted, options in (("measurement noise window", ""), ("noise", " --fit noise")):
        calibration = {"run": "walk", "split": "val", "fitted": fitted.split()}
        (copy / "calibration.json").write_text(json.dumps(calibration))
        publish(copy, tmp_path / "package", "walk", *SAID)
        assert f"--network runs/walk{options}\n" in read_text(tmp_path / "package")
    assert line.endswith("| – | – | 0.80 (0.71 to 0.89) | 2.00 (2.00 to 2.00) |")


@pytest.mark.parametrize(
    "content", ['{"run": ', "{}", "[1]", '{"run": "a", "split": "b", "fitted": 1}']
)
def test_a_damaged_record_of_a_calibration_is_refused(run, tmp_path, content):
    copy = shutil.copytree(run, tmp_path / "walk_calibrated")
    (copy / "calibration.json").write_text(content)
    with pytest.raises(InputError, match=r"calibration\.json: is not the record .*; remove the"):
        publish(copy, tmp_path / "package", "walk", *SAID)


def test_networks_are_listed(published, run, monkeypatch, tmp_path, gnio, mistake):
    """Also runs, which have no card."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(find, "SHIPPED", tmp_path)
    assert "no networks found" in gnio("weights")
    monkeypatch.setenv("GNIO_WEIGHTS", os.pathsep.join(map(str, (published, run.parent))))
    assert publishing._shorten("walk") == "walk"
    shutil.copytree(run, tmp_path / "other" / "trained")
    monkeypatch.setenv("GNIO_WEIGHTS", os.pathsep.join(map(str, (published, tmp_path / "other"))))
    listed = " ".join(gnio("weights").split())
    for words in ("walk", "small", "simulated walks", "CC0", "1.25 m (2 groups)", "MB", "trained"):
        assert words in listed
    assert "has no card" in mistake("weights", "trained")
    (tmp_path / "other" / "trained" / "config.yaml").write_text("seed: one")
    assert "'seed' must be a whole number" in gnio("weights")


def test_the_data_of_a_network_in_words(published, run, tmp_path):
    """And what was measured of it."""
    card = read_network(published / "walk")
    assert (describe_data(card), describe_error(card)) == ("simulated walks", MEASURED)
    copy = shutil.copytree(run, tmp_path / "walk")
    assert describe_data(read_network(copy)) == "dataset synthetic, split train"
    assert describe_error(read_network(copy)) == MEASURED
    (copy / "eval" / "synthetic_test_ekf" / "metrics.json").write_text("{")
    assert describe_error(read_network(copy)) == ""  # and it tracks


def test_a_published_network_is_published_again(published, monkeypatch, tmp_path):
    """With the figures of its own evaluations."""
    monkeypatch.chdir(tmp_path)
    settings = SETTINGS | {"weights": read_network(published / "walk").digest}
    figures = report.Report(settings, SCORES, {}, dict.fromkeys("abcd", "ann"), {}, {})
    write_report(tmp_path / "evaluations" / "walk" / "tyrex_test_ekf", figures)
    card = publish(published / "walk", tmp_path / "again.zip", "again", *SAID)
    measured = "typical error 1.25 m (1 group) on walks of 60 s (tyrex_test_ekf)"
    assert (card.name, card.measured) == ("again", measured)
    assert "It is the published network `walk`, whose card has" in read_text(tmp_path / "again.zip")
    first, second = map(read_network, (published / "walk", tmp_path / "again.zip"))
    assert first.config == second.config and first.digest == second.digest


def test_figures_of_other_weights_are_not_on_the_card(run, tmp_path):
    """Such as those of a run that was trained on, of its latest checkpoint, and of another package
    of the same name."""
    copy = shutil.copytree(run, tmp_path / "walk")
    network = read_network(copy)
    digests = {"before": "0" * 64, "latest": None}
    for folder, digest in digests.items():
        settings = SETTINGS | {"weights": digest, "checkpoint": "best", "step": network.step}
        settings |= {"checkpoint": "latest"} if digest is None else {}
        figures = report.Report(settings, SCORES, {}, dict.fromkeys("abcd", "ann"), {}, {})
        write_report(copy / "eval" / folder, figures)
    (copy / "checkpoints" / "latest" / str(network.step)).mkdir(parents=True)
    with pytest.warns(UserWarning) as warned:
        card = publish(copy, tmp_path / "package", "walk", *SAID)
    assert card.measured == MEASURED == describe_error(network)
    text = read_text(tmp_path / "package")
    assert "| synthetic_test_ekf |" in text and "before" not in text and "latest" not in text
    texts = [str(warning.message) for warning in warned]
    assert len(texts) == 2 and texts[0].endswith("evaluate the network again")
    assert texts[1].endswith("evaluate without --checkpoint latest")
    assert f"{copy / 'eval' / 'before'}: not on the card: its figures are of weights" in texts[0]
    assert "of the latest checkpoint" in texts[1]
    # If there are no others, it was not measured.
    shutil.rmtree(copy / "eval" / "synthetic_test_ekf")
    assert describe_error(read_network(copy)) == ""


def test_the_command(run, tmp_path, gnio, mistake):
    out = tmp_path / "mine.zip"
    arguments = ["publish", run, "--out", out, "--data", "walks \x1b[2J", "--license", "CC0"]
    output = gnio(*arguments, "--fails", "Running.", "Cars.")
    assert f"{out}: mine, network tiny" in output and "gnio track RECORDING --network" in output
    assert read_card(out).license == "CC0"
    assert "\x1b" not in gnio("weights", out)  # of a stranger's card nothing reaches the terminal
    gnio(*arguments)  # in the place of the first
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "thesis.txt").write_text("mine")
    (tmp_path / "other" / "README.md").write_text("---\ntitle: mine\n---\n")
    for wrong, words in (
        (["--out", tmp_path / "other"], "is no published network"),
        (["--name", "a/b"], "not the name of a folder"),
        (["--license", " "], "--license: is empty"),
    ):
        assert words in mistake(*arguments, *wrong)
    assert (tmp_path / "other" / "thesis.txt").read_text() == "mine"
