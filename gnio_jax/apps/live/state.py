"""What the page of a stream shows."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from gnio_jax.apps.live.checks import Nature
from gnio_jax.apps.live.session import Followed

MOST_POINTS = 20_000
"""Points of the path in one answer, at most."""


def describe(
    result: Followed, nature: Nature, network: str, holds_rest: bool, first: int
) -> dict[str, Any]:
    """What the page shows, with the points of the path from number `first` on.

    `holds_rest` says whether the filter measures a velocity of zero at rest.
    """
    pose, last = result.pose, min(len(result.points), first + MOST_POINTS)
    shown: dict[str, Any] = {
        "source": nature.name,
        "network": network,
        "waiting": result.waiting,
        "state": "waiting",
        "points": [[round(x, 2), round(y, 2)] for x, y in result.points[first:last]],
        "next": last,
        "samples": result.samples,
        "refused": result.refused,
        "reason": result.reasons[1],
        "messages": list(result.notices),
        "warnings": result.warnings(),
    }
    if pose is None:
        return shown
    begin = result.path[0] if result.path else pose.time
    numbers = (pose.position, pose.velocity, pose.rotation, pose.covariance)
    if not pose.healthy or not all(np.isfinite(values).all() for values in numbers):
        return shown | {"state": "diverged", "reason": pose.failure}
    covariance = pose.covariance[6:8, 6:8]
    return shown | {
        "state": "at rest" if result.at_rest else "moving",
        "holds_rest": holds_rest,
        "seconds": round(pose.time - begin, 2),
        "position": [round(float(axis), 3) for axis in pose.position],
        "yaw": round(math.atan2(pose.rotation[1, 0], pose.rotation[0, 0]), 4),
        "speed": round(math.hypot(*pose.velocity[:2]), 3),
        "walked": round(result.distance, 2),
        "sigma": round(math.sqrt(max(float(np.trace(covariance)), 0.0)), 3),
        "covariance": [round(float(entry), 6) for entry in covariance[[0, 0, 1], [0, 1, 1]]],
    }
