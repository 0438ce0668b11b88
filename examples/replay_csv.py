"""Replay a recording through the online filter: python examples/replay_csv.py --workdir runs/mine
--csv walk.csv."""

import gc
import os
import time
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")

import jax
import numpy as np

from gnio_jax import config as configuration
from gnio_jax.commands import console as cli
from gnio_jax.types import InputError

DESCRIPTION = """Feed a recording to gnio_jax.filtering.Tracker sample by sample, as an app on a phone would.

  python examples/replay_csv.py --csv walk.csv                       (the newest run below runs/)
  python examples/replay_csv.py --workdir runs/mine --csv walk.csv --out walk.txt
  python examples/replay_csv.py --workdir runs/mine --csv walk.h5 --realtime

The CSV has a header with time (s), gyro_x..z (rad/s) and accel_x..z (m/s2, +9.81 upwards at rest); .h5 is the package's own
format. python -m gnio_jax.data import brings a phone logger's file into either. The stamps may be irregular; empty cells are
missing samples. The device should lie or be held still for the first second, from which the tilt is taken.

Left behind are the trajectory in TUM format, a pose every clone step, and beside it its picture (.png)."""


@dataclass(frozen=True)
class Replay:
    csv: str
    """The recording: a CSV, or the package's HDF5 (.h5)."""
    workdir: str | None = None
    """Folder of the run whose network is used; without it the newest below runs/."""
    out: str | None = None
    """Where the trajectory goes; without it <recording>_trajectory.txt in the present folder."""
    realtime: bool = False
    """Wait for each sample's time, as if the recording happened now."""
    rest_seconds: float = 1.0
    """How long the device is still at the start, s."""


def read(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Stamps (n,), gyro (n, 3) and accel (n, 3) as they were recorded, not yet resampled."""
    from gnio_jax.data.readers.text import numbers, read_csv
    from gnio_jax.data.sequence import check_increasing, read_hdf5

    if path.suffix.lower() in (".h5", ".hdf5"):
        sequence = read_hdf5(path)
        return sequence.time, sequence.gyro, sequence.accel
    table = read_csv(path)
    stamps = numbers(table, ["time"], path)[:, 0]
    if not np.isfinite(stamps).all():
        raise InputError(
            path,
            f"field 'time' is empty in row {int(np.argmin(np.isfinite(stamps))) + 1}",
            "every sample needs a time",
        )
    check_increasing(stamps, path)
    gyro, accel = (
        numbers(table, [f"{sensor}_{axis}" for axis in "xyz"], path) for sensor in ("gyro", "accel")
    )
    return stamps, gyro, accel


def main() -> None:
    jax.config.update(
        "jax_enable_x64", True
    )  # the filter needs float64; the network states its float32 everywhere
    options = cli.parse(Replay, description=DESCRIPTION)
    path = Path(options.csv)
    stamps, gyro, accel = read(path)

    from gnio_jax import models
    from gnio_jax.evaluation import Estimate, Trajectory, filter_setup, plots
    from gnio_jax.evaluation.tum import write_tum
    from gnio_jax.files import replacing
    from gnio_jax.filtering import Tracker
    from gnio_jax.training import checkpoint

    run = checkpoint.load_run(
        Path(options.workdir) if options.workdir else configuration.newest_run()
    )
    config, noise, std = filter_setup(run.config.data, run.config.filter)
    if len(stamps) < 2:
        raise InputError(path, "holds a single sample", "record a walk of some seconds")
    interval = float(np.median(np.diff(stamps)))
    hole = 1.5 * max(config.dt, interval)

    frozen = models.freeze(
        run.model, run.variables
    )  # what depends on the weights alone is computed once

    def predict(windows):
        return models.Inference(run.model)(frozen, windows)

    with cli.progress() as progress:
        progress("compiling", 0.0)
        begin = time.perf_counter()
        try:
            tracker = Tracker.from_rest(
                predict, config, noise, options.rest_seconds, std, hole, imu_rate=1 / interval
            )
        except ValueError as error:
            raise InputError("--rest-seconds", str(error)) from None
        compiled = time.perf_counter() - begin
        poses, of_step, of_push = [], [], []
        gc.collect()
        gc.freeze()  # the collector need not look at what is there already
        begin = time.perf_counter()
        for k, stamp in enumerate(stamps):
            if options.realtime:
                time.sleep(max(0.0, stamp - stamps[0] - (time.perf_counter() - begin)))
            before = time.perf_counter()
            try:
                pose = tracker.push(stamp, gyro[k], accel[k])
            except ValueError as error:
                raise InputError(f"{path} row {k + 1}", str(error)) from None
            (of_push if pose is None else of_step).append(time.perf_counter() - before)
            if pose is not None:
                poses.append(pose)
            if k % 100 == 0:
                progress(f"replaying {stamp - stamps[0]:.0f} s", (k + 1) / len(stamps))
    if not poses:
        raise InputError(
            path,
            f"ends before the device was still for {options.rest_seconds:g} s without a missing sample",
            "record longer, or give a smaller --rest-seconds",
        )

    estimated = Trajectory(
        *(
            np.array(column)
            for column in zip(
                *[(pose.time, pose.position, quaternion(pose.rotation)) for pose in poses],
                strict=True,
            )
        )
    )
    out = Path(options.out or f"{path.stem}_trajectory.txt")
    with replacing(out) as temporary:
        write_tum(temporary, estimated)
    unknown = Trajectory(
        estimated.time,
        np.full_like(estimated.position, np.nan),
        np.full_like(estimated.orientation, np.nan),
    )
    picture = out.with_suffix(".png")
    with replacing(picture) as temporary:
        plots.save(
            temporary,
            plots.trajectory(Estimate(path.stem, estimated, unknown), alignment="none"),
        )

    length = float(np.linalg.norm(np.diff(estimated.position, axis=0), axis=1).sum())
    rejected = sum(pose.accepted == 0 for pose in poses)
    worked = sum(of_step) + sum(of_push)
    lasted = stamps[-1] - stamps[0]
    print(
        f"{lasted:.1f} s, {len(poses)} poses, {length:.1f} m walked, {rejected} measurements rejected"
        + ("" if poses[-1].healthy else "; the filter DIVERGED")
    )
    print(
        f"real-time factor {lasted / worked:.1f} (computing took {worked:.2f} s), compiled in {compiled:.1f} s"
    )
    for what, seconds in (("clone step", of_step), ("other sample", of_push)):
        if seconds:
            p50, p99, most = 1e3 * np.percentile(seconds, [50, 99, 100])
            print(
                f"latency of a push with a {what}: p50 {p50:.3f} ms, p99 {p99:.3f} ms, max {most:.3f} ms"
            )
    if tracker.delay:
        print(
            f"low-pass from {1 / interval:.4g} Hz to {1 / config.dt:.4g} Hz: "
            f"poses come {1e3 * tracker.delay:.0f} ms later"
        )
    print(f"trajectory: {out}\npicture: {picture}")


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """wxyz of a rotation matrix; NaN of one that is not finite."""
    from scipy.spatial.transform import Rotation

    return (
        Rotation.from_matrix(rotation).as_quat(scalar_first=True)
        if np.isfinite(rotation).all()
        else np.full(4, np.nan)
    )


if __name__ == "__main__":
    cli.run(main)
