"""Names of files may differ in case, as systems that do not tell cases apart write them."""

import warnings

import pytest

from gnio_jax import data
from gnio_jax.files import file_in
from tests.support.layouts import LAYOUTS
from tests.support.sequences import assert_same_arrays

UNREAD = {"calibration.json", "imu_samples_0.csv", "record.properties", "metadata.json"}


@pytest.mark.parametrize("name", sorted(LAYOUTS.keys() - {"kitti npz"}))
def test_a_file_whose_name_differs_in_case_is_read(name, tmp_path, monkeypatch):
    """Every file of a recording in turn, and its list."""
    monkeypatch.setenv("GNIO_CACHE", str(tmp_path / "cache"))
    layout, root = LAYOUTS[name], tmp_path / "root"
    layout.write(root, layout.shortest)
    (expected,) = data.load(layout.dataset, root, layout.split)
    files = sorted(path for path in root.rglob("*") if path.is_file() and path.name not in UNREAD)
    for path in files[:6] if len(files) < 20 else [root / layout.targets[0]]:
        other = path.rename(path.with_name(path.name.swapcase()))
        named = path.stem in (expected.name, expected.name.rpartition("_")[2])
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            (sequence,) = data.load(layout.dataset, root, layout.split)
        assert_same_arrays(sequence, expected)
        assert named or sequence.name == expected.name
        other.rename(path)


def test_of_two_files_that_differ_in_case_alone_the_exact_one_is_taken(tmp_path):
    assert file_in(tmp_path / "none", "a.txt") == tmp_path / "none" / "a.txt"
    (tmp_path / "A.txt").touch()
    assert file_in(tmp_path, "a.txt") == tmp_path / "A.txt"
    (tmp_path / "a.TXT").touch()
    if len(list(tmp_path.iterdir())) == 2:
        assert file_in(tmp_path, "a.txt") == tmp_path / "a.txt"
        (tmp_path / "a.txt").touch()
        assert file_in(tmp_path, "a.txt") == tmp_path / "a.txt"
