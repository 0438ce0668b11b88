"""Bags that unpack, compute or name more than a recorder writes."""

import bz2
import sqlite3
import tracemalloc
from functools import partial

import lz4.frame
import numpy as np
import pytest
import yaml
import zstandard
from mcap.writer import Writer as McapWriter
from rosbags import rosbag1, rosbag2

from gnio_jax.apps.importing import bags
from gnio_jax.errors import InputError
from tests.support import bag_files
from tests.support.bag_files import Maker, imu, write
from tests.support.importing import imported, refused

COMPRESSED = {"bz2": bz2.compress, "lz4": lz4.frame.compress, "zstd": zstandard.compress}
BOMB = "holds a chunk that unpacks to gigabytes; record it again"


@pytest.mark.parametrize("name", COMPRESSED)
def test_what_is_compressed_is_unpacked_up_to_a_bound(tmp_path, name):
    content = b"recording" * 1000
    assert bags._unpack(COMPRESSED[name](content), name, tmp_path) == content
    bomb = COMPRESSED[name](bytes(1 << 27))
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match=BOMB):
            bags._unpack(bomb, name, tmp_path)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    most = bags.SMALL_CHUNK + bags.LARGEST_RATIO * len(bomb)
    assert len(bomb) < 1 << 20 and peak < 2.5 * most
    with pytest.raises(InputError, match="is compressed as 'xz'"):
        bags._unpack(content, "xz", tmp_path)


def test_the_bounds_fit_into_the_memory_of_a_phone():
    assert bags.SMALL_CHUNK < bags.LARGEST_CHUNK <= 1 << 29 and bags.LARGEST_RATIO <= 1000


def compressed_writer(monkeypatch, kind):
    """The writers of rosbags compress as `kind` says."""
    module, _, mode = kind.partition(" ")
    if module == "rosbag1":
        original = rosbag1.Writer

        def writer(path):
            bag = original(path)
            bag.set_compression(original.CompressionFormat[mode])
            return bag

        monkeypatch.setattr(rosbag1, "Writer", writer)
    elif module == "rosbag2":
        original, modes = rosbag2.Writer, rosbag2.CompressionMode

        def writer(path, **options):
            bag = original(path, **options)
            bag.set_compression(modes[mode], rosbag2.CompressionFormat.ZSTD)
            return bag

        monkeypatch.setattr(rosbag2, "Writer", writer)


@pytest.mark.parametrize(
    "kind, form",
    [
        ("rosbag1 BZ2", "rosbag1"),
        ("rosbag1 LZ4", "rosbag1"),
        ("rosbag2 MESSAGE", "rosbag2"),
        ("rosbag2 MESSAGE", "bag of mcap"),
        ("rosbag2 STORAGE", "bag of mcap"),
        ("mcap", "mcap"),
    ],
)
def test_the_bound_holds_for_every_kind(tmp_path, monkeypatch, kind, form):
    compressed_writer(monkeypatch, kind)
    path = write(tmp_path, form, imu(Maker(form)))
    assert len(imported(path).sequence.time) == 600
    monkeypatch.setattr(bags, "SMALL_CHUNK", 0)
    monkeypatch.setattr(bags, "LARGEST_RATIO", 1)
    refused(path, BOMB)


@pytest.mark.parametrize(
    "name, change",
    [
        (
            "message_definitions",
            "ALTER TABLE message_definitions RENAME TO other; "
            "CREATE VIEW message_definitions AS "
            "WITH RECURSIVE r(id) AS (SELECT 1 UNION ALL SELECT id + 1 FROM r) "
            "SELECT id, '' AS topic_type, '' AS encoding, '' AS encoded_message_definition, "
            "'' AS type_description_hash FROM r",
        ),
        ("topics.large", "ALTER TABLE topics ADD COLUMN large GENERATED ALWAYS AS (zeroblob(9e8))"),
        ("search", "CREATE VIRTUAL TABLE search USING fts5(text)"),
        ("on_open", "CREATE TRIGGER on_open AFTER INSERT ON topics BEGIN SELECT 1; END"),
    ],
)
@pytest.mark.parametrize("kind", ["db3", "rosbag2"])
def test_a_table_that_computes_is_refused(tmp_path, kind, name, change):
    path = write(tmp_path, kind, imu(Maker(kind), seconds=2.0))
    (file,) = [path] if kind == "db3" else path.glob("*.db3")
    with sqlite3.connect(file) as connection:
        connection.executescript(change)
    connection.close()
    words = f"holds '{name}', which no recorder writes; record it again, or convert it to MCAP"
    refused(path, words)


def test_the_name_of_a_folder_leads_to_no_other_file(tmp_path):
    """SQLite reads %41 as A, and ? and # as an end."""
    path = write(tmp_path, "rosbag2", imu(Maker("rosbag2"), seconds=2.0))
    folder = path.rename(tmp_path / "walk%41")
    refused(folder, "has %, . or # in its name; rename it, or its folder")
    (file,) = folder.glob("*.db3")
    refused(file, "has %, . or # in its name; rename it, or its folder")


def test_messages_come_in_the_order_in_which_they_were_logged(tmp_path, monkeypatch):
    """Chunks of a recorder may overlap; those without the topic are not read."""
    monkeypatch.setattr(bag_files, "McapWriter", partial(McapWriter, chunk_size=3000))
    entries = imu(Maker(), seconds=2.0)
    order = np.argsort(np.arange(len(entries)) + np.random.default_rng(0).uniform(0, 40, 200))
    path = bag_files.write_mcap(tmp_path / "walk.mcap", "mcap", [entries[n] for n in order])
    with bags.open_bag(path, "mcap") as bag:
        times = [time for _, time, _ in bag.messages(["/imu/data"])]
        assert list(bag.messages([])) == []
    assert times == sorted(entry[2] for entry in entries) and len(times) == 200


def test_the_files_of_a_split_bag_are_one_recording(tmp_path):
    for kind in ("rosbag2", "bag of mcap"):
        (tmp_path / kind).mkdir()
        maker, entries = Maker(kind), imu(Maker(kind))
        whole = write(tmp_path / kind, kind, entries)
        (file,) = (path for path in whole.iterdir() if path.suffix != ".yaml")
        expected = imported(whole).sequence
        parts = []
        for number, part in enumerate((entries[:250], entries[250:])):
            (tmp_path / f"{kind} {number}").mkdir()
            piece = write(tmp_path / f"{kind} {number}", kind, part)
            (content,) = (path for path in piece.iterdir() if path.suffix != ".yaml")
            parts.append(content.rename(file.with_stem(f"part{number}")).name)
        text = (whole / "metadata.yaml").read_text()
        file.unlink()
        content = yaml.safe_load(text)
        content["rosbag2_bagfile_information"]["relative_file_paths"] = parts
        (whole / "metadata.yaml").write_text(yaml.safe_dump(content))
        sequence = imported(whole).sequence
        assert maker.store is not None and (sequence.gyro == expected.gyro).all()
        (whole / parts[1]).unlink()
        refused(whole, "cannot be read as a ROS 2 bag")
