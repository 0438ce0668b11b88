"""Files and folders are replaced whole or not at all."""

import os
import signal
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from gnio_jax import files
from gnio_jax.errors import InputError
from gnio_jax.files import check_writable, check_writable_folder, replacing, replacing_folder


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


def test_a_folder_returns_if_the_new_one_cannot_take_its_place(tmp_path, monkeypatch):
    folder, rename = tmp_path / "result", Path.rename
    with replacing_folder(folder) as new:
        (new / "a").write_text("1")

    def fail(path, target):
        if path.name == "new":
            raise OSError("no rename")
        return rename(path, target)

    monkeypatch.setattr(Path, "rename", fail)
    with pytest.raises(OSError, match="no rename"), replacing_folder(folder) as new:
        (new / "a").write_text("2")
    assert (folder / "a").read_text() == "1"
    assert list(tmp_path.iterdir()) == [folder]


def test_of_two_processes_that_write_one_folder_the_last_one_stays(tmp_path, monkeypatch):
    """One comes between the renames of the other, and takes its temporary folder for a leftover."""
    rename, open_file, path, events = Path.rename, os.open, tmp_path / "track", []

    def rename_late(self, target):
        if self.name == "new" and "rename" not in events:
            events.append("rename")
            path.mkdir()
            (path / "theirs").touch()
        return rename(self, target)

    def open_late(name, *arguments, **options):
        if "track.gnio-" in str(name) and "open" not in events:
            events.append("open")
            os.rmdir(name)
        return open_file(name, *arguments, **options)

    path.mkdir()
    (path / "earlier").touch()
    monkeypatch.setattr(Path, "rename", rename_late)
    monkeypatch.setattr(os, "open", open_late)
    with replacing_folder(path) as folder:
        (folder / "ours").touch()
    assert events == ["open", "rename"]
    assert [file.name for file in path.iterdir()] == ["ours"] and list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("mounted", [False, True])
def test_of_the_working_folder_and_of_a_mounted_one_the_contents_are_replaced(
    tmp_path, monkeypatch, mounted
):
    """Neither can be renamed."""
    folder = tmp_path / "result"
    folder.mkdir()
    (folder / "a").write_text("1")
    number = folder.stat().st_ino
    if mounted:
        monkeypatch.setattr(os.path, "ismount", lambda path: Path(path) == folder)
    else:
        monkeypatch.chdir(folder)
    destination = folder if mounted else Path(".")
    check_writable_folder(destination)
    with pytest.raises(RuntimeError), replacing_folder(destination) as new:
        (new / "a").write_text("2")
        raise RuntimeError
    assert (folder / "a").read_text() == "1"
    with replacing_folder(destination) as new:
        (new / "b").write_text("3")
    assert [path.name for path in folder.iterdir()] == ["b"]
    assert folder.stat().st_ino == number and list(tmp_path.iterdir()) == [folder]
    rename = Path.rename

    def fail(path, target):
        if path.name == "c":
            raise OSError("no rename")
        return rename(path, target)

    monkeypatch.setattr(Path, "rename", fail)
    with pytest.raises(OSError, match="no rename"), replacing_folder(destination) as new:
        (new / "c").write_text("4")
    assert [path.name for path in folder.iterdir()] == ["b"]


def test_the_mode_of_a_file_is_that_of_any_new_one(tmp_path):
    umask = os.umask(0o027)
    try:
        files.write_text(tmp_path / "a", "1")
        (tmp_path / "b").touch()
        modes = [stat.S_IMODE((tmp_path / name).stat().st_mode) for name in "ab"]
        assert modes == [0o640, 0o640] and os.umask(0o027) == 0o027
    finally:
        os.umask(umask)


def test_what_is_no_file_is_never_replaced(tmp_path):
    """A reader of a pipe would get nothing, and a device would be gone."""
    pipe = tmp_path / "pipe.txt"
    os.mkfifo(pipe)
    link = tmp_path / "link.txt"
    link.symlink_to(pipe)
    for path in (pipe, link, "/dev/null"):
        for call in (
            lambda path=path: files.write_text(path, "1"),
            lambda path=path: check_writable(path),
        ):
            with pytest.raises(InputError, match="is a pipe or a device, not a file; name a file"):
                call()
    assert stat.S_ISFIFO(pipe.stat().st_mode) and stat.S_ISCHR(os.stat("/dev/null").st_mode)
    with pytest.raises(InputError, match="is a file; name a folder"), replacing_folder(pipe):
        pytest.fail("begun")


def test_a_link_stays_and_names_the_new_content(tmp_path):
    (tmp_path / "deep").mkdir()
    (tmp_path / "deep" / "a.txt").write_text("1")
    (tmp_path / "a.txt").symlink_to("deep/a.txt")
    (tmp_path / "folder").symlink_to("deep")
    files.write_text(tmp_path / "a.txt", "2")
    assert (tmp_path / "a.txt").is_symlink()
    assert (tmp_path / "deep" / "a.txt").read_text() == "2"
    with replacing_folder(tmp_path / "folder") as new:
        (new / "b.txt").write_text("3")
    assert (tmp_path / "folder").is_symlink()
    assert [path.name for path in (tmp_path / "deep").iterdir()] == ["b.txt"]
    file = tmp_path / "deep" / "b.txt"
    with pytest.raises(InputError, match="is a file; name a folder"), replacing_folder(file):
        pytest.fail("begun")


WRITER = """
import sys, time
from pathlib import Path
from gnio_jax.files import replacing, replacing_folder
with replacing(Path("walk.h5")) as file, replacing_folder(Path("eval")) as folder:
    file.write_bytes(b"half")
    (folder / "half").touch()
    print("begun", flush=True)
    time.sleep(60)
"""


def hidden(folder):
    return sorted(path.name for path in folder.iterdir() if path.name.startswith("."))


def test_what_a_killed_writer_left_is_removed_and_what_is_being_written_stays(tmp_path):
    (tmp_path / ".walk.settings.h5").write_text("of the user")
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    with subprocess.Popen(
        [sys.executable, "-c", WRITER], cwd=tmp_path, stdout=subprocess.PIPE, env=environment
    ) as writer:
        assert writer.stdout is not None and writer.stdout.readline() == b"begun\n"
        before = hidden(tmp_path)
        assert len(before) == 3
        files.write_text(tmp_path / "walk.h5", "whole")
        assert hidden(tmp_path) == before
        writer.send_signal(signal.SIGKILL)
        writer.wait()
    assert hidden(tmp_path) == before
    files.write_text(tmp_path / "other.txt", "whole")
    assert hidden(tmp_path) == [".walk.settings.h5"]
    assert (tmp_path / "walk.h5").read_text() == "whole"


def test_a_file_that_is_taken_for_a_leftover_is_made_again(tmp_path):
    """Another process may find it before it is locked."""
    paths = []

    def create():
        path = tmp_path / f"part{len(paths)}"
        handle = os.open(path, os.O_CREAT | os.O_WRONLY)
        paths.append(path)
        if len(paths) == 1:
            path.unlink()
        if len(paths) == 2:  # and a third process has the name
            path.unlink()
            path.touch()
        return str(path), handle

    path, handle = files._create_locked(create)
    os.close(handle)
    assert path == paths[2] and len(paths) == 3


def test_a_folder_that_a_killed_writer_moved_away_returns(tmp_path):
    old = tmp_path / f".eval{files.PART}abcd1234" / "old"
    old.mkdir(parents=True)
    (old / "a").write_text("1")
    contents = tmp_path / f".mounted{files.PART}abcd1234" / "contents"
    contents.mkdir(parents=True)
    (contents / "b").write_text("2")
    (contents / "c").write_text("old")
    (tmp_path / "c").write_text("new")
    files.remove_leftovers(tmp_path)
    assert hidden(tmp_path) == []
    assert (tmp_path / "eval" / "a").read_text() == "1"
    assert (tmp_path / "b").read_text() == "2" and (tmp_path / "c").read_text() == "new"


def test_an_error_names_the_file_that_the_user_knows(tmp_path):
    with pytest.raises(OSError) as error, replacing(tmp_path / "a.txt") as temporary:
        temporary.write_text("1")
        raise OSError(28, "No space left on device")
    assert error.value.filename == str(tmp_path / "a.txt")
    with pytest.raises(OSError) as error, replacing_folder(tmp_path / "eval") as folder:
        (folder / "plots").mkdir()
        with replacing(folder / "plots" / "a.png"):
            raise OSError(28, "No space left on device")
    assert error.value.filename == str(tmp_path / "eval" / "plots" / "a.png")
    assert list(tmp_path.iterdir()) == []


def test_a_file_is_on_the_disk_before_it_replaces_the_old_one(tmp_path, monkeypatch):
    """Some file systems report a full disk only then."""
    (tmp_path / "a.txt").write_text("1")

    def full(handle):
        assert os.fstat(handle).st_size == 3
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        files.write_text(tmp_path / "a.txt", "new")
    assert (tmp_path / "a.txt").read_text() == "1" and len(list(tmp_path.iterdir())) == 1
