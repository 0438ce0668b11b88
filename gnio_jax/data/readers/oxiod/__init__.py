"""OxIOD, the Oxford Inertial Odometry Dataset: phones carried through a Vicon room, and two floors
of an office with Tango.

Chen et al., *OxIOD: The Dataset for Deep Inertial Odometry*, 2018, http://deepio.cs.ox.ac.uk. The
way from the published text files to `Sequence`s:

1. *Walks* (`walks`). A walk that is there as `raw` and as `syn` is one walk: `raw` is used, whose
   stamps place every row to 3 ms (in `syn` both streams were put on one 100 Hz grid by repeating
   rows), `syn` where `raw` is absent or refused.
2. *Splits* (`splits`), from the authors' lists or by seeded hold-out.
3. *The phone's text* (`phone`). iPhone: 16 columns, acceleration in G with iOS's sign, so that
   specific force = −(gravity + user_acc)·9.80665. Nexus: rows of one sensor each (`raw`), or ten
   columns (`syn`), m/s² already. The phones sample uniformly (99.92 Hz; the iPhone 5 93.61 Hz) and
   only their stamps are rounded: a line through the stamps restores the time of each row. In `syn`
   the same holds once the repeated rows are dropped.
4. *The tracker's text* (`trackers`). Vicon's stamps are unix ns (`raw`) or destroyed (`syn`).
5. *Alignment* of phone and Vicon (`vicon`, by `gnio_jax.data.alignment`): extrinsic rotation, lever
   arm, level, biases, lag. A fit that does not explain the motion, or finds what no phone on a
   marker body can be, is refused. Orientation: integrated gyro times a robustly smoothed correction
   towards Vicon (σ 0.3 s). Position: Vicon's plus the lever arm, levelled, through Whittaker's
   smoother (half response at 12 Hz); velocity: its derivative. The accelerometer has no part in the
   positions. In `large scale` (`tango`) the truth is a Tango tablet whose attitude is unusable:
   positions are Tango's (half response at 4 Hz), the orientation is integrated gyro, corrected
   slowly until R·accel + g agrees with the second difference of the positions.
6. *The sequence* (`assembly`). `gyro` and `accel` stay the phone's, biases included; they are only
   put on a uniform 100 Hz clock, and the accelerometer's delay against the gyro (6 to 22 ms on an
   iPhone 7 Plus, 44 to 52 ms on an iPhone 5, 2 to 3 ms on a Nexus 5) is taken out.
"""

from __future__ import annotations

from pathlib import Path

from gnio_jax.data.dataset import Dataset, Recording, single
from gnio_jax.data.readers.oxiod.assembly import LICENCE
from gnio_jax.data.readers.oxiod.phone import read_imu
from gnio_jax.data.readers.oxiod.splits import SPLITS, held_out_sessions, select, share_out
from gnio_jax.data.readers.oxiod.tango import build_with_tango
from gnio_jax.data.readers.oxiod.trackers import read_vicon
from gnio_jax.data.readers.oxiod.vicon import build_with_vicon
from gnio_jax.data.readers.oxiod.walks import LARGE_SCALE, LAYOUT, RATE, Walk, find_walks
from gnio_jax.errors import InputError
from gnio_jax.types import Sequence

__all__ = [
    "DATASET",
    "SPLITS",
    "Walk",
    "build",
    "find_walks",
    "held_out_sessions",
    "read_imu",
    "read_vicon",
    "recording_of",
    "recordings",
    "select",
    "share_out",
]


def recordings(root: Path, split: str) -> list[Recording]:
    """The walks of `split` below `root`.

    `train`, `test` (also called `seen`)
        the authors' lists of the single-user scenes; whole sessions (`dataN`) are taken from
        `train` for `val`.
    `unseen`
        other users and other devices: in no list and in no training.
    `large_scale`
        the floors with Tango, in no list either.
    `sessions_train`, `sessions_val`, `sessions_test`
        every walk of the Vicon room, other users and devices among them, shared out by a seeded
        hold-out of whole sessions (`dataN`, `userN`, the device), about 70/10/20 of the time: the
        lists alone leave little to train on in a partial copy. A network trained on these has seen
        users and devices of `unseen`: evaluate it on `sessions_test` alone.
    """
    chosen = select(find_walks(root), split, root)
    if not chosen:
        raise InputError(
            root,
            f"no recording of split '{split}' is present",
            "see the warnings above, or choose another split",
        )
    return [recording_of(walk) for walk in chosen]


def recording_of(walk: Walk) -> Recording:
    """`raw` before `syn`, which is read where `raw` is refused."""
    forms = [
        single(walk.name, build, walk, kind)._replace(files=walk.files[kind], slow=True, form=kind)
        for kind in ("raw", "syn")
        if kind in walk.files
    ]
    return forms[0]._replace(fallback=forms[1]) if len(forms) == 2 else forms[0]


def build(walk: Walk, kind: str) -> Sequence:
    """One walk at 100 Hz. Raises `Refusal` when its files, or the fit of phone and truth, are of no
    use."""
    imu_path, truth_path = walk.files[kind]
    # The phone's stamps survive in the syn files of the large scale.
    imu = read_imu(imu_path, "raw" if walk.scene == LARGE_SCALE else kind)
    with_tango = truth_path.name.startswith("tango")
    build_with = build_with_tango if with_tango else build_with_vicon
    return build_with(walk, kind, imu, truth_path)


DATASET = Dataset(
    name="oxiod",
    recordings=recordings,
    splits=SPLITS,
    rate=RATE,
    source="http://deepio.cs.ox.ac.uk",
    layout=LAYOUT,
    licence=LICENCE,
)
