"""How a trajectory is estimated: the choices of the command line."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, NamedTuple

from gnio_jax.errors import InputError

Estimator = Literal["ekf", "integrate", "imu_only"]
Orientation = Literal["filter", "device", "reference"]
OnShare = Callable[[float], None]
"""Called with the share of the work that is done, from 0 to 1."""


def no_progress(share: float) -> None:
    """An `OnShare` that tells nobody."""


class Setup(NamedTuple):
    """How a trajectory is estimated; everything that changes what a result means."""

    estimator: Estimator = "ekf"
    coupling: Literal["tight", "loose"] = "tight"
    """Only for the ekf."""
    orientation: Orientation | None = None
    """Attitude that rotates the network's windows; None: the filter's where the network is in its
    loop, else the reference's."""
    init: Literal["reference", "static"] = "reference"
    """Start from the reference's pose and velocity, or from the gravity of the first second with
    yaw, velocity and position zero."""
    gyro_bias: Literal["zero", "rest", "reference"] = "zero"
    """First estimate of the gyro bias: none, the mean of a rest at the start, or the first 10 s
    against the reference."""

    @property
    def tightly_coupled(self) -> bool:
        """Whether the network is in the filter's loop."""
        return self.estimator == "ekf" and self.coupling == "tight"


DEFAULT_SETUP = Setup()


def resolve(setup: Setup) -> Setup:
    """`setup` with its orientation filled in. Raises `InputError` for an orientation that the
    estimator cannot use."""
    if not (setup.tightly_coupled or setup.estimator == "imu_only"):
        return setup._replace(orientation=setup.orientation or "reference")
    if setup.orientation not in (None, "filter"):
        what = "the tight coupling" if setup.estimator == "ekf" else "imu_only"
        raise InputError(
            f"--orientation {setup.orientation}",
            f"{what} uses the filter's own attitude",
            "leave it out, or choose --coupling loose or --estimator integrate",
        )
    return setup._replace(orientation="filter")
