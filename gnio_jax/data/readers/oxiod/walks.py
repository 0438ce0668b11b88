"""Which walks there are: `<scene>/<dataN | userN | device>/{raw,syn}/imuK.csv` beside `viK.csv`."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from gnio_jax.errors import InputError

RATE = 100.0
"""Hz."""
SINGLE_USER = ("handheld", "pocket", "handbag", "trolley", "running", "slow walking")
UNSEEN = ("multi users", "multi devices")
LARGE_SCALE = "large scale"
LAYOUT = (
    "<scene>/<dataN|userN|device>/{raw,syn}/imuK.csv with viK.csv (or handK.csv, tangoK.csv); "
    "<scene>/{Train,Test}.txt"
)
_TRUTHS = ("vi", "hand", "tango")
_BYTES_PER_ROW = 140.0


class Walk(NamedTuple):
    """One walk: the files of one recording."""

    scene: str
    folder: str
    """dataN, userN or the device."""
    number: int
    files: dict[str, tuple[Path, Path]]
    """kind ("raw", "syn") -> (imu, truth)."""
    placement: str

    @property
    def session(self) -> str:
        """What splits never divide."""
        return f"{self.scene}/{self.folder}"

    @property
    def name(self) -> str:
        """Unique within the dataset."""
        return f"{self.scene}_{self.folder}_{self.number}".replace(" ", "-")

    @property
    def minutes(self) -> float:
        """Rough length by the size of the file, for sharing out walks without reading them."""
        imu, _ = next(iter(self.files.values()))
        return imu.stat().st_size / (_BYTES_PER_ROW * RATE * 60.0)


def find_walks(root: Path) -> list[Walk]:
    """Every walk below `root`, whose scenes may lie some folders deeper. Raises `InputError` when
    there is none."""
    walks = []
    for scene in (*SINGLE_USER, *UNSEEN, LARGE_SCALE):
        for place in scene_folders(root, scene):
            for folder in sorted(path for path in place.iterdir() if path.is_dir()):
                walks += _walks_of(scene, folder)
    if not walks:
        raise InputError(root, "holds no recording of OxIOD", f"expected layout: {LAYOUT}")
    return walks


def scene_folders(root: Path, scene: str) -> list[Path]:
    """The folder of a scene, or none."""
    for depth in ("", "*/", "*/*/"):
        found = sorted(path for path in root.glob(f"{depth}{scene}") if path.is_dir())
        if found:
            return found[:1]
    return []


def _walks_of(scene: str, folder: Path) -> list[Walk]:
    files: dict[int, dict[str, tuple[Path, Path]]] = {}
    # `raw` of the large scale is another format, without Tango's pairs.
    for kind in ("syn",) if scene == LARGE_SCALE else ("raw", "syn"):
        for imu in sorted((folder / kind).glob("imu*.csv")):
            match = re.fullmatch(r"imu(\d+)\.csv", imu.name)
            if match is None:
                continue
            truth = _truth_beside(imu, match[1])
            if truth is None:
                warnings.warn(
                    f"{imu}: has no vi, hand or tango file beside it; left out", stacklevel=2
                )
                continue
            files.setdefault(int(match[1]), {})[kind] = (imu, truth)
    placement_of = _placements(scene, folder)
    return [
        Walk(scene, folder.name, number, kinds, placement_of(number))
        for number, kinds in sorted(files.items())
    ]


def _truth_beside(imu: Path, number: str) -> Path | None:
    candidates = (imu.with_name(f"{name}{number}.csv") for name in _TRUTHS)
    return next((path for path in candidates if path.is_file()), None)


def _placements(scene: str, folder: Path) -> Callable[[int], str]:
    """Where the phone was in the walk of a number.

    The scene says it. For other users a note of lines like "3-5: pocket" does, where there is one.
    """
    if scene in SINGLE_USER:
        return lambda number: {"running": "handheld", "slow walking": "handheld"}.get(scene, scene)
    if scene == LARGE_SCALE:
        return lambda number: "handheld"
    notes = [path for path in folder.glob("*/*.txt") if path.stem.lower() == "readme"]
    text = notes[0].read_text(encoding="utf-8", errors="replace") if notes else ""
    spans = [
        (int(first), int(last), name)
        for first, last, name in re.findall(r"(\d+)\s*-\s*(\d+)\s*:\s*(\w+)", text)
    ]
    return lambda number: next(
        (name for first, last, name in spans if first <= number <= last), "unknown"
    )
