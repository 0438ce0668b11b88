"""Short recordings of every layout, damaged and loaded, and what must hold of the result.

What must hold is stated in `check_sequence` and `check_refusal`, without the package's help.
"""

import contextlib
import functools
import re
import signal
import tempfile
import warnings
import zipfile
from pathlib import Path, PurePosixPath

import numpy as np
import pytest

from gnio_jax import data
from gnio_jax.errors import InputError
from tests.support.damage import PLACES, after
from tests.support.layouts import LAYOUTS

SECONDS_PER_EXAMPLE = 20


@functools.cache
def written(name):
    """The files of a layout's undamaged recording, by their paths."""
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        LAYOUTS[name].write(root, LAYOUTS[name].shortest)
        files = sorted(path for path in root.rglob("*") if path.is_file())
        return {path.relative_to(root).as_posix(): path.read_bytes() for path in files}


def write_damaged(name, root, happened):
    contents = dict(written(name))
    for damage in happened:
        if damage.what not in PLACES:
            contents[damage.file] = after(contents[damage.file], damage)
    places = {damage.file: damage.what for damage in happened if damage.what in PLACES}
    for file, content in contents.items():
        path, kind = root / file, places.get(file)
        path.parent.mkdir(parents=True, exist_ok=True)
        if kind == "folder":
            path.mkdir()
        elif kind in ("dangling link", "looping link"):
            path.symlink_to("nowhere" if kind == "dangling link" else path.name)
        elif kind != "delete":
            path.with_name("old_" * (kind == "rename") + path.name).write_bytes(content)


class TooLong(BaseException):
    """No `Exception`, so that no loader can catch it."""


@contextlib.contextmanager
def at_most(seconds):
    def stop(*_):
        raise TooLong(f"no end after {seconds} s")

    # By the processor's time: a busy machine is no fault of the loader.
    before = signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)


IMPOSSIBLE = (LookupError, RuntimeError, ValueError, TypeError, OSError, EOFError)
"""What two damages raise that do not go together."""


def outcome(name, happened):
    """(sequences or the refusal, everything that was said) of a load after the damage."""
    layout = LAYOUTS[name]
    with (
        tempfile.TemporaryDirectory() as folder,
        warnings.catch_warnings(record=True) as warned,
        pytest.MonkeyPatch.context() as patch,
    ):
        warnings.simplefilter("always")
        patch.setenv("GNIO_CACHE", f"{folder}/cache")
        root = Path(folder) / "root"
        root.mkdir()
        try:
            write_damaged(name, root, happened)
        except (*IMPOSSIBLE, zipfile.BadZipFile):
            return [], "two damages that do not go together"
        try:
            with at_most(SECONDS_PER_EXAMPLE):
                result = data.load(layout.dataset, root, layout.split)
        except InputError as error:
            result = error
        messages = [
            str(warning.message) for warning in warned if issubclass(warning.category, UserWarning)
        ]
        messages += [str(result)] if isinstance(result, InputError) else []
        for line in messages:
            assert len(line.splitlines()) == 1, f"not one line: {line!r}"
            assert len(line) < 2000, f"nobody reads {len(line)} characters"
        return result, "\n".join(messages).replace(str(root), "ROOT")


def check_sequence(sequence, name):
    dataset, count, valid = data.get(LAYOUTS[name].dataset), len(sequence.time), sequence.valid
    assert count >= 2 and valid.shape == (count,) and valid.dtype == np.bool_
    for values in (sequence.gyro, sequence.accel, sequence.position, sequence.velocity):
        assert values.shape == (count, 3)
    for values in (sequence.time, sequence.gyro, sequence.accel):
        assert values.dtype == np.float64 and np.isfinite(values).all()
    steps = np.diff(sequence.time)
    rate = 1.0 / np.median(steps)
    assert steps.min() > 0 and np.abs(steps * rate - 1.0).max() < 5e-3, "the clock is not uniform"
    if dataset.name == "csv":
        assert 10 * 0.999 < rate < 2000 * 1.001
    else:
        assert rate == pytest.approx(dataset.rate, rel=0.06)
    assert sequence.time[-1] - sequence.time[0] < 2.5 * LAYOUTS[name].shortest
    assert np.abs(sequence.gyro).max() < 110.0 and np.abs(sequence.accel).max() < 1100.0
    assert 5.0 < np.median(np.linalg.norm(sequence.accel, axis=1)) < 50.0
    for attitude in (sequence.orientation[valid], sequence.device_orientation):
        if attitude is not None:
            assert attitude.shape[1] == 4
            norm = np.linalg.norm(attitude, axis=1)
            finite_rows = np.isfinite(norm)
            np.testing.assert_allclose(norm[finite_rows], 1.0, atol=1e-9)
            assert finite_rows.all() or attitude is sequence.device_orientation
    position, velocity = sequence.position[valid], sequence.velocity[valid]
    assert np.isfinite(position).all() and np.isfinite(velocity).all()
    assert np.abs(velocity).max(initial=0.0) < 330.0
    assert np.abs(position).max(initial=0.0) < 2e8
    moved = np.abs(np.diff(sequence.position, axis=0)).max(axis=1)[valid[1:] & valid[:-1]]
    assert moved.max(initial=0.0) < max(11.0, 330.0 / rate)
    assert all(
        isinstance(value, str | float | int | bool) for value in sequence.attributes.values()
    )


def check_refusal(text, happened):
    """What was said names a damaged file; or, where files are gone, the root; or the recording,
    which only the self-check refuses."""
    gone = any(damage.what in PLACES for damage in happened) and "ROOT" in text
    named = any(PurePosixPath(damage.file).name in text for damage in happened)
    assert named or gone or "self-check" in text, f"names no damaged file: {text}"
    first, of_field = happened[0], ("drop field", "rename field", "value", "type", "shape")
    if len(happened) == 1 and first.what in of_field and not first.file.endswith(".npy"):
        # Numbers cut to integers are numbers still: the recording as a whole is not trusted.
        cut = first.what == "type" and "can be trusted" in text
        whole = "self-check" in text or cut
        assert re.search(r"(field|column)s? '", text) or whole, f"names no field: {text}"


def check(name, happened):
    result, text = outcome(name, happened)
    if isinstance(result, InputError):
        check_refusal(text, happened)
    else:
        for sequence in result:
            check_sequence(sequence, name)
    return result, text
