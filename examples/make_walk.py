"""Writes walk.csv, the recording that `gnio track examples/walk.csv` is tried with: a minute of a
computed person who strolls with the phone in the hand. The heading of a computed phone is
arbitrary. This one looks ahead, as people hold theirs. No split has this person or this seed.

    python examples/make_walk.py

The true path is 49.6 m long in the plane and ends 6.1 m from its start.
"""

from pathlib import Path

import numpy as np

from gnio_jax.data.simulated.walks import pedestrian

SEED, WHO = 63, 363
HEADER = "time,gyro_x,gyro_y,gyro_z,accel_x,accel_y,accel_z"


def main() -> None:
    walk = pedestrian(SEED, WHO, seconds=60.0, rate=100.0)
    rows = np.column_stack([walk.time, walk.gyro, walk.accel])
    out = Path(__file__).with_name("walk.csv")
    formats = ["%.3f"] + ["%.5f"] * 3 + ["%.4f"] * 3
    np.savetxt(out, rows, fmt=formats, delimiter=",", header=HEADER, comments="")
    seconds = walk.position[::100, :2]
    length = np.linalg.norm(np.diff(seconds, axis=0), axis=1).sum()
    end = np.linalg.norm((walk.position[-1] - walk.position[0])[:2])
    print(f"{out}: {walk.attributes['placement']}, {length:.1f} m, ends {end:.1f} m from its start")


if __name__ == "__main__":
    main()
