"""A CSV of one's own: its reference, its sign, its rate; and what is no file."""

from __future__ import annotations

import os
import threading

import numpy as np
import pytest

from gnio_jax.apps.importing.kept import read_imported, write_imported
from gnio_jax.data.readers import csv_files
from gnio_jax.errors import InputError
from tests.support.csv_writers import AXES, imu, write, write_native
from tests.support.importing import import_recording, imported


@pytest.mark.parametrize("velocity", [False, True])
def test_the_reference_of_the_package_s_own_form_is_kept(tmp_path, velocity):
    path = write_native(tmp_path / "walk.csv", velocity=velocity)
    (by_dataset,) = csv_files.read(path)
    sequence, notes = import_recording(path)
    assert by_dataset.valid.all() and sequence.valid.all()
    assert "reference from given, 100% of the time" in notes
    for field in ("orientation", "position", "velocity"):
        expected = getattr(by_dataset, field)
        np.testing.assert_allclose(getattr(sequence, field), expected, atol=1e-6)


def test_a_reference_that_cannot_be_one_is_left_out_with_a_note(tmp_path):
    def tilted(columns):
        columns["qw"], columns["qx"] = columns["qx"], columns["qw"]

    def halved(columns):
        columns["qw"] = columns["qw"] / 2.0

    for spoil, words in (
        (tilted, "the reference given does not fit the IMU"),
        (halved, "not a unit quaternion"),
    ):
        path = write_native(tmp_path / "walk.csv", spoil=spoil)
        sequence, notes = import_recording(path)
        assert not sequence.valid.any() and sequence.attributes["truth"] == "none"
        (note,) = (note for note in notes if note.startswith("no reference is taken: "))
        assert words in note
    sequence, notes = import_recording(write_native(tmp_path / "walk.csv", drop=("py",)))
    assert not sequence.valid.any()
    assert any("column 'py' is missing while 'px' is there" in note for note in notes)


def test_gravity_on_minus_z_is_a_warning_unless_the_sign_is_stated(tmp_path):
    def negate(columns):
        for name in AXES[3:]:
            columns[name] = -columns[name]

    path = write_native(tmp_path / "ios.csv", reference=False, spoil=negate)
    found = imported(path)
    (warning,) = found.warnings
    assert warning.startswith("sign: gravity reads on -z in ios.csv: ")
    assert warning.endswith("compare with --accel-sign ios")
    write_imported(tmp_path / "ios.h5", found)
    assert read_imported(tmp_path / "ios.h5").warnings == found.warnings
    assert imported(path, accel_sign="android").warnings == ()
    assert imported(path, accel_sign="ios").warnings == ()
    assert imported(write_native(tmp_path / "walk.csv")).warnings == ()


@pytest.mark.parametrize("rate", [10.5, 40.0, 48.0, 60.0])
def test_slow_recordings_with_jitter_have_no_holes(tmp_path, rate):
    """Each sensor on its own stamps, which jitter by a fifth of an interval."""
    draw = np.random.default_rng(3)
    stamps = np.arange(round(14.0 * rate)) / rate
    gyro, accel = (stamps + draw.uniform(-0.2, 0.2, len(stamps)) / rate for _ in range(2))
    write(tmp_path / "gyro.csv", ["time", *AXES[:3]], [gyro, *imu(gyro)[:, :3].T])
    write(tmp_path / "accel.csv", ["time", *AXES[3:]], [accel, *imu(accel)[:, 3:].T])
    given = {"accel_path": tmp_path / "accel.csv", "gyro_unit": "rad/s"}
    sequence, notes = import_recording(tmp_path / "gyro.csv", **given)
    assert sequence.imu_valid is None
    assert not any("lacks samples" in note for note in notes)
    assert any("which is slow" in note for note in notes) == (rate < 50.0)


def test_a_pipe_is_refused_in_one_true_line(tmp_path):
    """It is read more than once, which a pipe is not."""
    pipe = tmp_path / "walk.csv"
    os.mkfifo(pipe)
    # Without a writer, whoever opens the pipe waits for ever.
    writer = threading.Thread(target=lambda: pipe.open("w").close(), daemon=True)
    writer.start()
    with pytest.raises(InputError) as caught:
        import_recording(pipe)
    assert str(caught.value) == (
        f"{pipe}: can be read only once, as a pipe can; save the recording as a file"
    )
