"""`gnio data`: what the tables say, what is written, and one line for each mistake."""

import dataclasses
import json
import shutil
import warnings
from functools import partial

import numpy as np
import pytest
from matplotlib import image

from gnio_jax import data
from gnio_jax.apps.importing import read_imported
from gnio_jax.commands import app
from gnio_jax.data import conversion
from gnio_jax.data.dataset import RecordingSource
from gnio_jax.data.readers import DATASETS, tlio
from gnio_jax.data.readers import csv_files as csv
from gnio_jax.errors import InputError
from tests.support import indoor_location_files
from tests.support import known_walk as walk
from tests.support.circle import circle
from tests.support.command_lines import run
from tests.support.sequences import assert_same_arrays
from tests.support.tlio_files import write_sequence

LISTS = {"train": "fair\ntilted\nmirrored\nabsent\n", "val": "cut\n", "test": "also\n"}


def tilt(parts):
    name = "acc_compensated_rotated_in_World"
    parts[name] = parts[name] + [3.0, 0, 0]


def mirror(parts):
    for name in ("pos_World_Device", "vel_World"):
        parts[name] = parts[name] * [1, -1, 1]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty working folder, and no data anywhere else."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("GNIO_DATA", raising=False)
    return tmp_path


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A folder in TLIO's layout: two good recordings, two implausible ones, one that is cut short,
    one that is absent."""
    root = tmp_path_factory.mktemp("recordings") / "heads"
    spoilt = {"tilted": tilt, "mirrored": mirror}
    for name in ("fair", "tilted", "mirrored", "cut", "also"):
        write_sequence(root / name, spoil=spoilt.get(name))
    table = root / "cut" / "imu0_resampled.npy"
    table.write_bytes(table.read_bytes()[:1000])
    for split, names in LISTS.items():
        (root / f"{split}_list.txt").write_text(names)
    return root


@pytest.fixture
def root(written, folder):
    """A copy of it that a test may change."""
    return shutil.copytree(written, folder / "heads")


def row(out, name):
    """The cells of the table's line that begins with this name."""
    (line,) = [line for line in out.splitlines() if line.replace("│", "|").startswith(f"| {name} ")]
    return [cell.strip() for cell in line.replace("│", "|").strip("|").split("|")]


# --- list


def test_list_tells_everything_and_reads_nothing(root, monkeypatch, capsys):
    for table in root.rglob("*.npy"):
        table.write_bytes(b"")
    root.rename(root.parent / "tlio")
    monkeypatch.setenv("GNIO_DATA", str(root.parent))
    (root.parent / "kitti").mkdir()
    run("data", "list")
    text = " ".join(capsys.readouterr().out.split())
    for name in data.names():
        dataset = data.get(name)
        description = f"{dataset.rate:g} Hz; splits {', '.join(dataset.splits)}; {dataset.licence}"
        assert f"{name} {description} here " in text and f" source {dataset.source} " in text
        assert not dataset.needs_root or f" layout {dataset.layout} " in text
    for words in (
        "/tlio: 5 recordings (train 3, val 1, test 1)",
        "computed: 34 recordings (train 24, val 4, test 6)",
        f"{data.get('ronin').licence} here not found source",
        "split 'all' of dataset 'kitti' holds no recording",
    ):
        assert words in text.replace(" /tlio", "/tlio")


# --- check


def test_check_shows_every_recording_with_its_figures_and_reasons(root, capsys):
    files = ["--plots", "pictures", "--json", "out/figures.json"]
    run("data", "check", "tlio", "--data-root", str(root), *files)
    out = capsys.readouterr().out
    assert out.startswith(f"tlio at {root}, split all")
    fair = data.self_check(*tlio.read(root / "fair"))
    figures = [f"{fair.duration:.1f}", "200.0", "0.00 0.00 9.81", "–", f"{fair.median_speed:.2f}"]
    assert row(out, "fair") == ["fair", "train", *figures, "1.00", "100.0%", "used"]
    tilted, mirrored, cut = row(out, "tilted"), row(out, "mirrored"), row(out, "cut")
    assert tilted[4] == "3.00 0.00 9.81" and tilted[-1] == mirrored[-1] == "left out"
    assert float(mirrored[7]) < 0.3 and mirrored[4].endswith("9.81")
    assert cut == ["cut", "val", *["–"] * 7, "left out"]
    for line in (
        "left out: mirrored: horizontal acceleration of the positions correlates by only",
        f"left out: cut: {root / 'cut' / 'imu0_resampled.npy'}: cannot be read as a NumPy array",
        f"note: {root / 'train_list.txt'}: 1 of 4 listed sequences are absent: absent",
        "2 of 5 sequences are used, 0.01 h",
    ):
        assert line in out

    report = json.loads((root.parent / "out" / "figures.json").read_text())
    ours, notes = report["sequences"], report.pop("notes")
    assert len(notes) == 1 and list(ours) == ["fair", "tilted", "mirrored", "cut", "also"]
    expected = {"dataset": "tlio", "root": str(root), "split": "all", "sequences": ours}
    assert report == expected and not ours["cut"]["used"] and "cut short" in ours["cut"]["reason"]
    assert ours["fair"]["used"] and ours["fair"]["failures"] == []
    assert ours["fair"]["gravity_mean"] == fair.gravity_mean.tolist()
    with pytest.raises(SystemExit) as end:  # nothing is usable: the table is shown all the same
        app.main(["data", "check", "tlio", "--data-root", str(root), "--split", "val"])
    out, err = capsys.readouterr()
    assert end.value.code == 2 and "left out: cut: " in out
    assert err == f"{root}: none of 1 sequences can be used; see the reasons above\n"
    # Also of those that are left out, if they can be drawn.
    pictures = sorted((root.parent / "pictures").iterdir())
    assert [path.stem for path in pictures] == ["also", "fair", "mirrored", "tilted"]
    picture = image.imread(pictures[1])
    assert picture[..., :3].std() > 0.05 and picture.shape[1] > picture.shape[0] > 300


def test_check_of_recordings_without_poses_draws_them_all_the_same(folder, capsys):
    """With waypoints, gravity and speed are asked for."""
    text = indoor_location_files.lines(seconds=19.0)
    path = indoor_location_files.write(folder / "mall", text)
    run("data", "check", "indoor_location", "--data-root", "mall", "--plots", "pictures")
    name = f"site1_F4_{path.stem}"
    cells = row(capsys.readouterr().out, name)
    assert cells[1] == "test" and cells[3] == "50.0" and cells[4].startswith("0.00 0.00 9.")
    assert (cells[5], *cells[7:]) == ("–", "–", "–", "used") and float(cells[2]) > 15.0
    write_phone(folder / "own" / "bare.csv", names=csv.GYRO + csv.ACCEL)
    run("data", "check", "csv", "--data-root", "own", "--plots", "pictures")
    assert row(capsys.readouterr().out, "bare")[4:] == ["–", "–", "–", "–", "0.0%", "used"]
    for stem in (name, "bare"):
        assert image.imread(folder / "pictures" / f"{stem}.png")[..., :3].std() > 0.03


# --- convert


def test_convert_keeps_every_figure_and_the_splits(root, capsys):
    run("data", "convert", "tlio", "converted", "--data-root", str(root))
    out = capsys.readouterr().out
    for words in (
        "left out: tilted: mean of R·accel",
        "note: split 'val' has no list: none of its 1 recordings can be used",
        "converted: 2 sequences, 0.01 h (train 1, val 0, test 1)",
    ):
        assert words in out
    converted = root.parent / "converted"
    files = ["also.h5", "conversion.json", "fair.h5", "test.txt", "train.txt"]
    assert sorted(path.name for path in converted.iterdir()) == files
    for split, name in (("train", "fair"), ("test", "also")):
        (ours,), (theirs,) = data.load("csv", converted, split), tlio.read(root / name)
        assert ours.name == name
    with pytest.raises(InputError, match=r"val\.txt: the list cannot be read"):
        data.load("csv", converted, "val")
    options = ("--data-root", str(root), "--split", "test", "--rate", "50")
    run("data", "convert", "tlio", "slow", *options)
    (ours,) = data.load("csv", root.parent / "slow", "test")
    assert_same_arrays(ours, data.resample(theirs, 50.0))


def test_a_conversion_is_whole_or_not_there(root, monkeypatch):
    real, converted, reads, read = conversion.write_hdf5, root.parent / "converted", [], tlio.read
    monkeypatch.setattr(tlio, "read", lambda folder: reads.append(folder.name) or read(folder))

    def stopped(path, sequence):
        if sequence.name == "also":
            raise KeyboardInterrupt
        real(path, sequence)

    command = ["data", "convert", "tlio", "converted", "--data-root", str(root)]
    monkeypatch.setattr(conversion, "write_hdf5", stopped)
    with pytest.raises(SystemExit) as end:
        app.main(command)
    assert end.value.code == 130 and "also" in reads
    assert sorted(path.name for path in root.parent.iterdir()) == ["heads"]
    monkeypatch.setattr(conversion, "write_hdf5", real)
    run(*command)
    files = {path.name: path.read_bytes() for path in converted.iterdir()}

    # The same conversion takes the place of the first, with what has been mended since.
    (converted / "fair.h5").write_bytes(b"damaged")
    shutil.copy(root / "fair" / "imu0_resampled.npy", root / "cut")
    reads.clear()
    run(*command)
    assert set(reads) == {"fair", "tilted", "mirrored", "cut", "also"}
    assert {path.name for path in converted.iterdir()} == {*files, "cut.h5", "val.txt"}
    assert (converted / "val.txt").read_text() == "cut\n"
    assert [sequence.name for sequence in data.load("csv", converted, "train")] == ["fair"]

    # Another root, with recordings of the same names, is another conversion.
    root.rename(root.parent / "others")
    command[-1] = "others"
    with pytest.raises(InputError, match=r"converted: holds another conversion \(dataset tlio"):
        run(*command)


def test_what_a_dataset_asks_of_its_recordings_goes_with_them(root, monkeypatch):
    """Positions of another body do not correlate; the converted ones must not be refused for it,
    nor let pass who runs too fast."""
    monkeypatch.setitem(DATASETS, "tlio", dataclasses.replace(data.get("tlio"), correlates=False))
    (root / "test_list.txt").write_text("mirrored\n")
    run("data", "convert", "tlio", "converted", "--data-root", str(root), "--split", "test")
    path = root.parent / "converted" / "mirrored.h5"
    assert [sequence.name for sequence in data.load("csv", path.parent, "test")] == ["mirrored"]
    sequence = data.read_hdf5(path)
    data.write_hdf5(path, sequence._replace(velocity=sequence.velocity * 5))
    problem = "mirrored: left out by the self-check: .*too fast for a pedestrian"
    with pytest.warns(UserWarning, match=problem), pytest.raises(InputError):
        data.load("csv", path.parent, "test")


def test_a_piece_never_takes_the_file_of_another_recording(tmp_path):
    def pieces(*names):
        return partial(list, [circle(seconds=30.0)._replace(name=name) for name in names])

    walks = [
        RecordingSource("walk_piece1", pieces("walk_piece1")),
        RecordingSource("walk", pieces("walk_piece1", "walk_piece2")),
    ]
    # Nor one recording that of another.
    two = [RecordingSource(name, pieces(name)) for name in ("a b", "a_b")]
    for sources, of, file in (
        (walks, "walk", "walk_piece1"),
        (walks[::-1], "walk", "walk_piece1"),
        (two, "a", "a_b"),
    ):
        dataset = dataclasses.replace(
            data.get("tlio"), recordings=lambda *_, sources=sources: sources
        )
        problem = rf"'{of}.*' and '{of}.*' would be one file, {file}\.h5"
        with pytest.raises(InputError, match=problem):
            conversion.convert(dataset, tmp_path, tmp_path / "out", "test")
        assert not (tmp_path / "out").exists()


# --- import


def write_phone(path, names, time=None, gyro=1.0, accel=1.0, per_second=1.0, separator=","):
    """A logger's file of the known walk: columns time, gyro and accel under other names, scaled,
    some of them."""
    time = np.arange(2000) / 100 if time is None else time
    imu = np.hstack([walk.rate(time) * gyro, walk.force(time) * accel])
    values = dict(zip((*csv.GYRO, *csv.ACCEL), imu.T, strict=True))
    names = names if isinstance(names, dict) else {name: name for name in names}
    table = np.column_stack([time * per_second, *(values[name] for name in names)])
    lines = [["time", *names.values()], *(map(repr, row) for row in table.tolist())]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(map(separator.join, lines)) + "\n")
    return time


def test_import_of_a_phones_file_returns_the_walk(folder, capsys):
    names = dict(zip((*csv.GYRO, *csv.ACCEL), ("wx", "wy", "wz", "ax", "ay", "az"), strict=True))
    scales = {"gyro": 180 / np.pi, "accel": -1 / 9.80665, "per_second": 1e3}
    time = write_phone(folder / "ios.csv", names, separator=";", **scales)
    options = ["--columns", *(f"{name}={column}" for name, column in names.items())]
    options += ["--accel-sign", "ios", "--gyro-unit", "deg/s"]
    run("data", "import", "ios.csv", "--out", "own/walk.h5", *options)
    out = capsys.readouterr().out
    assert "accel negated (iOS's sign)" in out and "20.0 s at 100 Hz" in out
    assert out.splitlines()[-1] == "next: gnio track own/walk.h5"  # it has no reference
    (sequence,) = data.load("csv", folder / "own", "test")
    assert sequence.name == "walk" and not sequence.valid.any()
    for signal, expected in ((sequence.gyro, walk.rate(time)), (sequence.accel, walk.force(time))):
        np.testing.assert_allclose(signal, expected, atol=1e-9)

    (folder / "own" / "test.txt").write_text("walk\n")
    run("data", "import", "ios.csv", "--out", "own/again.h5", "--rate", "50", *options)
    assert "add the line again.h5 to test.txt" in capsys.readouterr().out
    assert data.read_hdf5(folder / "own" / "again.h5").time.shape == (1000,)


@pytest.mark.parametrize("beside", ["WALK.CSV", "walk.hdf5"])
def test_what_follows_an_import_beside_its_own_csv_can_be_followed(folder, capsys, beside):
    """As recordings of the folder, walk.csv and walk.h5 would have one name."""
    (folder / "other").mkdir()
    source = folder / ("other/a.csv" if beside == "walk.hdf5" else beside)
    write_phone(source, (*csv.GYRO, *csv.ACCEL), accel=-1.0)
    if beside == "walk.hdf5":
        run("data", "import", str(source), "--out", beside)
    run("data", "import", str(source), "--out", f"{beside[:4]}.h5")
    *_, note, warning, following = capsys.readouterr().out.splitlines()
    assert warning.startswith(f"warning: sign: gravity reads on -z in {source.name}")
    assert f". holds {beside} too, which gnio evaluate would read as a recording" in note
    assert following == f"next: gnio track {beside[:4]}.h5"
    with pytest.raises(InputError, match="has the name of"):
        data.load("csv", folder, "test")
    assert read_imported(folder / f"{beside[:4]}.h5").sequence.name == beside[:4]


# --- mistakes

HEADS = ["--data-root", "heads"]


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["check", "tlio"], "data/tlio, data/tlio_layout: no folder of dataset 'tlio'; give"),
        (["check", "tlio", *HEADS, "--split", "tset"], "unknown split 'tset'; did you mean 'te"),
        (["check", "tlio", *HEADS, "--plots", "heads/test_list.txt"], "--plots: must be a folder"),
        (["convert", "tlio", "heads", *HEADS], "heads: is the folder that is read"),
        (["convert", "tlio", "x", *HEADS, "--rate", "0"], "--rate: must be from 1 to 10000 Hz"),
        (["convert", "tlio", "heads/test_list.txt", *HEADS], "heads/test_list.txt: is a file"),
        (["convert", "tlio", "taken", *HEADS], "taken: holds files of another origin; choose"),
        (["convert", "tlio", "ours", *HEADS], "ours: holds another conversion (dataset tlio, rate"),
        (
            ["import", "walk.csv", "--out", "x.csv"],
            "--out: 'x.csv' is not the name of an HDF5 file",
        ),
        (["import", "walk.csv", "--out", "folder.h5"], "--out: must not be a folder, found"),
    ],
)
def test_a_mistake_is_one_line_and_status_2(root, folder, capsys, arguments, expected):
    write_phone(folder / "walk.csv", csv.GYRO + csv.ACCEL)
    (folder / "taken").mkdir()
    (folder / "taken" / "train.txt").write_text("a\n")
    (folder / "folder.h5").mkdir()
    (folder / "ours").mkdir()
    (folder / "ours" / conversion.CONVERSION).write_text('{"dataset": "tlio", "rate": 50.0}')
    before = sorted(folder.rglob("*"))
    with pytest.raises(SystemExit) as end, warnings.catch_warnings():
        app.main(["data", *arguments])
    out, err = capsys.readouterr()
    assert (end.value.code, out) == (2, "") and err.count("\n") == 1 and expected in err, err
    assert sorted(folder.rglob("*")) == before
