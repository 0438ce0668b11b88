"""Files in the layout of the Indoor Location Competition: the known walk at 50 Hz, with taps."""

from pathlib import Path

import numpy as np

from tests.support import known_walk as walk

START = 1_574_655_840_014
"""unix ms of the first sample, time 0 of the walk."""
NAME = "5ddb6f179191710006b57605"
HEADER = (
    f"#\tstartTime:{START - 135}",
    "#\tSiteID:5dd3\tSiteName:商场\tFloorId:5dd4\tFloorName:F4",
    "#\tBrand:OPPO\tModel:PBCM10\tAndroidName:8.1.0\tAPILevel:27\t",
)
TAPS = np.array([-0.122, 6.0, 12.5, 18.25, 24.75, 30.004])
"""s; the first comes before the first sample."""


def field(time: np.ndarray) -> np.ndarray:
    """Readings of the magnetometer, µT."""
    return np.stack([20 + 0.1 * time, 5 - 0.2 * time, -40 + 0.3 * time], axis=1)


def lines(seconds: float = walk.SECONDS, taps: np.ndarray = TAPS) -> list[str]:
    """The lines of one walk, in the order of their stamps."""
    taps = taps[taps <= seconds]
    stamps = np.round(np.arange(0.0, seconds, 1 / 50.4) * 1e3).astype(int)
    time, entries = stamps / 1e3, []
    for kind, values in (
        ("ACCELEROMETER", walk.force(time)),
        ("MAGNETIC_FIELD", field(time)),
        ("GYROSCOPE", walk.rate(time)),
    ):
        for stamp, (x, y, z) in zip(stamps, values.tolist(), strict=True):
            entries.append((stamp, f"{START + stamp}\tTYPE_{kind}\t{x:.8f}\t{y:.8f}\t{z:.8f}\t3"))
    for tap, (x, y, _) in zip(taps, walk.position(taps).tolist(), strict=True):
        stamp = round(tap * 1e3)
        entries.append((stamp, f"{START + stamp}\tTYPE_WAYPOINT\t{x:.7f}\t{y:.7f}"))
    entries.sort(key=lambda entry: entry[0])
    return [*HEADER, *(line for _, line in entries), f"#\tendTime:{START + round(seconds * 1e3)}"]


def write(root: Path, text: list[str] | None = None, floor: str = "F4", name: str = NAME) -> Path:
    """One file below `root`, of these lines."""
    path = root / "site1" / floor / "path_data_files" / f"{name}.txt"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines() if text is None else text) + "\n", encoding="utf-8")
    return path
