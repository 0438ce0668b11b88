"""Packages of networks: what goes in comes out, and what was changed on the way is refused."""

import dataclasses
import hashlib
import json
import shutil
import struct
import zipfile

import jax
import numpy as np
import pytest

import gnio_jax
from gnio_jax import pretrained
from gnio_jax.commands import app, console
from gnio_jax.errors import InputError
from gnio_jax.pretrained import Description, arrays, finding
from gnio_jax.training import checkpoint
from tests.pretrained.conftest import CONFIG

SAID = Description("walk", "simulated walks", "CC0", ("Running | jumping.",))


@pytest.fixture(scope="module")
def published(run, tmp_path_factory):
    """A folder of packages: `walk`, and `small.zip` in float16."""
    folder = tmp_path_factory.mktemp("packages")
    pretrained.publish(run, folder / "walk", SAID)
    pretrained.publish(run, folder / "small.zip", SAID._replace(name="small"), "float16")
    return folder


@pytest.fixture
def package(published, tmp_path):
    return shutil.copytree(published / "walk", tmp_path / "walk")


@pytest.fixture
def gnio(monkeypatch, capsys):
    def call(*arguments):
        monkeypatch.setattr("sys.argv", ["gnio", *map(str, arguments)])
        console.run(lambda: app.main(list(map(str, arguments))))
        return capsys.readouterr().out

    return call


def refused(place, *words):
    with pytest.raises(InputError) as caught:
        gnio_jax.load_pretrained(place)
    told = str(caught.value)
    assert "\n" not in told and all(word in told for word in words), told


def leaves(tree):
    return [np.asarray(leaf) for leaf in jax.tree.leaves(tree)]


def read_safetensors(content):
    """Name -> array, by the format's own description: a length, a header of JSON, the bytes."""
    (length,) = struct.unpack("<Q", content[:8])
    header, body = json.loads(content[8 : 8 + length]), content[8 + length :]
    kinds = {"F32": np.float32, "F16": np.float16}
    return {
        name: np.frombuffer(body[slice(*entry["data_offsets"])], kinds[entry["dtype"]]).reshape(
            entry["shape"]
        )
        for name, entry in header.items()
        if name != "__metadata__"
    }


def test_a_package_is_the_run(run, published):
    own, loaded = checkpoint.load_run(run), gnio_jax.load_pretrained(published / "walk")
    assert jax.tree.structure(loaded.variables) == jax.tree.structure(own.variables)
    for ours, theirs in zip(leaves(loaded.variables), leaves(own.variables), strict=True):
        assert ours.dtype == np.float32
        np.testing.assert_array_equal(ours, theirs)
    nowhere = dataclasses.replace(CONFIG, data_root=None, init_from=None)
    assert loaded.config == nowhere and loaded.model == own.model
    assert (loaded.epoch, loaded.step) == (own.epoch, own.step)


def test_the_files_are_what_other_programs_read(run, published):
    own = checkpoint.load_run(run).variables
    tensors = read_safetensors((published / "walk" / "weights.safetensors").read_bytes())
    kernel = tensors["params/encoder/kernel"]
    np.testing.assert_array_equal(kernel, own["params"]["encoder"]["kernel"])
    manifest = json.loads((published / "walk" / "manifest.json").read_text())
    assert manifest["format"] == "gnio-package" and manifest["version"] == 1
    for name, entry in manifest["files"].items():
        content = (published / "walk" / name).read_bytes()
        assert entry == {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}
    assert "somebody" not in "".join(
        path.read_text(errors="replace") for path in (published / "walk").iterdir()
    )


def test_the_card_says_what_the_publisher_and_the_evaluations_say(published):
    card = (published / "walk" / "README.md").read_text()
    for words in (
        "Trained on: simulated walks",
        "Licence: CC0",
        "- Running | jumping.",
        "gnio train --config config.yaml --workdir runs/walk --init-from runs/earlier",
        "Dataset `synthetic`, seed 7",
        "counts errors in: scale",
        "| synthetic_test_ekf | 2 | 1.23 (0.90–1.60) |",
        "in float32",
    ):
        assert words in card
    assert "calibrate" not in card


def test_half_the_size_says_what_it_loses(run, published):
    own, small = checkpoint.load_run(run), gnio_jax.load_pretrained(published / "small.zip")
    with zipfile.ZipFile(published / "small.zip") as archive:
        tensors = read_safetensors(archive.read("weights.safetensors"))
        card = archive.read("README.md").decode()
    assert tensors["params/head/kernel"].dtype == np.float16
    assert tensors["batch_stats/norm/var"].dtype == np.float32
    for kind, rounded in (("params", np.float16), ("batch_stats", np.float32)):
        wanted = [leaf.astype(rounded) for leaf in leaves(own.variables[kind])]
        for ours, theirs in zip(leaves(small.variables[kind]), wanted, strict=True):
            np.testing.assert_array_equal(ours, theirs.astype(np.float32))
    # The stated loss, against the two networks on the same windows.
    windows = arrays._drawn_windows(50)
    said = [run.model.apply(run.variables, windows) for run in (own, small)]
    moved = np.linalg.norm(said[1].displacement - said[0].displacement, axis=1).max()
    assert 0 < moved < 0.01 and f"by up to {1000 * moved:.3g} mm" in card


def test_numbers_that_float16_has_not_are_refused():
    with pytest.raises(InputError, match="'params/a': is too large"):
        arrays.to_bytes({"params": {"a": np.float32([1e6])}}, "float16")


@pytest.mark.parametrize("name", ["weights.safetensors", "config.yaml", "README.md"])
def test_a_changed_byte(package, name):
    content = bytearray((package / name).read_bytes())
    content[len(content) // 2] ^= 1
    (package / name).write_bytes(content)
    refused(package, f"'{name}'", "SHA-256")


def test_what_else_is_damaged(package, tmp_path):
    manifest = package / "manifest.json"
    good = json.loads(manifest.read_text())

    def with_changes(**changes):
        manifest.write_text(json.dumps({**good, **changes}))

    with_changes(version=2)
    refused(package, "format version 2", "newer gnio-jax")
    with_changes(format="other")
    refused(package, "not that of a package")
    with_changes(license=None)
    refused(package, "lacks a field", "license")
    with_changes(files={**good["files"], "../secret": {"bytes": 1, "sha256": ""}})
    refused(package, "lists its files wrongly")
    with_changes(files={k: v for k, v in good["files"].items() if k != "config.yaml"})
    refused(package, "lacks 'config.yaml'")
    for size in (-2, 2**40):  # either would read all that a bomb unpacks to
        with_changes(files={**good["files"], "README.md": {"bytes": size, "sha256": ""}})
        refused(package, "lists its files wrongly")
    with_changes(network=["tlio"])
    refused(package, "lacks a field", "network")
    for metric in ("1.2", {**good["metric"], "value": "1.2"}, {**good["metric"], "low": None}):
        with_changes(metric=metric)
        refused(package, "lacks a field", "metric")
    for text in ("{", "[" * 100_000):
        manifest.write_text(text)
        refused(package, "no JSON")
    with_changes()
    (package / "README.md").write_text("longer " * 9999)
    refused(package, "'README.md'", "larger")
    (package / "weights.safetensors").unlink()
    refused(package, "'weights.safetensors' is missing")
    broken = tmp_path / "broken.zip"
    broken.write_bytes(b"PK no zip")
    refused(broken, "cannot be read")


def test_weights_of_another_network(package):
    manifest = json.loads((package / "manifest.json").read_text())
    content = arrays.to_bytes({"params": {"head": {"kernel": np.zeros((4, 3), np.float32)}}})
    (package / "weights.safetensors").write_bytes(content)
    entry = {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}
    manifest["files"]["weights.safetensors"] = entry
    (package / "manifest.json").write_text(json.dumps(manifest))
    refused(package, "'batch_stats/norm/mean' has shape None", "(4,)")


def test_names_are_found_and_listed(published, run, monkeypatch, tmp_path, gnio):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(finding, "SHIPPED", tmp_path)
    assert "no packages" in gnio("weights")
    refused("walk", "no package is installed")
    monkeypatch.setenv("GNIO_WEIGHTS", str(published))
    assert list(pretrained.packages()) == ["small", "walk"]
    assert gnio_jax.load_pretrained("small").config.seed == 7
    assert gnio_jax.load_pretrained(run).config == CONFIG
    refused("wolk", "did you mean 'walk'?")
    refused(tmp_path, "neither a package")
    listed = gnio("weights")
    for words in ("walk", "small", "simulated walks", "CC0", "1.23 m (0.90–1.60)", "MB"):
        assert words in listed
    monkeypatch.setenv("GNIO_WEIGHTS", str(tmp_path / "nowhere"))
    refused("walk", "$GNIO_WEIGHTS", "nowhere")


def test_the_default_is_shipped_or_the_newest_run(published, run, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(finding, "SHIPPED", published)
    assert pretrained.default() == published / "small.zip"
    monkeypatch.setattr(finding, "SHIPPED", tmp_path)
    with pytest.raises(InputError, match="there are no weights to start from"):
        pretrained.default()
    shutil.copytree(run, tmp_path / "runs" / "walk")
    assert pretrained.default().name == "walk"


def test_the_command(run, tmp_path, gnio, capsys):
    out = tmp_path / "mine.zip"
    given = ["publish", run, "--out", out, "--data", "walks", "--license", "CC0"]
    told = gnio(*given, "--fails", "Running.", "Cars.")
    assert f"{out}: mine, network tiny" in told and "gnio track RECORDING --weights" in told
    assert pretrained.about(out).license == "CC0"
    gnio(*given)  # in the place of the first
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "thesis.txt").write_text("mine")
    (tmp_path / "other" / "manifest.json").write_text("{}")
    for wrong, words in (
        (["--out", tmp_path / "other"], "is no package"),
        (["--name", "a/b"], "no name of a folder"),
        (["--license", " "], "--license: is empty"),
    ):
        with pytest.raises(SystemExit, match="2"):
            gnio(*given, *wrong)
        told = capsys.readouterr().err
        assert words in told and told.count("\n") == 1
    assert (tmp_path / "other" / "thesis.txt").read_text() == "mine"
