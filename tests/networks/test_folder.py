"""A network on the disk: what goes in comes out, and what was changed on the way is refused."""

import dataclasses
import hashlib
import json
import math
import shutil
import struct
import tracemalloc
import zipfile

import jax
import numpy as np
import pytest
import yaml

from gnio_jax import networks
from gnio_jax.config import DataConfig
from gnio_jax.errors import InputError
from gnio_jax.networks import Card, folder, read_network, write_network
from gnio_jax.networks.folder import CARD, CONFIG, WEIGHTS
from tests.support import tiny_run
from tests.support.filter_settings import changed

FACTS = Card("walk", "tiny", "simulated walks", "CC0", 1, 0, "", "a test", {})


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run of the smallest network."""
    with tiny_run.registry_entry():
        yield tiny_run.save(tmp_path_factory.mktemp("trained") / "walk", tiny_run.CONFIGURED)


@pytest.fixture(scope="module")
def published(run, tmp_path_factory):
    """The same network, published: `walk`, and `small.zip`."""
    parent = tmp_path_factory.mktemp("published")
    folder.write_published(parent / "walk", read_network(run), FACTS, "# walk")
    folder.write_published(parent / "small.zip", read_network(run), FACTS, "# walk")
    return parent


@pytest.fixture
def package(published, tmp_path):
    return shutil.copytree(published / "walk", tmp_path / "walk")


def refused(path, *words):
    with pytest.raises(InputError) as mistake:
        read_network(path)
    text = str(mistake.value)
    assert "\n" not in text and all(word in text for word in words), text


def facts_of(package):
    _, head, _ = (package / CARD).read_text(encoding="utf-8").split("---\n", 2)
    return yaml.safe_load(head)


def with_facts(package, **changes):
    """The card changed by one who knows how its digest is made."""
    facts = {**facts_of(package), **changes}
    remaining_facts = {name: value for name, value in facts.items() if name != "sha256"}
    digest = hashlib.sha256(json.dumps(remaining_facts, sort_keys=True).encode()).hexdigest()
    head = yaml.safe_dump({**remaining_facts, "sha256": digest}, sort_keys=False)
    (package / CARD).write_text(f"---\n{head}---\n\n# walk\n", encoding="utf-8")


def with_file(package, name, content):
    """Another file, which the card describes."""
    (package / name).write_bytes(content)
    entry = {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}
    with_facts(package, files=facts_of(package)["files"] | {name: entry})


@pytest.mark.parametrize("name", ["walk", "small.zip"])
def test_a_published_network_is_the_run_without_its_folders(run, published, name):
    network, copy = read_network(run), read_network(published / name)
    nowhere = {"data_root": None, "init_from": None, "data": DataConfig(rate=50.0)}
    assert network.config == tiny_run.CONFIGURED and network.card is None
    assert copy.config == dataclasses.replace(tiny_run.CONFIGURED, **nowhere)
    jax.tree.map(np.testing.assert_array_equal, copy.variables, network.variables)
    assert copy.model == network.model and (copy.epoch, copy.step) == (1, 0)
    assert (network.name, copy.name) == ("walk", "walk") and copy.card.license == "CC0"


@pytest.mark.parametrize("text", ["walks ---", "---", "walks\n---\nand runs"])
def test_facts_may_have_the_marks_of_their_bounds(run, tmp_path, text):
    """Only a whole line is a bound."""
    facts = FACTS._replace(data=text)
    folder.write_published(tmp_path / "walk", read_network(run), facts, "# walk\n\n---\n\nend")
    assert read_network(tmp_path / "walk").card.data == text
    assert folder.read_text(tmp_path / "walk") == "# walk\n\n---\n\nend"


def test_other_programs_read_the_files(run, published):
    """The weights by the format's own description: a length, a header of JSON, the bytes."""
    package = published / "walk"
    assert sorted(path.name for path in package.iterdir()) == sorted((CARD, CONFIG, WEIGHTS))
    content = (package / WEIGHTS).read_bytes()
    (length,) = struct.unpack("<Q", content[:8])
    entry = json.loads(content[8 : 8 + length])["params/encoder/kernel"]
    assert entry["dtype"] == "F32"
    kernel = np.frombuffer(content[8 + length :][slice(*entry["data_offsets"])], np.float32)
    expected_kernel = read_network(run).variables["params"]["encoder"]["kernel"]
    np.testing.assert_array_equal(kernel.reshape(entry["shape"]), expected_kernel)
    files = facts_of(package)["files"]
    for name in (CONFIG, WEIGHTS):
        content = (package / name).read_bytes()
        digest = hashlib.sha256(content).hexdigest()
        assert files[name] == {"bytes": len(content), "sha256": digest}
    assert "somebody" not in (package / CONFIG).read_text() + (package / CARD).read_text()
    with zipfile.ZipFile(published / "small.zip") as archive:
        assert {name: archive.read(name) for name in archive.namelist()} == {
            path.name: path.read_bytes() for path in package.iterdir()
        }


def test_a_run_has_its_position_and_the_filter_that_was_trained(run, tmp_path):
    """config.yaml has the filter from which the training began."""
    network = read_network(run)
    write_network(tmp_path, network._replace(epoch=3, step=41))
    assert (read_network(tmp_path).epoch, read_network(tmp_path).step) == (3, 41)
    first = (tmp_path / WEIGHTS).read_bytes()
    trained = changed(noise={"gyro_density": 0.5, "correlation": None}, start={"velocity": 0.3})
    folder.write_weights(tmp_path, network.variables, 4, 52, trained)
    stored_network = read_network(tmp_path)
    assert stored_network.config == dataclasses.replace(tiny_run.CONFIGURED, filter=trained)
    assert (stored_network.epoch, stored_network.step) == (4, 52)
    jax.tree.map(np.testing.assert_array_equal, stored_network.variables, network.variables)
    assert folder.read_settings(tmp_path).config == stored_network.config
    folder.write_weights(tmp_path, network.variables, 3, 41)
    assert (tmp_path / WEIGHTS).read_bytes() == first  # the same network has the same digest


def test_damaged_files_are_refused(package, tmp_path, monkeypatch):
    """Weights that are too large are not read: a zip of megabytes may unpack to any size."""
    for name, word, problem in (
        (WEIGHTS, b"F32", f"'{WEIGHTS}' is not the file"),
        (CONFIG, b"seed: 7", f"'{CONFIG}' is not the file"),
        (CARD, b"simulated", "its facts were changed"),
    ):
        content = (package / name).read_bytes()
        assert word in content
        (package / name).write_bytes(content.replace(word, word[::-1], 1))
        refused(package, problem, "SHA-256", "damaged")
        (package / name).write_bytes(content)
    good = (package / CARD).read_bytes()
    for changes, words in (
        ({"version": 3}, ("format version 3", "publish its run again")),
        ({"license": None}, ("no 'license'",)),
        ({"files": {}}, ("does not describe",)),
        *(({"step": step}, ("no 'step'",)) for step in (-5, "../..", True)),
    ):
        with_facts(package, **changes)
        refused(package, *words)
        (package / CARD).write_bytes(good)
    for text in ("[" * 100_000, "a: [", "a"):
        (package / CARD).write_text(f"---\nformat: gnio-network\n{text}\n---\n")
        refused(package, "is not YAML")
    (package / CARD).write_text("---\nformat: gnio-network\n")
    refused(package, "does not begin with the facts")
    (package / CARD).write_bytes(good)
    with monkeypatch.context() as patch:
        patch.setitem(folder.LARGEST, CARD, 100)
        refused(package, f"'{CARD}' is larger than 100 bytes")
    entries = facts_of(package)["files"]
    for sizes in ({"bytes": 5}, {"bytes": True}, {"bytes": "5"}, {}, 5):
        with_facts(package, files=entries | {WEIGHTS: sizes})
        problem = "is larger than 5 bytes" if sizes == {"bytes": 5} else "does not describe"
        refused(package, problem)
    (package / CARD).write_bytes(good)
    (package / WEIGHTS).unlink()
    refused(package, f"'{WEIGHTS}' is missing")
    with_file(package, WEIGHTS, b"")
    refused(package, "weights.safetensors: cannot be read")
    with_file(package, CONFIG, b"seed: one")
    refused(package, "config.yaml", "'seed' must be a whole number")
    (tmp_path / "broken.zip").write_bytes(b"PK no zip")
    refused(tmp_path / "broken.zip", "cannot be read")


def test_a_zip_of_the_folder_is_its_network(published, tmp_path):
    """As a file manager packs it, with what macOS adds; two folders are no network."""
    path, expected = tmp_path / "packed.zip", read_network(published / "walk")
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("__MACOSX/walk/._config.yaml", b"")
        for file in (published / "walk").iterdir():
            archive.write(file, f"walk/{file.name}")
    network = read_network(path)
    assert network.digest == expected.digest
    assert network.card == expected.card
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr(f"other/{CONFIG}", b"")
    refused(path, f"'{CARD}' is missing")


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_a_zip_of_another_compression_is_refused(published, tmp_path, method):
    """Also one that is damaged, and every other network is still listed."""
    path = tmp_path / "walk.zip"
    with zipfile.ZipFile(path, "w", method) as archive:
        for file in (published / "walk").iterdir():
            archive.write(file, file.name)
    refused(path, "cannot be read (compression method")
    content = bytearray(path.read_bytes())
    content[60:200] = bytes(140)
    path.write_bytes(content)
    refused(path, "cannot be read")


def test_a_zip_that_unpacks_to_more_than_its_card_says_is_not_unpacked(published, tmp_path):
    path = tmp_path / "walk.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in (published / "walk").iterdir():
            archive.writestr(file.name, file.read_bytes() + bytes(1 << 26) * (file.name == WEIGHTS))
    size = (published / "walk" / WEIGHTS).stat().st_size
    tracemalloc.start()
    try:
        refused(path, f"'{WEIGHTS}' is larger than {size} bytes")
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 1 << 22


def with_nan(content, _):
    """Weights whose last number is NaN: a network of them would track to nowhere."""
    return content[:-4] + np.float32(np.nan).tobytes()


def wider(_, variables):
    return folder.to_bytes(jax.tree.map(lambda array: np.stack([array, array], -1), variables))


def of_another_network(_, __):
    return folder.to_bytes({"params": {"head": {"kernel": np.zeros((4, 3), np.float32)}}})


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            with_nan,
            [": 'params/", "' holds values that are not finite; take another network, or train it"],
        ),
        (of_another_network, ["'batch_stats/norm/mean' has shape None", "[4]"]),
        (wider, ["has shape [4, 2], and in the configured network [4]"]),
        *(
            (lambda content, _, end=end: content[:end], ["weights.safetensors: cannot be read"])
            for end in (0, 5, 100, -1)
        ),
    ],
)
def test_weights_that_no_network_has_are_refused(run, tmp_path, change, words):
    copy = shutil.copytree(run, tmp_path / "walk")
    content = change((copy / WEIGHTS).read_bytes(), read_network(run).variables)
    (copy / WEIGHTS).write_bytes(content)
    refused(copy, *words)


def test_the_text_of_a_card_may_be_edited(package, run):
    text = (package / CARD).read_text(encoding="utf-8")
    (package / CARD).write_text(f"{text}\nA picture.\n", encoding="utf-8")
    assert read_network(package).card.name == "walk"
    assert folder.read_text(package) == "# walk\n\n\nA picture.".replace("\n\n\n", "\n\n")
    with pytest.raises(InputError, match="has no card; gnio publish"):
        folder.read_text(run)


def test_notes_of_ones_own_are_no_card(run, tmp_path):
    copy = shutil.copytree(run, tmp_path / "walk")
    for notes in ("# notes\n", "---\ntitle: notes\n---\n"):
        (copy / CARD).write_text(notes)
        assert read_network(copy).card is None and not folder.has_card(copy)


@pytest.mark.parametrize("text", ["{}", '{"epoch": "x"}', "[]", "5", '{"filter": 3}', "no JSON"])
def test_any_header_is_read_or_refused_in_one_line(run, tmp_path, text):
    copy = shutil.copytree(run, tmp_path / "walk")
    variables = read_network(run).variables
    (copy / WEIGHTS).write_bytes(folder.to_bytes(variables, {folder.HEADER: text}))
    if text == "{}":
        assert (read_network(copy).epoch, read_network(copy).step) == (0, 0)
    else:
        refused(copy, WEIGHTS)


def test_evaluations_are_beside_a_run_and_apart_from_a_published_network(run, published):
    assert folder.evaluations_folder(run) == run / "eval"
    for name in ("walk", "small.zip"):
        path = folder.evaluations_folder(published / name)
        assert path.as_posix() == f"evaluations/{name.removesuffix('.zip')}"


def test_published_bytes_are_the_same_each_time(run, published, tmp_path):
    folder.write_published(tmp_path / "small.zip", read_network(run), FACTS, "# walk")
    assert (tmp_path / "small.zip").read_bytes() == (published / "small.zip").read_bytes()
    assert math.isfinite(networks.read_network(tmp_path / "small.zip").epoch)
