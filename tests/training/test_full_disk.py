"""A disk that takes no more while a checkpoint is written, and a checkpoint that is damaged."""

import errno
import resource
import shutil
import time
from collections import namedtuple
from contextlib import contextmanager

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gnio_jax.errors import InputError
from gnio_jax.training import checkpoint, run_folder
from gnio_jax.training.checkpoint import RunPosition
from gnio_jax.training.run_folder import Log
from gnio_jax.training.task import TrainState


def state(step):
    rng = np.random.default_rng(step)
    draw = lambda: {"weights": jnp.asarray(rng.normal(size=9000).astype(np.float32))}  # noqa: E731
    return TrainState(jnp.int32(step), {"params": draw(), "batch_stats": {}}, draw())


@contextmanager
def files_of_at_most(size):
    """Bytes that a file may have: writing more fails, as on a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def save(run, step):
    checkpoint.save(run, state(step), RunPosition(step=step))


@pytest.fixture
def run(tmp_path):
    save(tmp_path, 1)
    return tmp_path


def wait_for_writers(run):
    """Orbax raises while other threads still write into the folder that the next save removes."""
    before = None
    while before != (before := {path: path.stat().st_size for path in run.rglob("*")}):
        time.sleep(0.5)


def assert_kept(run):
    restored, where = checkpoint.restore(run, state(0))
    assert where.step == 1
    jax.tree.map(np.testing.assert_array_equal, restored, state(1))


@pytest.mark.parametrize("size, error", [(100, OSError), (10_000, ValueError)])
def test_a_write_that_fails_keeps_the_checkpoint(run, size, error):
    """In the metadata, which Python writes, and in the arrays, where Orbax raises ValueError."""
    with files_of_at_most(size), pytest.raises(error) as failure:
        save(run, 2)
    if error is OSError:
        assert failure.value.errno == errno.EFBIG
        assert str(run / "checkpoints" / "latest") in failure.value.filename
    else:
        assert f"os_error_code='{errno.EFBIG}'" in str(failure.value)
    assert_kept(run)
    wait_for_writers(run)
    save(run, 3)  # where there is room again
    assert checkpoint.restore(run, state(0))[1].step == 3


def test_a_disk_without_room_is_told_before_anything_is_written(run, monkeypatch, capfd):
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage(10**9, 10**9 - 60_000, 60_000))
    with pytest.raises(OSError) as failure:
        save(run, 2)
    assert failure.value.errno == errno.ENOSPC
    assert failure.value.filename == str(run / "checkpoints" / "latest")
    assert [child.name for child in (run / "checkpoints" / "latest").iterdir()] == ["1"]
    assert capfd.readouterr() == ("", "")
    assert_kept(run)


def test_a_log_that_cannot_be_written_names_its_place(tmp_path):
    with Log(tmp_path, 0, 0) as log:
        log.add({"epoch": 0, "step": 1, "loss": 1.0})
        with files_of_at_most(50), pytest.raises(OSError) as failure:
            log.add({"epoch": 1, "step": 2, "loss": 1.0})
    assert failure.value.filename == str(tmp_path / "metrics.jsonl")
    assert len((tmp_path / "metrics.jsonl").read_text().splitlines()) == 1


def test_a_board_that_cannot_be_written_names_its_place(tmp_path, monkeypatch):
    """It ends the run: nothing waits for a thread that the disk has stopped."""
    monkeypatch.setattr(run_folder, "write_text", lambda *_: None)  # which would fail first
    many = {f"gradient_norm/{i}": 1.0 for i in range(100)}
    with Log(tmp_path, 0, 0) as log:
        with files_of_at_most(6000), pytest.raises(OSError) as failure:
            for step in range(20):
                log.add({"epoch": step, "step": step, **many})
    assert failure.value.filename == str(tmp_path / "tensorboard")


def test_arrays_that_are_cut_short_are_told(run):
    for file in (run / "checkpoints" / "latest" / "1" / "optimizer" / "d").iterdir():
        file.write_bytes(file.read_bytes()[:20])
    with pytest.raises(InputError, match=r"latest/1: cannot be read .* is damaged"):
        checkpoint.restore(run, state(0))


def test_what_a_killed_process_left_is_removed(tmp_path):
    remnant = tmp_path / "checkpoints" / "latest" / "7.orbax-checkpoint-tmp"
    remnant.mkdir(parents=True)
    save(tmp_path, 1)
    assert not remnant.exists()
