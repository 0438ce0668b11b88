"""Walks with and without the phone's magnetometer.

    python -m benchmarks.magnetometer --dataset oxiod --split unseen [--network pedestrian]
    python -m benchmarks.magnetometer --dataset tyrex --split test --names '*iPhone*'

As in `gnio track`, each walk starts level, with yaw, velocity and position zero, and with the
gyro's bias of a rest if there is one; the field, the phone's own and the gyro's bias are fitted
along the path without the magnetometer, which is left out if the field does not turn as the phone
does or if the filter refuses more than half of it. The reference is used for the errors alone.

Printed are, for each walk, the root mean square error of the yaw and the ATE in the plane, both
after the alignment at the start, without and with the magnetometer, and the share of its
measurements that the filter used; then medians and means over the walks, and how many of them have
a smaller error with it. A walk without readings is left out.
"""

from __future__ import annotations

import argparse
import fnmatch

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np  # noqa: E402

from gnio_jax import data, filtering, networks  # noqa: E402
from gnio_jax.apps import sensors  # noqa: E402
from gnio_jax.data.sensors import MAGNETOMETER  # noqa: E402
from gnio_jax.errors import InputError  # noqa: E402
from gnio_jax.evaluation import SequenceEstimate, estimate, metrics, prepare  # noqa: E402
from gnio_jax.models import Network  # noqa: E402
from gnio_jax.types import Sequence  # noqa: E402

METRICS = ("yaw_rmse", "ate_2d")


def estimate_both(
    walks: list[Sequence], name: str
) -> tuple[list[SequenceEstimate], list[SequenceEstimate]]:
    """The walks without and with their magnetometers; where a magnetometer is left out, the walk
    with it is the one without."""
    trained = networks.load(name)
    network, windows = Network.of(trained.model, trained.variables), trained.config.data
    ekf = filtering.make_filter(windows, trained.config.filter)
    ready, _ = prepare(walks, windows, ekf, init="static", gyro_bias="rest", from_first=True)
    without = estimate(ready, network, windows, ekf, 8)
    readings, rows = {walk.name: walk.readings[MAGNETOMETER] for walk in walks}, []
    for recording, path in zip(ready, without, strict=True):
        try:
            field = sensors.fit_magnetometer(readings[recording.name], path, recording, ekf)
        except InputError as error:
            print(f"left out: {recording.name}: {error}")
        else:
            rows.append(recording._replace(start=field.start, measurements=(field.rows,)))
    runs = estimate(rows, network, windows, sensors.without_considered_bias(ekf), 8)
    accepted_runs = {run.name: run for run in runs if share_used(run) >= sensors.LEAST_ACCEPTED}
    return without, [accepted_runs.get(path.name, path) for path in without]


def share_used(path: SequenceEstimate) -> float:
    """Share of the measurements of a magnetometer that the filter used; NaN if it was left out."""
    accepted = path.accepted.get("magnetometer")
    return np.nan if accepted is None else float(np.nanmean(accepted))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--dataset", default="oxiod")
    parser.add_argument("--split", default="unseen")
    parser.add_argument("--data-root", help="the dataset's folder, as for gnio evaluate")
    parser.add_argument("--network", default="pedestrian")
    parser.add_argument("--names", default="*", help="walks to measure, a pattern of their names")
    arguments = parser.parse_args()
    walks = []
    for walk in data.load(arguments.dataset, arguments.data_root, arguments.split):
        if not fnmatch.fnmatchcase(walk.name, arguments.names):
            continue
        if MAGNETOMETER in walk.readings:
            walks.append(walk)
        else:
            print(f"left out: {walk.name} has no magnetometer")
    runs = estimate_both(walks, arguments.network)
    scores = [metrics.score(run) for run in runs]
    errors = np.array(
        [[[score[w.name].values[name] for name in METRICS] for score in scores] for w in walks]
    )
    for walk, (without, with_field), path in zip(walks, errors, runs[1], strict=True):
        used = share_used(path)
        use = "left out" if np.isnan(used) else f"{used:.0%} of its measurements used"
        print(
            f"{walk.name}: yaw {without[0]:.1f} -> {with_field[0]:.1f} degrees, ATE 2-D "
            f"{without[1]:.2f} -> {with_field[1]:.2f} m, {use}"
        )
    better = (errors[:, 1] < errors[:, 0]).sum(axis=0)
    for kind, summarise in (("medians", np.median), ("means", np.mean)):
        without, with_field = summarise(errors, axis=0)
        print(
            f"{len(walks)} walks, {kind}: yaw {without[0]:.1f} -> {with_field[0]:.1f} degrees, "
            f"ATE 2-D {without[1]:.2f} -> {with_field[1]:.2f} m"
        )
    print(f"{better[0]} walks have a smaller error of the yaw, {better[1]} a smaller ATE")


if __name__ == "__main__":
    main()
