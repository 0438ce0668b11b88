"""Packages of networks: what goes in comes out, and what was changed on the way is refused."""

import dataclasses
import hashlib
import json
import math
import shutil
import struct
import zipfile

import jax
import numpy as np
import pytest

import gnio_jax
from gnio_jax import config as configuration
from gnio_jax.apps import packages
from gnio_jax.apps.packages import SHIPPED
from gnio_jax.config import DataConfig, ModelConfig, TrainConfig
from gnio_jax.errors import InputError
from gnio_jax.evaluation import report
from gnio_jax.evaluation.metrics import Measures
from gnio_jax.training import checkpoint
from tests.support import tiny_run
from tests.support.compiling import quick
from tests.support.filter_settings import changed
from tests.support.reports import write_report

CONFIG = TrainConfig(
    dataset="synthetic",
    data_root="/home/somebody/recordings",
    init_from="runs/earlier",
    seed=7,
    data=DataConfig(rate=50.0, poses_by="/home/somebody/runs/first"),
    model=ModelConfig(name="tiny"),
    filter=changed(noise={"std_factor": (1.7, 1.0, 1.0)}, considered={"scale": 0.02}),
)
SETTINGS = {"dataset": "synthetic", "split": "test", "estimator": "ekf", "alignment": "origin"}
SETTINGS |= {"recordings": dict.fromkeys("abcd", 60.0), "filter": {}}
SETTINGS["definitions"] = report.DEFINITIONS
SCORES = {
    name: Measures({"ate_2d": error, "yaw_rmse": None}, {"yaw_rmse": "no reference"}, error > 9)
    for name, error in (("a", 1.2), ("b", 1.3), ("c", 99.0), ("d", math.inf))
}
MEASURED = "ATE 2-D is 1.25 (0.61 to 1.89) m on synthetic_test_ekf (in a pocket 1.2; in a hand 1.3)"
"""12.706 (Student's t, one degree of freedom) times 0.05 m around the mean; two diverged."""
SAID = ("simulated walks", "CC0", ("Running | jumping.",))


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run of the smallest network, with the figures of one evaluation."""
    with tiny_run.known():
        folder = tiny_run.save(tmp_path_factory.mktemp("trained") / "walk", CONFIG)
        evaluation = folder / "eval" / "synthetic_test_ekf"
        evaluation.mkdir(parents=True)
        groups = {"a": "ann", "b": "bob", "c": "ann", "d": "bob"}
        carried = {"a": "in a pocket", "b": "in a hand", "c": "in a hand", "d": "in a hand"}
        figures = report.Report(SETTINGS, SCORES, {}, groups, {}, {}, carried)
        (evaluation / "metrics.json").write_text(json.dumps(report.as_json(figures)))
        yield folder


@pytest.fixture(scope="module")
def published(run, tmp_path_factory):
    """A folder of packages: `walk`, and `small.zip`."""
    folder = tmp_path_factory.mktemp("packages")
    packages.publish(run, folder / "walk", "walk", *SAID)
    packages.publish(run, folder / "small.zip", "small", *SAID)
    return folder


@pytest.fixture
def package(published, tmp_path):
    return shutil.copytree(published / "walk", tmp_path / "walk")


def refused(place, *words):
    with pytest.raises(InputError) as caught:
        gnio_jax.load_pretrained(place)
    told = str(caught.value)
    assert "\n" not in told and all(word in told for word in words), told


def with_changes(package, **changes):
    """The manifest changed by one who knows how its digest is made."""
    path = package / "manifest.json"
    manifest = json.loads(path.read_text()) | changes
    rest = {name: value for name, value in manifest.items() if name != "sha256"}
    text = json.dumps(rest, sort_keys=True).encode()
    path.write_text(json.dumps({**rest, "sha256": hashlib.sha256(text).hexdigest()}))


@pytest.mark.parametrize("name", ["walk", "small.zip"])
def test_a_package_is_the_run(run, published, name, tmp_path, gnio):
    """And the run that is made of it is the same network."""
    own, loaded = checkpoint.load_run(run), gnio_jax.load_pretrained(published / name)
    known = {"data_root": None, "init_from": None, "data": DataConfig(rate=50.0)}
    assert loaded.config == dataclasses.replace(CONFIG, **known)
    out = tmp_path / "runs" / "made"
    assert f"gnio evaluate --workdir {out}" in gnio("weights", published / name, "--out", out)
    made = checkpoint.load_run(out)
    assert made.config == dataclasses.replace(loaded.config, workdir=str(out))
    for each in (loaded, made):
        jax.tree.map(np.testing.assert_array_equal, each.variables, own.variables)
        assert each.model == own.model and (each.epoch, each.step) == (own.epoch, own.step)
    with pytest.raises(InputError, match="is there already; name another folder"):
        packages.write_run(published / name, out)


def test_the_files_are_what_other_programs_read(run, published):
    """The weights by the format's own description: a length, a header of JSON, the bytes."""
    folder = published / "walk"
    assert sorted(path.name for path in folder.iterdir()) == ["manifest.json", packages.WEIGHTS]
    content, text = (folder / packages.WEIGHTS).read_bytes(), (folder / "manifest.json").read_text()
    (length,) = struct.unpack("<Q", content[:8])
    entry = json.loads(content[8 : 8 + length])["params/encoder/kernel"]
    assert entry["dtype"] == "F32"
    kernel = np.frombuffer(content[8 + length :][slice(*entry["data_offsets"])], np.float32)
    own = checkpoint.load_run(run).variables["params"]["encoder"]["kernel"]
    np.testing.assert_array_equal(kernel.reshape(entry["shape"]), own)
    weights = {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}
    assert json.loads(text)["weights"] == weights
    assert "somebody" not in text
    with zipfile.ZipFile(published / "small.zip") as archive:
        assert archive.read(packages.WEIGHTS) == content


def test_the_card_has_what_the_publisher_and_the_evaluations_say(published, run, tmp_path):
    """Also of walks with waypoints, and to what the filter was fitted: by the network itself, or by
    another one whose filter it has taken over."""
    card = packages.card_of(published / "walk")
    for words in (
        "Trained on: simulated walks",
        "- Running | jumping.",
        "gnio train --config config.yaml --workdir runs/walk --init-from runs/earlier "
        "--set data.poses_by=runs/first",
        "covariance of the filter: scale.",
        "| synthetic_test_ekf | 4 | 2 | 1.25 (0.61 to 1.89)",
    ):
        assert words in card
    assert "calibrate" not in card and "fitted" not in card
    assert packages._named_run("/home/some body/first run") == "'runs/first run'"
    own = shutil.copytree(run, tmp_path / "walk_calibrated")
    legs = [{"leg_ratio": ratio, "waypoint_rms": 2.0} for ratio in (0.75, 0.85)]
    scores = {name: Measures(each, {}, False) for name, each in zip("ab", legs, strict=True)}
    figures = report.Report(SETTINGS, scores, {}, {"a": "F1", "b": "F2"}, {}, {})
    write_report(own / "eval" / "mall_test_ekf", figures)
    for calibrated, shown in (("runs/half", "half"), ("walk", "walk"), ("other/run", "run")):
        (own / "calibration.json").write_text(json.dumps({"run": calibrated, "split": "val"}))
        packages.publish(own, tmp_path / "package", "walk", *SAID)
        card = packages.card_of(tmp_path / "package")
        assert f"gnio calibrate --workdir runs/{shown}\n" in card
        assert f"The filter is fitted to split `val` of run `{shown}`." in card
    (line,) = (each for each in card.splitlines() if each.startswith("| mall_test_ekf"))
    assert line.endswith("| – | – | 0.80 (0.16 to 1.44) | 2.00 (2.00 to 2.00) |")


def test_what_is_damaged(package, tmp_path, monkeypatch):
    """Weights that are too large are not read: a zip of megabytes may unpack to any size."""
    for name, at in ((packages.WEIGHTS, b"F32"), (packages.MANIFEST, b"simulated")):
        content = (package / name).read_bytes()
        (package / name).write_bytes(content.replace(at, at.lower()[::-1], 1))
        refused(package, f"'{name}'", "SHA-256")
        (package / name).write_bytes(content)
    good = json.loads((package / "manifest.json").read_text())
    for changes, words in (
        ({"version": 3}, ("format version 3", "publish its run again")),
        ({"license": None}, ("no 'license'",)),
        ({"weights": {}}, ("does not describe",)),
        *(({"step": step}, ("no 'step'",)) for step in (-5, "../..", True)),
        ({"config": {"seed": "one"}}, ("manifest.json", "seed")),
    ):
        with_changes(package, **good | changes)
        refused(package, *words)
    (package / "manifest.json").write_text("[" * 100_000)
    refused(package, "no JSON")
    (package / "manifest.json").write_text(json.dumps(good))
    content = packages.to_bytes({"params": {"head": {"kernel": np.zeros((4, 3), np.float32)}}})
    (package / packages.WEIGHTS).write_bytes(content)
    weights = {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}
    with_changes(package, **good | {"weights": weights})
    refused(package, "'batch_stats/norm/mean' has shape None", "(4,)")
    with monkeypatch.context() as patch:
        patch.setattr(packages, "LARGEST_WEIGHTS", 100)
        refused(package, "'weights.safetensors' is larger than 100 bytes")
    (package / packages.WEIGHTS).unlink()
    refused(package, "'weights.safetensors' is missing")
    (tmp_path / "broken.zip").write_bytes(b"PK no zip")
    refused(tmp_path / "broken.zip", "cannot be read")


def test_names_are_found_and_listed(published, run, monkeypatch, tmp_path, gnio):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(packages, "SHIPPED", tmp_path)
    assert "no packages" in gnio("weights")
    refused("walk", "known names: none")
    monkeypatch.setenv("GNIO_WEIGHTS", str(published))
    assert list(packages.packages()) == ["small", "walk"] and packages._named_run("walk") == "walk"
    assert gnio_jax.load_pretrained("small").config.seed == 7
    assert gnio_jax.load_pretrained(run).config == CONFIG
    refused("wolk", "did you mean 'walk'?")
    refused(tmp_path, "neither a package")
    listed = " ".join(gnio("weights").split())
    for words in ("walk", "small", "simulated walks", "CC0", "1.25 (0.61", "MB"):
        assert words in listed
    monkeypatch.setenv("GNIO_WEIGHTS", str(tmp_path / "nowhere"))
    refused("walk", "$GNIO_WEIGHTS", "nowhere")


def test_the_default_is_shipped_or_the_newest_run(published, run, monkeypatch, tmp_path):
    """And what was measured of it is known."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(packages, "SHIPPED", published)
    assert packages.find() == published / "small.zip"
    monkeypatch.setattr(packages, "SHIPPED", tmp_path)
    with pytest.raises(InputError, match="runs: holds no run"):
        packages.find()
    own = shutil.copytree(run, tmp_path / "runs" / "walk")
    assert packages.find().name == "walk"
    assert packages.choose(published / "walk").trained_on == f"simulated walks, whose {MEASURED}"
    assert packages.choose(own).trained_on == f"dataset synthetic, split train, whose {MEASURED}"
    (own / "eval" / "synthetic_test_ekf" / "metrics.json").write_text("{")
    assert packages.choose(own).trained_on == "dataset synthetic, split train"  # and it tracks


def test_the_command(run, tmp_path, gnio, mistake):
    out = tmp_path / "mine.zip"
    given = ["publish", run, "--out", out, "--data", "walks \x1b[2J", "--license", "CC0"]
    told = gnio(*given, "--fails", "Running.", "Cars.")
    assert f"{out}: mine, network tiny" in told and "gnio track RECORDING --weights" in told
    assert packages.read_manifest(out).license == "CC0"
    assert "\x1b" not in gnio("weights", out)  # of a stranger's card nothing reaches the terminal
    gnio(*given)  # in the place of the first
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "thesis.txt").write_text("mine")
    (tmp_path / "other" / "manifest.json").write_text("{}")
    for wrong, words in (
        (["--out", tmp_path / "other"], "is no package"),
        (["--name", "a/b"], "no name of a folder"),
        (["--license", " "], "--license: is empty"),
    ):
        assert words in mistake(*given, *wrong)
    assert (tmp_path / "other" / "thesis.txt").read_text() == "mine"


# --- the network that comes with gnio-jax


def test_the_shipped_network_is_the_default_and_small(monkeypatch, gnio, mistake):
    monkeypatch.delenv("GNIO_WEIGHTS", raising=False)
    place = SHIPPED / "pedestrian"
    assert packages.find() == place
    assert sum(file.stat().st_size for file in place.iterdir()) < 5.1e6
    card = gnio("weights", "pedestrian")
    for words in ("Tyrex", "CeCILL 2.1", "gnio calibrate", "oxiod_sessions_test_ekf | 7 | 3 |"):
        assert words in card
    assert "is for one package; name it before --out" in mistake("weights", "--out", "run")


def test_the_shipped_network_answers():
    """The arrays are those that were published; a phone that lies still goes next to nowhere."""
    digest = hashlib.sha256((SHIPPED / "pedestrian" / packages.WEIGHTS).read_bytes()).hexdigest()
    assert digest == "7488243d1433afaf24d9172362275881249d6a221fcc998f71d9eec364e71bed"
    run = gnio_jax.load_pretrained("pedestrian")
    assert run.config.datasets == ("tyrex", "indoor_location") and run.config.model.name == "gnio"
    still = np.zeros((1, run.config.data.seen, 6), np.float32)
    still[..., 2] = 9.81
    prediction = quick(run.model.apply)(run.variables, still)
    assert np.linalg.norm(prediction.displacement) < 0.1
    # Training starts from it by its name.
    config = dataclasses.replace(configuration.load("pedestrian"), init_from="pedestrian")
    first = checkpoint.load_initial_network(config, gnio_jax.load_pretrained)
    assert first is not None and first.step > 0
    other = dataclasses.replace(config, model=dataclasses.replace(config.model, width=8))
    with pytest.raises(InputError, match=r"pedestrian: its model.width is 32.* describe the same"):
        checkpoint.load_initial_network(other, gnio_jax.load_pretrained)
