"""Hours of recording read per second, from each published layout.

    python -m benchmarks.data_loading [--minutes 10] [--recordings 3] [--repeats 3]
        [--layouts tlio "ridi text" ...]

Real recordings are used where $GNIO_DATA has them. Elsewhere the tests' writers write a known walk
of `--minutes`. The table says which. `cold` reads the published files with an empty cache. `cached`
reads what a loader with a cache kept there. `HDF5` reads the files of `gnio data convert`. All
sequences are validated on the way. The files are in the system's disk cache: this measures the
loaders, not the disk. One process reads; the best of the repeats counts. At the end the text parser
and `np.loadtxt` read one file in turn.
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
from gnio_jax.data.dataset import RecordingSource
from gnio_jax.data.hdf5 import read_hdf5, write_hdf5
from gnio_jax.data.loading import read_recording
from gnio_jax.data.parsing.tables import read_text
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
    function: Callable[[], object], repeats: int, prepare: Callable[[], object] = lambda: None
) -> float:
    """Seconds of the quickest call. `before` runs ahead of each and is not counted."""
    seconds = []
    for _ in range(repeats):
        prepare()
        start = time.perf_counter()
        function()
        seconds.append(time.perf_counter() - start)
    return min(seconds)


def find(layout: str, folder: Path, minutes: float, most: int) -> tuple[list[RecordingSource], str]:
    """(recordings, "real" or "written") of a layout. Written files go to `folder`."""
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
    """Hours per second from the published files, from the cache and from our HDF5."""
    cache = folder / "cache"
    os.environ["GNIO_CACHE"] = str(cache)
    recordings, source = find(layout, folder / "files", minutes, most)
    sequences: list[Sequence] = []

    def read() -> None:
        sequences[:] = [
            sequence for recording in recordings for sequence in read_recording(recording).sequences
        ]

    cold = best(read, repeats, prepare=lambda: shutil.rmtree(cache, ignore_errors=True))
    cached = best(read, repeats) if cache.is_dir() else None
    paths = [folder / f"{number}.h5" for number in range(len(sequences))]
    for path, sequence in zip(paths, sequences, strict=True):
        write_hdf5(path, sequence)
    hdf5_seconds = best(lambda: [read_hdf5(path) for path in paths], repeats)
    hours = sum(float(sequence.time[-1] - sequence.time[0]) for sequence in sequences) / 3600.0
    return {
        "source": source,
        "recordings": len(recordings),
        "hours": hours,
        "cold": hours / cold,
        "HDF5": hours / hdf5_seconds,
        **({"cached": hours / cached} if cached else {}),
    }


def parser_ratio(folder: Path, minutes: float, repeats: int) -> tuple[float, float, str]:
    """(seconds of our parser, of np.loadtxt, which file) on EuRoC's imu0/data.csv.

    Both must return the same numbers.
    """
    base = os.environ.get("GNIO_DATA")
    real = sorted((Path(base) / "euroc").glob("*/mav0/imu0/data.csv")) if base else []
    if real:
        path, source = real[0], "real"
    else:
        folder.mkdir()
        LAYOUTS["euroc"].write(folder, 60.0 * minutes)
        path, source = next(folder.glob("*/mav0/imu0/data.csv")), "written"

    def parse_ours() -> np.ndarray:
        table = read_text(path)
        return table.take(*table.columns, gaps=True)

    def parse_numpy() -> np.ndarray:
        return np.loadtxt(path, delimiter=",", comments="#")

    np.testing.assert_allclose(parse_ours(), parse_numpy(), rtol=1e-15)
    # In turn, so that a busy machine slows both.
    times = [(best(parse_ours, 1), best(parse_numpy, 1)) for _ in range(repeats)]
    size = path.stat().st_size / 2**20
    description = f"{path.relative_to(path.parents[3])}, {source}, {size:.1f} MiB"
    return min(first for first, _ in times), min(second for _, second in times), description


def report_layout(layout: str, minutes: float, most: int, repeats: int) -> dict[str, float]:
    """Measure and print one layout; its figures by their names in the baseline."""
    with tempfile.TemporaryDirectory() as folder:
        row = measure(layout, Path(folder), minutes, most, repeats)
    cached = f"{row['cached']:8.3f}" if "cached" in row else f"{'':8}"
    description = f"{layout:>14} {row['source']:>8} {row['recordings']:3} {row['hours']:6.2f}"
    print(f"{description} {row['cold']:8.3f} {cached} {row['HDF5']:8.3f}", flush=True)
    ways = [way for way in ("cold", "cached", "HDF5") if way in row]
    return {f"h/s, {layout}, {way}": float(row[way]) for way in ways}


def report_parser(minutes: float, repeats: int) -> float:
    """Measure and print our text parser beside np.loadtxt; the ratio of their times."""
    with tempfile.TemporaryDirectory() as folder:
        parser_seconds, numpy_seconds, description = parser_ratio(
            Path(folder) / "files", minutes, repeats
        )
    ratio = numpy_seconds / parser_seconds
    times = f"{1e3 * parser_seconds:.0f} ms, np.loadtxt {1e3 * numpy_seconds:.0f} ms"
    print(f"\ntext ({description}): {times}: {ratio:.1f} times as long")
    return ratio


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--minutes",
        type=float,
        default=10.0,
        help="length of the written walk, where no real recording is found",
    )
    parser.add_argument("--recordings", type=int, default=3, help="real recordings to read at most")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--layouts", nargs="+", choices=LAYOUTS, default=list(LAYOUTS))
    arguments = parser.parse_args()
    # The warnings name cut gaps and entries of lists that are missing. They are known and not
    # what is measured.
    warnings.simplefilter("ignore")
    print(f"hours of recording per second, best of {arguments.repeats}\n")
    columns = f"{'layout':>14} {'source':>8} {'n':>3} {'hours':>6}"
    print(f"{columns} {'cold':>8} {'cached':>8} {'HDF5':>8}")
    figures: dict[str, float] = {}
    for layout in arguments.layouts:
        figures |= report_layout(layout, arguments.minutes, arguments.recordings, arguments.repeats)
    figures["np.loadtxt / our parser"] = report_parser(arguments.minutes, arguments.repeats)
    baseline.compare("data_loading", figures)


if __name__ == "__main__":
    main()
