"""Recordings that have changed in their place are seen, and touched ones have not changed."""

import os
import shutil

import pytest

from gnio_jax.data.contents import CONTENT, STATE, describe_contents, find_change
from tests.support import oxiod_files
from tests.support.layouts import LAYOUTS

LATER = 2_000_000_000
UNREAD = {"metadata.json", "calibration.json", "imu_samples_0.csv", "record.properties"}
"""Files of the published sets from which no sequence is made."""


@pytest.mark.parametrize("name", LAYOUTS)
def test_every_file_of_a_recording_counts(name, tmp_path):
    layout = LAYOUTS[name]
    layout.write(tmp_path, layout.shortest)
    source = layout.dataset, tmp_path, layout.split
    first = describe_contents(*source)
    files = sorted(path for path in tmp_path.rglob("*") if path.is_file())
    lists = {tmp_path / list_name for list_name in layout.lists}
    parts = [path for path in files if path not in lists and path.name not in UNREAD]
    for path in [*parts[:3], *parts[-3:]]:
        content = path.read_bytes()
        os.utime(path, (LATER, LATER))
        ((recording, digests),) = describe_contents(*source).items()
        assert digests[CONTENT] == first[recording][CONTENT]
        assert digests[STATE] != first[recording][STATE]
        assert find_change(*source, first) == ""
        path.write_bytes(content + b"\n")
        assert describe_contents(*source)[recording][CONTENT] != first[recording][CONTENT]
        problem = find_change(*source, first)
        assert problem == f"recording {recording} in {tmp_path} has changed since"
        path.write_bytes(content)


def test_every_form_of_a_recording_counts(tmp_path):
    """The second form is read where the first is refused."""
    folder = tmp_path / "handheld" / "data1"
    for write in (oxiod_files.write_raw, oxiod_files.write_syn):
        write(folder, 1, oxiod_files.Truth(), 1.0)
    source = "oxiod", tmp_path, "sessions_train"
    first = describe_contents(*source)
    for kind in ("raw", "syn"):
        path = folder / kind / "imu1.csv"
        content = path.read_bytes()
        path.write_bytes(content + b"\n")
        assert find_change(*source, first).endswith("has changed since"), kind
        path.write_bytes(content)
    assert find_change(*source, first) == ""


def test_a_recording_that_is_new_or_gone_is_named(tmp_path):
    for name in "ab":
        (tmp_path / f"{name}.csv").write_text(name)
    source = "csv", tmp_path, "test"
    first = describe_contents(*source)
    (tmp_path / "c.csv").write_text("c")
    assert find_change(*source, first) == f"recording c is new in {tmp_path}"
    (tmp_path / "c.csv").unlink()
    (tmp_path / "b.csv").unlink()
    assert find_change(*source, first) == f"recording b is gone in {tmp_path}"
    (tmp_path / "train.txt").write_text("a.csv\n")
    assert find_change(*source, first).startswith(f"its recordings are gone ({tmp_path}/test.txt: ")
    assert find_change("unknown", tmp_path, "test", first) == ""
    shutil.rmtree(tmp_path)
    assert find_change(*source, first) == ""


def test_a_computed_dataset_has_no_files():
    assert describe_contents("synthetic", None, "test") == {}
    assert find_change("synthetic", None, "test", {}) == ""
