"""The legs of the mall's walks by the magnetometer alone: no walk is turned to its waypoints.

    python -m benchmarks.mall_heading --data-root DIR [--network pedestrian] [--split test]

Each walk starts level, with yaw and position zero. Its yaw against the building is that of the
horizontal field, plus one angle between field and map that all walks share. For each walk this is
the mean angle of the other walks, after each of them is turned to its waypoints. Printed are
medians over the walks of the rms error of the legs as vectors and of their directions: with the
turn of each walk to its waypoints, with the one angle, and with the one angle and the field as a
measurement of the filter all along the walk.
"""

from __future__ import annotations

import argparse

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np  # noqa: E402

from gnio_jax import data, filtering, networks  # noqa: E402
from gnio_jax.errors import InputError  # noqa: E402
from gnio_jax.evaluation import estimate, prepare  # noqa: E402
from gnio_jax.evaluation.trajectory import positions_at  # noqa: E402
from gnio_jax.models import Network  # noqa: E402
from gnio_jax.numerics import matrix_from_quaternion  # noqa: E402

LEAST_LEG = 1.0
"""Shorter legs have no direction, m."""


def legs_of(points: np.ndarray) -> np.ndarray:
    """(k,) legs between points (k + 1, 2), as complex numbers, m."""
    return np.diff(points[:, 0] + 1j * points[:, 1])


def best_turn(legs: np.ndarray, true: np.ndarray) -> float:
    """The turn of legs that brings them nearest to the true ones in least squares, rad."""
    return float(np.angle(np.sum(true * legs.conj())))


def errors(legs: np.ndarray, true: np.ndarray) -> tuple[float, float]:
    """Root mean square of the differences, m, and of the directions, degrees."""
    long = np.abs(true) > LEAST_LEG
    directions = np.degrees(np.angle(legs[long] * true[long].conj()))
    return float(np.sqrt(np.mean(np.abs(legs - true) ** 2))), float(np.sqrt(np.mean(directions**2)))


def field_legs(split: str, root: str | None, name: str) -> list[tuple[np.ndarray, ...]]:
    """Of every walk: legs without the magnetometer and with it, turned so that the field points
    along x, and the true legs. A walk without a field, or with one that is not the earth's, is left
    out."""
    trained = networks.load(name)
    network, windows = Network.of(trained.model, trained.variables), trained.config.data
    ekf = filtering.make_filter(windows, trained.config.filter)
    walks = {walk.name: walk for walk in data.load("indoor_location", root, split)}
    ready, _ = prepare(walks.values(), windows, ekf, init="static", gyro_bias="rest")
    paths = estimate(ready, network, windows, ekf, 8)
    rows, oriented_paths = [], []
    for recording, path in zip(ready, paths, strict=True):
        walk = walks[recording.name]
        if "magnetometer" not in walk.readings:
            print(f"left out: {walk.name} has no magnetometer")
            continue
        field = walk.readings["magnetometer"]
        rotation = matrix_from_quaternion(path.trajectory.orientation[1:])
        stamps = field.time, field.values, rotation, ekf.config, walk.time[0]
        try:
            fit = filtering.fit_field(*stamps)
        except InputError as error:
            print(f"left out: {error}")
            continue
        rows.append(recording._replace(measurements=(fit.rows,)))
        oriented_paths.append((path, fit.rows.direction[0]))
    results = []
    for (without, azimuth), with_field in zip(
        oriented_paths, estimate(rows, network, windows, ekf, 8), strict=True
    ):
        taps = without.waypoints
        legs = [
            legs_of(positions_at(path.trajectory, taps.time)) * np.exp(-1j * azimuth)
            for path in (without, with_field)
        ]
        true = legs_of(taps.position)
        present = np.isfinite(legs[0]) & np.isfinite(legs[1])
        results.append((*(part[present] for part in legs), true[present]))
    return results


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data-root", help="the mall's folder, as for gnio evaluate")
    parser.add_argument("--network", default="pedestrian")
    parser.add_argument("--split", default="test")
    arguments = parser.parse_args()
    walks = field_legs(arguments.split, arguments.data_root, arguments.network)
    turns = np.array([best_turn(legs, true) for legs, _, true in walks])
    units = np.exp(1j * turns)
    angles = np.angle(units.sum() - units)  # of the other walks
    off = np.degrees(np.abs(np.angle(np.exp(1j * (turns - angles)))))
    mean = np.degrees(np.angle(units.mean()))
    print(
        f"{len(walks)} walks, field to map {mean:.1f} degrees, off by "
        f"{np.median(off):.1f} in the median and by {np.percentile(off, 90):.1f} in one of ten"
    )
    table = {"each walk turned": [], "one angle": [], "one angle, field in the filter": []}
    for (without, with_field, true), turn, angle in zip(walks, turns, angles, strict=True):
        legs = (without * np.exp(1j * x) for x in (turn, angle))
        for values, candidate in zip(
            table.values(), (*legs, with_field * np.exp(1j * angle)), strict=True
        ):
            values.append(errors(candidate, true))
    for name, values in table.items():
        metres, degrees = np.median(values, axis=0)
        print(f"  {name}: legs {metres:.2f} m, directions {degrees:.1f} degrees")


if __name__ == "__main__":
    main()
