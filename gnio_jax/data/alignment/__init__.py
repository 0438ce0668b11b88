"""Where an IMU sits on a tracked body, and the reference that follows from it.

An optical tracker gives the poses of a *marker body* on its own clock in its own, slightly tilted
world. The IMU is bolted somewhere else on that body, turned against it, on another clock. `align`
estimates all of it at once from one recording:

    gyro(t + lag(t))      = Rxᵀ ω_marker(t) + b_g
    accel(t + lag(t) + δ) = Rxᵀ R(t)ᵀ (p̈(t) + d²/dt² [R(t) l] − g) + b_a

ω comes from differences of the tracked attitude, p̈ from second differences of the tracked position.
The unknowns are the extrinsic rotation Rx (IMU → marker body), the lever arm l, the biases b_g and
b_a, the direction of gravity g in the tracker's world, a lag that is piecewise linear in time and a
delay δ of the accelerometer against the gyro (phones filter it: 10 to 50 ms).

The steps, a file each: filtered motion of the tracked body (`track`), first guesses of the lag
(`lag`), a robust Gauss-Newton fit of gyro and accelerometer together from each of the best guesses
(`fit`), and the choice of the fit that leaves least unexplained (`mounting`). Both sides of each
equation pass the same Gaussian filter, so that filtering removes noise but biases nothing.

`heading` aligns a tracker that says nothing of the IMU's attitude; `clocks` finds the lag of poses
that are the IMU's own. `attitude` corrects the gyro's drift by accelerations. Attitudes are SciPy
rotations, body→world.
"""

from gnio_jax.data.alignment.attitude import attitude_from_acceleration
from gnio_jax.data.alignment.clocks import PoseLag, pose_lag
from gnio_jax.data.alignment.heading import Heading, align_heading
from gnio_jax.data.alignment.mounting import Alignment, align
from gnio_jax.data.alignment.track import TooLittle, Track

__all__ = [
    "Alignment",
    "Heading",
    "PoseLag",
    "TooLittle",
    "Track",
    "align",
    "align_heading",
    "attitude_from_acceleration",
    "pose_lag",
]
