"""Short recordings of every layout, damaged and loaded, and what must hold of the result.

What must hold is stated in `check_sequence` and `check_refusal`, without the package's help.
"""

from __future__ import annotations

import contextlib
import functools
import os
import re
import shutil
import signal
import tempfile
import warnings
import zipfile
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import pytest

from gnio_jax import data
from gnio_jax.errors import InputError
from gnio_jax.types import Sequence
from tests.support.damage import Damage, after
from tests.support.damage_values import PLACES
from tests.support.layouts import LAYOUTS

SECONDS_PER_EXAMPLE = 20


@functools.cache
def written(name: str) -> dict[str, bytes]:
    """The files of a layout's undamaged recording, by their paths."""
    layout = LAYOUTS[name]
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        layout.write(root, layout.shortest)
        return {
            path.relative_to(root).as_posix(): path.read_bytes()
            for path in sorted(root.rglob("*"))
            if path.is_file()
        }


_copies: list[Path] = []


@functools.cache
def copy(name: str) -> Path:
    """The same files on disk, for links to what is not damaged."""
    folder = Path(tempfile.mkdtemp(prefix="fuzz-"))
    _copies.append(folder)
    for file, content in written(name).items():
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        (folder / file).write_bytes(content)
    return folder


def remove_copies() -> None:
    """What `copy` has left on disk."""
    for folder in _copies:
        shutil.rmtree(folder, ignore_errors=True)
    _copies.clear()
    copy.cache_clear()


def write_damaged(name: str, root: Path, happened: list[Damage]) -> None:
    contents = {}
    for damage in happened:
        if damage.what not in PLACES:
            contents[damage.file] = after(
                contents.get(damage.file, written(name)[damage.file]), damage
            )
    places = {damage.file: damage.what for damage in happened if damage.what in PLACES}
    for file in written(name):
        path = root / file
        path.parent.mkdir(parents=True, exist_ok=True)
        match places.get(file):
            case "delete":
                pass
            case "rename":
                path.with_name("old_" + path.name).write_bytes(
                    contents.get(file, written(name)[file])
                )
            case "folder":
                path.mkdir()
            case "dangling link":
                path.symlink_to("nowhere")
            case "looping link":
                path.symlink_to(path.name)
            case _ if file in contents:
                path.write_bytes(contents[file])
            case _:
                os.link(copy(name) / file, path)


class TooLong(BaseException):
    """No `Exception`, so that no loader can catch it."""


@contextlib.contextmanager
def at_most(seconds: int) -> Iterator[None]:
    def stop(*_: Any) -> None:
        raise TooLong(f"no end after {seconds} s")

    # By the processor's time: a busy machine is no fault of the loader.
    before = signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)


def outcome(name: str, happened: list[Damage]) -> tuple[list[Sequence] | InputError, str]:
    """(sequences or the refusal, everything that was said) of a load after the damage."""
    layout = LAYOUTS[name]
    with (
        tempfile.TemporaryDirectory() as folder,
        warnings.catch_warnings(record=True) as said,
        pytest.MonkeyPatch.context() as patch,
    ):
        warnings.simplefilter("always")
        patch.setenv("GNIO_CACHE", f"{folder}/cache")
        root = Path(folder) / "root"
        root.mkdir()
        try:
            write_damaged(name, root, happened)
        except (
            LookupError,
            RuntimeError,
            ValueError,
            TypeError,
            OSError,
            EOFError,
            zipfile.BadZipFile,
        ):
            return [], "two damages that do not go together"
        try:
            with at_most(SECONDS_PER_EXAMPLE):
                result: list[Sequence] | InputError = data.load(layout.dataset, root, layout.split)
        except InputError as error:
            result = error
        lines = [
            str(warning.message) for warning in said if issubclass(warning.category, UserWarning)
        ]
        for line in [*lines, *([str(result)] if isinstance(result, InputError) else [])]:
            assert len(line.splitlines()) == 1, f"not one line: {line!r}"
            assert len(line) < 2000, f"nobody reads {len(line)} characters"
        return result, "\n".join(
            [*lines, *([str(result)] if isinstance(result, InputError) else [])]
        ).replace(str(root), "ROOT")


# --- what must hold


def check_sequence(sequence: Sequence, name: str) -> None:
    dataset = data.get(LAYOUTS[name].dataset)
    count = len(sequence.time)
    assert count >= 2
    assert (
        sequence.gyro.shape
        == sequence.accel.shape
        == sequence.position.shape
        == sequence.velocity.shape
        == (count, 3)
    )
    assert sequence.orientation.shape == (count, 4)
    assert sequence.valid.shape == (count,)
    assert sequence.valid.dtype == np.bool_
    for values in (sequence.time, sequence.gyro, sequence.accel):
        assert values.dtype == np.float64 and np.isfinite(values).all()
    steps = np.diff(sequence.time)
    rate = 1.0 / np.median(steps)
    assert steps.min() > 0 and np.abs(steps * rate - 1.0).max() < 5e-3, "the clock is not uniform"
    assert (
        (10 * 0.999 < rate < 2000 * 1.001)
        if dataset.name == "csv"
        else abs(rate / dataset.rate - 1.0) < 0.06
    ), f"{rate} Hz"
    assert sequence.time[-1] - sequence.time[0] < 2.5 * LAYOUTS[name].shortest, (
        "longer than the recording"
    )
    assert np.abs(sequence.gyro).max() < 110.0, (
        f"gyro reaches {np.abs(sequence.gyro).max():.3g} rad/s"
    )
    assert np.abs(sequence.accel).max() < 1100.0, (
        f"accel reaches {np.abs(sequence.accel).max():.3g} m/s²"
    )
    assert 5.0 < np.median(np.linalg.norm(sequence.accel, axis=1)) < 50.0
    valid = sequence.valid
    np.testing.assert_allclose(np.linalg.norm(sequence.orientation[valid], axis=1), 1.0, atol=1e-9)
    if sequence.device_orientation is not None:
        assert sequence.device_orientation.shape == (count, 4)
        norm = np.linalg.norm(sequence.device_orientation, axis=1)
        np.testing.assert_allclose(norm[np.isfinite(norm)], 1.0, atol=1e-9)
    assert np.isfinite(sequence.position[valid]).all()
    assert np.isfinite(sequence.velocity[valid]).all()
    speed = np.abs(sequence.velocity[valid]).max(initial=0.0)
    assert speed < 330.0, f"velocity reaches {speed:.3g} m/s"
    moved = (
        np.abs(np.diff(sequence.position, axis=0))
        .max(axis=1)[valid[1:] & valid[:-1]]
        .max(initial=0.0)
    )
    assert moved < max(11.0, 330.0 / rate), f"position jumps by {moved:.3g} m"
    assert np.abs(sequence.position[valid]).max(initial=0.0) < 2e8
    assert all(
        isinstance(value, str | float | int | bool) for value in sequence.attributes.values()
    )


def check_refusal(said: str, name: str, happened: list[Damage]) -> None:
    """What was said names a damaged file; or, where files are gone, the root; or the recording,
    which only the self-check refuses."""
    names = [PurePosixPath(damage.file).name for damage in happened]
    gone = any(damage.what in PLACES for damage in happened) and "ROOT" in said
    assert any(file in said for file in names) or gone or "self-check" in said, (
        f"names no damaged file: {said}"
    )
    fields = [
        damage
        for damage in happened
        if damage.what in ("drop field", "rename field", "value", "type", "shape")
    ]
    if len(happened) == 1 and fields and not happened[0].file.endswith(".npy"):
        # Numbers cut to integers are numbers still: the recording as a whole is not trusted.
        cut = happened[0].what == "type" and "can be trusted" in said
        whole = "self-check" in said or cut
        assert re.search(r"(field|column)s? '", said) or whole, f"names no field: {said}"


def check(name: str, happened: list[Damage]) -> tuple[list[Sequence] | InputError, str]:
    result, said = outcome(name, happened)
    if isinstance(result, InputError):
        check_refusal(said, name, happened)
    else:
        for sequence in result:
            check_sequence(sequence, name)
    return result, said
