"""Hours of recording read per second: from the published files, from the cache, and from the
package's own HDF5.

    python -m benchmarks.data_loading [--minutes 10] [--recordings 3] [--repeats 3] [--layouts tlio "ridi text" ...]

Real recordings count where $GNIO_DATA has them, else a known walk of `--minutes` written by the
tests' own writers; the table says which. `cold` reads the published files with an empty cache,
`cached` what a loader that keeps its sequences left there, `HDF5` what `python -m gnio_jax.data
convert` writes. All are validated on the way. Files are in the system's cache of the disk: this
measures the loaders, not the disk. One process; best of the repeats. At last the parser of text is
timed in turn with `np.loadtxt` on one file.
"""

from __future__ import annotations

import argparse
import os
import shutil
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np

from benchmarks import baseline
from gnio_jax import data
from gnio_jax.data.dataset import Recording
from gnio_jax.data.hdf5 import read_hdf5, write_hdf5
from gnio_jax.data.readers.text import numbers, read_csv
from gnio_jax.data.reading import read_recording
from gnio_jax.types import Sequence
from tests.support.layouts import LAYOUTS

REAL = {
    "tlio": ("tlio_layout", "train"),
    "oxiod raw": ("oxiod", "test"),
    "ridi text": ("kiod", "all"),
    "euroc": ("euroc", "train"),
    "tumvi": ("tumvi", "train"),
    "kitti npz": ("kitti", "train"),
    "blackbird": ("blackbird", "train"),
}
"""Layout -> (folder below $GNIO_DATA, split)."""


def best(
    function: Callable[[], object], repeats: int, before: Callable[[], object] = lambda: None
) -> float:
    """Seconds of the quickest call; `before` each of them is not counted."""
    seconds = []
    for _ in range(repeats):
        before()
        began = time.perf_counter()
        function()
        seconds.append(time.perf_counter() - began)
    return min(seconds)


def find(layout: str, folder: Path, minutes: float, most: int) -> tuple[list[Recording], str]:
    """(recordings, "real" or "written") of a layout; what is written goes to `folder`."""
    dataset = data.get(LAYOUTS[layout].dataset)
    base, (name, split) = os.environ.get("GNIO_DATA"), REAL.get(layout, ("", ""))
    if base and name and (Path(base) / name).is_dir():
        return dataset.recordings(Path(base) / name, split)[:most], "real"
    folder.mkdir()
    LAYOUTS[layout].write(folder, 60.0 * minutes)
    return dataset.recordings(folder, LAYOUTS[layout].split), "written"


def measure(
    layout: str, folder: Path, minutes: float, most: int, repeats: int
) -> dict[str, float | str]:
    """Hours per second of the three ways."""
    cache = folder / "cache"
    os.environ["GNIO_CACHE"] = str(cache)
    recordings, source = find(layout, folder / "files", minutes, most)
    sequences: list[Sequence] = []

    def read() -> None:
        sequences[:] = [
            sequence for recording in recordings for sequence in read_recording(recording).sequences
        ]

    cold = best(read, repeats, before=lambda: shutil.rmtree(cache, ignore_errors=True))
    cached = best(read, repeats) if cache.is_dir() else None
    paths = [folder / f"{number}.h5" for number in range(len(sequences))]
    for path, sequence in zip(paths, sequences, strict=True):
        write_hdf5(path, sequence)
    own = best(lambda: [read_hdf5(path) for path in paths], repeats)
    hours = sum(float(sequence.time[-1] - sequence.time[0]) for sequence in sequences) / 3600.0
    return {
        "source": source,
        "recordings": len(recordings),
        "hours": hours,
        "cold": hours / cold,
        "HDF5": hours / own,
        **({"cached": hours / cached} if cached else {}),
    }


def parser_ratio(folder: Path, minutes: float, repeats: int) -> tuple[float, float, str]:
    """(seconds of our parser, of np.loadtxt, which file) on EuRoC's imu0/data.csv, the numbers of
    both being equal."""
    base = os.environ.get("GNIO_DATA")
    path = (
        next(iter(sorted((Path(base) / "euroc").glob("*/mav0/imu0/data.csv"))), None)
        if base
        else None
    )
    source = "real"
    if path is None:
        folder.mkdir()
        LAYOUTS["euroc"].write(folder, 60.0 * minutes)
        path, source = next(folder.glob("*/mav0/imu0/data.csv")), "written"

    def ours() -> np.ndarray:
        table = read_csv(path)
        return numbers(table, table.columns, path)

    def theirs() -> np.ndarray:
        return np.loadtxt(path, delimiter=",", comments="#")

    np.testing.assert_allclose(ours(), theirs(), rtol=1e-15)
    times = [
        (best(ours, 1), best(theirs, 1)) for _ in range(repeats)
    ]  # in turn: a busy machine slows both
    about = f"{path.relative_to(path.parents[3])}, {source}, {path.stat().st_size / 2**20:.1f} MiB"
    return min(first for first, _ in times), min(second for _, second in times), about


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--minutes",
        type=float,
        default=10.0,
        help="length of what is written where nothing real is there",
    )
    parser.add_argument(
        "--recordings", type=int, default=3, help="of the real ones, how many at most"
    )
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--layouts", nargs="+", choices=LAYOUTS, default=list(LAYOUTS))
    arguments = parser.parse_args()
    warnings.simplefilter(
        "ignore"
    )  # cut gaps, missing entries of lists: known, and not what is measured
    figures: dict[str, float] = {}
    print(f"hours of recording per second, best of {arguments.repeats}\n")
    print(
        f"{'layout':>14} {'source':>8} {'n':>3} {'hours':>6} {'cold':>8} {'cached':>8} {'HDF5':>8}"
    )
    for layout in arguments.layouts:
        with tempfile.TemporaryDirectory() as folder:
            row = measure(
                layout, Path(folder), arguments.minutes, arguments.recordings, arguments.repeats
            )
        cached = f"{row['cached']:8.3f}" if "cached" in row else f"{'':8}"
        print(
            f"{layout:>14} {row['source']:>8} {row['recordings']:3} {row['hours']:6.2f} {row['cold']:8.3f} {cached} {row['HDF5']:8.3f}",
            flush=True,
        )
        figures |= {
            f"h/s, {layout}, {way}": float(row[way])
            for way in ("cold", "cached", "HDF5")
            if way in row
        }
    with tempfile.TemporaryDirectory() as folder:
        ours, theirs, about = parser_ratio(
            Path(folder) / "files", arguments.minutes, arguments.repeats
        )
    print(
        f"\ntext ({about}): {1e3 * ours:.0f} ms, np.loadtxt {1e3 * theirs:.0f} ms: {theirs / ours:.1f} times as long"
    )
    figures["np.loadtxt / our parser"] = theirs / ours
    baseline.compare("data_loading", figures)


if __name__ == "__main__":
    main()
