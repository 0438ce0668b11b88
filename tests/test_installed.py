"""The package as `pip install` leaves it: a wheel in an environment of its own, used from a folder
that is not the checkout."""

import json
import os
import subprocess
import sys
import venv
import zipfile
from importlib import metadata
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[1]
SMALL = [
    *("--model.width", "2", "--model.bank-size", "3"),
    *("--optim.epochs", "1", "--data.train-split", "val", "--data.stride-seconds", "0.5"),
    *("--data.train-stride-seconds", "1", "--data.rate", "20"),
]


pytestmark = pytest.mark.slow  # a wheel is built and installed


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """The wheel, built from a copy of what the build reads."""
    pytest.importorskip("pip")
    source, folder = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("wheel")
    for name in ("pyproject.toml", "setup.py", "README.md", "LICENSE", "configs", "gnio_jax"):
        (source / name).symlink_to(ROOT / name)
    pip = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", folder]
    new = int(metadata.version("setuptools").split(".")[0]) >= 77  # else pip fetches one that is
    subprocess.run([*pip, *["--no-build-isolation"][:new], source], check=True)
    (built,) = folder.glob("*.whl")
    return built


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory):
    """A fresh environment with the wheel, which borrows the dependencies of this one: its `bin`."""
    folder = tmp_path_factory.mktemp("environment")
    venv.create(folder, symlinks=True)
    purelib = next((folder / "lib").glob("python*/site-packages"))
    pip = [sys.executable, "-m", "pip", "--python", folder / "bin" / "python"]
    install = ["install", "--quiet", "--no-deps", "--no-index", wheel]
    subprocess.run([*pip, *install], check=True)
    borrowed = [entry for entry in sys.path if entry.endswith("site-packages")]
    # Without its .pth files: an editable installation of the checkout is not borrowed.
    (purelib / "borrowed.pth").write_text("\n".join(borrowed) + "\n")
    return folder / "bin"


@pytest.fixture
def gnio(installed, tmp_path):
    """The command `gnio`, called in an empty folder."""
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    environment.pop("GNIO_DATA", None)

    def call(*arguments, program="gnio"):
        command = [installed / program, *map(str, arguments)]
        return subprocess.run(
            command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=500
        )

    return call


def test_the_wheel_holds_the_package_its_configs_and_its_types(wheel):
    names = zipfile.ZipFile(wheel).namelist()
    assert "gnio_jax/py.typed" in names
    for path in (ROOT / "configs").rglob("*.yaml"):
        assert f"gnio_jax/configs/{path.relative_to(ROOT / 'configs').as_posix()}" in names
    for suffix in ("py", "html", "js"):
        for path in (ROOT / "gnio_jax").rglob(f"*.{suffix}"):
            assert path.relative_to(ROOT).as_posix() in names
    assert not [name for name in names if name.startswith(("tests", "configs", "docs"))]
    described = next(name for name in names if name.endswith("/METADATA"))
    assert b"Project-URL: Changelog, https://" in zipfile.ZipFile(wheel).read(described)


def test_train_and_evaluate_from_anywhere(gnio, tmp_path):
    trained = gnio("train", "--config", "quickstart", *SMALL)
    assert trained.returncode == 0, trained.stderr
    assert "look at it with: gnio evaluate --network runs/synthetic_gnio" in trained.stdout
    evaluated = gnio("evaluate", "--split", "val", "--estimator", "integrate", "--no-plots")
    assert evaluated.returncode == 0, evaluated.stderr
    folder = tmp_path / "runs" / "synthetic_gnio" / "eval" / "synthetic_val_integrate"
    figures = json.loads((folder / "metrics.json").read_text())
    assert figures["mean"]["ate"] > 0 and len(figures["sequences"]) == 4


def test_the_path_of_a_recording_without_any_training(gnio, tmp_path):
    tracked = gnio("track", ROOT / "examples" / "walk.csv")
    assert tracked.returncode == 0, tracked.stderr
    assert "typical error" in tracked.stdout and "by pedestrian" in tracked.stdout
    folder = tmp_path / "tracks" / "walk"
    for name in ("trajectory.txt", "track.png", "report.html", "summary.json"):
        assert (folder / name).is_file()
    path = np.loadtxt(folder / "trajectory.txt")[:, 1:3]
    # examples/make_walk.py tells the truth: 49.6 m in the plane, ending 6.1 m from the start.
    seconds = path[::5]
    length = np.linalg.norm(np.diff(seconds, axis=0), axis=1).sum()
    assert abs(length / 49.6 - 1) < 0.1
    assert abs(np.linalg.norm(path[-1] - path[0]) - 6.1) < 3.0


def test_help_and_version_need_no_jax(gnio):
    shown = gnio("--help")
    words = "train evaluate data track publish weights tables interop doctor"
    for word in words.split():
        assert f"\n  {word} " in shown.stdout
    check = (
        "import sys, gnio_jax\nfrom gnio_jax.commands import app\n"
        "heavy = {'jax', 'flax', 'orbax', 'matplotlib', 'pandas', 'scipy'} & set(sys.modules)\n"
        "print(gnio_jax.__version__, gnio_jax.__file__, heavy or 'light')"
    )
    version, path, weight = gnio("-c", check, program="python").stdout.split()
    assert version[0].isdigit() and weight == "light"
    assert not path.startswith(str(ROOT))
