"""Folders are replaced whole or not at all."""

import pytest

from gnio_jax.files import replacing_folder


def test_a_folder_is_replaced_whole_or_not_at_all(tmp_path):
    folder = tmp_path / "eval" / "result"
    with replacing_folder(folder) as new:
        (new / "a").write_text("1")
    with pytest.raises(RuntimeError), replacing_folder(folder) as new:
        (new / "a").write_text("2")
        raise RuntimeError
    assert (folder / "a").read_text() == "1"
    assert [path.name for path in folder.parent.iterdir()] == ["result"]
    with replacing_folder(folder) as new:
        (new / "b").write_text("3")
    assert [path.name for path in folder.iterdir()] == ["b"]
    assert [path.name for path in folder.parent.iterdir()] == ["result"]
