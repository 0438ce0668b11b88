"""Replay a recording through the online filter.

python examples/replay_csv.py --csv walk.csv
"""

import gc
import os
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")

import jax
import numpy as np

from gnio_jax.commands import console, options
from gnio_jax.errors import InputError
from gnio_jax.files import check_other_file


@dataclass(frozen=True)
class Replay:
    csv: str
    """The recording: a CSV, or the package's HDF5 (.h5)."""
    network: str | None = None
    """Name, package or run folder; by default the network that comes with gnio-jax, else the newest
    run below runs/."""
    out: str | None = None
    """File of the trajectory; by default <recording>_trajectory.txt in the working folder."""
    realtime: bool = False
    """Push each sample at its own time, as if the recording happened now."""
    rest_seconds: float = 1.0
    """How long the device is still at the start, s."""


class ImuSamples(NamedTuple):
    """Samples as they were recorded, not resampled. A missing sample is NaN."""

    time: np.ndarray
    """(n,) s"""
    gyro: np.ndarray
    """(n, 3) rad/s"""
    accel: np.ndarray
    """(n, 3) m/s²"""

    @property
    def interval(self) -> float:
        """Median time between two samples, s."""
        return float(np.median(np.diff(self.time)))


@dataclass
class ReplayResult:
    """Poses of a replay, and how long each push took in s."""

    poses: list = field(default_factory=list)
    clone_steps: list[float] = field(default_factory=list)
    other_samples: list[float] = field(default_factory=list)


def read(path: Path) -> ImuSamples:
    """Read a CSV or HDF5. Raises `InputError` if a stamp is missing or does not increase."""
    from gnio_jax.apps.live.sources import recorded_samples
    from gnio_jax.data.hdf5 import read_hdf5
    from gnio_jax.data.parsing.tables import read_text
    from gnio_jax.data.validation import check_increasing

    if path.suffix.lower() in (".h5", ".hdf5"):
        return ImuSamples(*recorded_samples(read_hdf5(path)))
    table = read_text(path)
    stamps = table.take("time")  # every sample needs one
    check_increasing(stamps, path)
    # A sensor that missed a sample leaves its columns empty.
    gyro, accel = table.axes("gyro_", gaps=True), table.axes("accel_", gaps=True)
    return ImuSamples(stamps, gyro, accel)


def create_tracker(run, recorded: ImuSamples, rest_seconds: float):
    """The compiled tracker of a trained run, which starts from rest."""
    from gnio_jax.apps.live.tracking import create_tracker as create

    try:
        return create(run, 1 / recorded.interval, rest_seconds)
    except ValueError as error:
        raise InputError("--rest-seconds", str(error)) from None


def replay(tracker, recorded: ImuSamples, path: Path, realtime: bool, progress) -> ReplayResult:
    """Push every sample and time each push."""
    result, start = ReplayResult(), recorded.time[0]
    gc.collect()
    gc.freeze()  # existing objects need no further look by the collector
    begin = time.perf_counter()
    for k, stamp in enumerate(recorded.time):
        if realtime:
            time.sleep(max(0.0, stamp - start - (time.perf_counter() - begin)))
        push_start = time.perf_counter()
        try:
            pose = tracker.push(stamp, recorded.gyro[k], recorded.accel[k])
        except ValueError as error:
            raise InputError(f"{path} row {k + 1}", str(error)) from None
        seconds = time.perf_counter() - push_start
        if pose is None:
            result.other_samples.append(seconds)
        else:
            result.clone_steps.append(seconds)
            result.poses.append(pose)
        if k % 100 == 0:
            progress(f"replaying {stamp - start:.0f} s", (k + 1) / len(recorded.time))
    return result


def write_trajectory(out: Path, name: str, poses: list) -> np.ndarray:
    """Write the TUM file and the picture; returns the positions (poses, 3)."""
    from gnio_jax import drawing
    from gnio_jax.evaluation import SequenceEstimate, Trajectory, plots
    from gnio_jax.evaluation.trajectory import write_tum
    from gnio_jax.evaluation.views import make_view
    from gnio_jax.files import replacing

    position = np.array([pose.position for pose in poses])
    orientation = np.array([quaternion(pose.rotation) for pose in poses])
    trajectory = Trajectory(np.array([pose.time for pose in poses]), position, orientation)
    no_reference = Trajectory(
        trajectory.time, np.full_like(position, np.nan), np.full_like(orientation, np.nan)
    )
    with replacing(out) as temporary:
        write_tum(temporary, trajectory)
    view = make_view(SequenceEstimate(name, trajectory, no_reference), alignment="none")
    drawing.save(out.with_suffix(".png"), plots.sequence(view))
    return position


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """wxyz of a rotation matrix; NaN if the matrix is not finite."""
    from scipy.spatial.transform import Rotation

    if not np.isfinite(rotation).all():
        return np.full(4, np.nan)
    return Rotation.from_matrix(rotation).as_quat(scalar_first=True)


def summarise(
    replayed: ReplayResult, recorded: ImuSamples, position: np.ndarray, compiled: float
) -> None:
    """Print the length of the walk, the speed and the latencies."""
    poses = replayed.poses
    length = float(np.linalg.norm(np.diff(position, axis=0), axis=1).sum())
    rejected = sum(pose.accepted == 0 for pose in poses)
    computing = sum(replayed.clone_steps) + sum(replayed.other_samples)
    duration = recorded.time[-1] - recorded.time[0]
    verdict = "" if poses[-1].healthy else "; the filter DIVERGED"
    print(
        f"{duration:.1f} s, {len(poses)} poses, {length:.1f} m walked, "
        f"{rejected} measurements rejected{verdict}"
    )
    print(
        f"real-time factor {duration / computing:.1f} (computing took {computing:.2f} s), "
        f"compiled in {compiled:.1f} s"
    )
    kinds = {"clone step": replayed.clone_steps, "other sample": replayed.other_samples}
    for kind, seconds in kinds.items():
        if seconds:
            p50, p99, longest = 1e3 * np.percentile(seconds, [50, 99, 100])
            print(
                f"latency of a push with a {kind}: "
                f"p50 {p50:.3f} ms, p99 {p99:.3f} ms, max {longest:.3f} ms"
            )


def main() -> None:
    console.run(lambda: options.run(follow, options.Call("python replay_csv.py", sys.argv[1:])))


def follow(request: Replay, _call: options.Call) -> None:
    """Feed a recording to gnio_jax.filtering.Tracker sample by sample, like an app on a phone.

    The CSV has a header with time (s), gyro_x..z (rad/s) and accel_x..z (m/s2, +9.81 upwards at
    rest). A file named .h5 is read as the package's own format. `gnio data import` converts the
    file of a phone's logger into either. The stamps may be irregular; empty cells are missing
    samples. Keep the device still for the first second: the tilt is taken from it.

    The results are the trajectory in TUM format, one pose for each clone step, and a picture of it
    (.png) beside it.

    examples:
      python examples/replay_csv.py --csv examples/walk.csv
      python examples/replay_csv.py --network runs/mine --csv walk.csv --out walk.txt
      python examples/replay_csv.py --network runs/mine --csv walk.h5 --realtime
    """
    # The filter needs float64. The network states its float32 everywhere.
    jax.config.update("jax_enable_x64", True)
    path, out = Path(request.csv), Path(request.out or f"{Path(request.csv).stem}_trajectory.txt")
    check_other_file(out, path)
    recorded = read(path)

    from gnio_jax import networks

    run = networks.load(request.network)
    if len(recorded.time) < 2:
        raise InputError(path, "holds a single sample", "record a walk of some seconds")
    with console.terminal() as terminal:
        progress = terminal.progress
        progress("compiling", 0.0)
        begin = time.perf_counter()
        tracker = create_tracker(run, recorded, request.rest_seconds)
        compiled = time.perf_counter() - begin
        replayed = replay(tracker, recorded, path, request.realtime, progress)
    if not replayed.poses:
        raise InputError(
            path,
            f"ends before the device was still for {request.rest_seconds:g} s "
            "without a missing sample",
            "record longer, or give a smaller --rest-seconds",
        )

    position = write_trajectory(out, path.stem, replayed.poses)
    summarise(replayed, recorded, position, compiled)
    if tracker.delay:
        rate = run.config.data.rate
        print(
            f"low-pass from {1 / recorded.interval:.4g} Hz to {rate:.4g} Hz: "
            f"poses come {1e3 * tracker.delay:.0f} ms later"
        )
    print(f"trajectory: {out}\npicture: {out.with_suffix('.png')}")


if __name__ == "__main__":
    main()
