"""Another package's network, dataset and measurement, through the commands."""

import importlib.metadata
import sys

import numpy as np
import pytest

from gnio_jax import data, models, plugins
from gnio_jax.data import registry as datasets
from gnio_jax.data.simulated import walks as simulated
from gnio_jax.errors import InputError
from gnio_jax.filtering import measurements
from gnio_jax.models import registry as networks

PLUGIN = """
from functools import partial
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from scipy.spatial.transform import Rotation

from gnio_jax import data, filtering, models
from gnio_jax.config.schema import Positive
from gnio_jax.data.assembly import Poses, Streams, assemble
from gnio_jax.data.dataset import Dataset, RecordingSource
from gnio_jax.types import Prediction


class Mean(nn.Module):
    features: int = 5

    @nn.compact
    def __call__(self, windows, train=False):
        h = nn.Dense(self.features, name="encoder")(windows.mean(axis=1))
        h = nn.BatchNorm(not train, name="norm")(h)
        displacement = nn.Dense(3, name="head")(jnp.tanh(h))
        return Prediction(displacement, jnp.full_like(displacement, -1.0), {})


class Slow(NamedTuple):
    std: Positive
    name = "slow"

    def update(self, state, step):
        covariance = self.std**2 * jnp.eye(3)
        linear = filtering.linearise(state, -state.velocity, covariance, velocity=jnp.eye(3))
        return filtering.measure(state, linear, step)


def recordings(root, split):
    paths = sorted((root / split).glob("*.npz"))
    return [RecordingSource(path.stem, partial(read, path)) for path in paths]


def read(path):
    walk = np.load(path, allow_pickle=False)
    streams = Streams.of_imu(path.stem, path, walk["time"], walk["gyro"], walk["accel"])
    rotations = Rotation.from_quat(walk["orientation"], scalar_first=True)
    poses = Poses(walk["time"], rotations, walk["position"], source=str(path))
    attributes = {"dataset": "npz", "group": path.stem}
    return assemble(streams._replace(poses=poses, attributes=attributes))


data.register(
    Dataset("npz", recordings, ("train", "val", "test"), 50.0, "here", "<split>/<walk>.npz", "CC0")
)
models.register("mean", Mean)
filtering.register(Slow)
"""


@pytest.fixture
def registries(monkeypatch):
    """What a plugin registers is gone afterwards."""
    monkeypatch.setattr(plugins, "_loaded", set())
    for registry, name in (
        (networks, "_MODELS"),
        (datasets, "DATASETS"),
        (measurements, "_MEASUREMENTS"),
    ):
        monkeypatch.setattr(registry, name, dict(getattr(registry, name)))
    names = set(sys.modules)
    yield
    for name in set(sys.modules) - names:
        if name.startswith(("stranger", "gnio_jax_plugin")):
            del sys.modules[name]


@pytest.fixture
def package(registries, tmp_path, monkeypatch):
    """An installed package with an entry point, and a folder of its dataset."""
    site, root = tmp_path / "site", tmp_path / "npz"
    dist_info = site / "stranger-1.0.dist-info"
    dist_info.mkdir(parents=True)
    (site / "stranger.py").write_text(PLUGIN, encoding="utf-8")
    (dist_info / "METADATA").write_text("Metadata-Version: 2.1\nName: stranger\nVersion: 1.0\n")
    (dist_info / "entry_points.txt").write_text("[gnio_jax.plugins]\nwalks = stranger\n")
    monkeypatch.syspath_prepend(str(site))
    for number, split in enumerate(("train", "train", "val", "test")):
        walk = simulated.pedestrian(number, number, "handheld", 15.0, 50.0)
        (root / split).mkdir(parents=True, exist_ok=True)
        parts = {name: getattr(walk, name) for name in ("time", "gyro", "accel", "position")}
        np.savez(root / split / f"w{number}.npz", **parts, orientation=walk.orientation)
    return root


def test_the_commands_use_what_an_installed_package_registers(gnio, package, tmp_path):
    assert "npz" in gnio("data", "list")
    assert "4 of 4" in (checked := gnio("data", "check", "npz", "--data-root", package)), checked
    run, slow = tmp_path / "run", ("--set", "filter.measurements.slow.std=0.02")
    options = ("--data.rate", 50, "--optim.epochs", 1, "--optim.batch-size", 16)
    names = ("--dataset", "npz", "--data-root", package, "--model.name", "mean")
    gnio("train", *names, *options, "--workdir", run, "--set", "model.options.features=6")
    path_lengths = []
    for settings in ((), slow):
        gnio("evaluate", "--network", run, "--no-plots", *settings)
        folder = max((run / "eval").iterdir(), key=lambda path: path.stat().st_mtime_ns)
        positions = np.loadtxt(folder / "trajectories" / "w3.txt")[:, 1:3]
        path_lengths.append(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum())
    assert folder.name.endswith("slow.std-0.02") and path_lengths[1] < 0.7 * path_lengths[0]
    walk = simulated.pedestrian(9, 9, "handheld", 12.0, 50.0)
    header = "time,gyro_x,gyro_y,gyro_z,accel_x,accel_y,accel_z"
    rows = np.column_stack([walk.time, walk.gyro, walk.accel])
    np.savetxt(tmp_path / "walk.csv", rows, delimiter=",", header=header, comments="")
    file, units = tmp_path / "walk.csv", ("--gyro-unit", "rad/s", "--accel-unit", "m/s2")
    output = gnio("track", file, *units, "--network", run, "--out", tmp_path / "track")
    assert "results: " in output


def test_a_file_is_a_plugin_too_and_a_broken_one_is_named(registries, tmp_path, monkeypatch):
    file, broken = tmp_path / "mine.py", tmp_path / "broken.py"
    file.write_text(PLUGIN, encoding="utf-8")
    monkeypatch.setenv("GNIO_PLUGINS", str(file))
    assert "mean" in models.names() and "slow" in measurements.names() and "npz" in data.names()
    broken.write_text("import nowhere_to_be_found", encoding="utf-8")
    for value, words in (
        (f"{file}:{broken}", rf"plugin {broken}: ModuleNotFoundError: .*leave it out of GNIO_PL"),
        (str(tmp_path / "none.py"), r"GNIO_PLUGINS: names .*none.py, which is not a file"),
    ):
        monkeypatch.setenv("GNIO_PLUGINS", value)
        with pytest.raises(InputError, match=words):
            data.names()
    point = importlib.metadata.EntryPoint("bad", "nowhere_to_be_found", plugins.GROUP)
    monkeypatch.setenv("GNIO_PLUGINS", "")
    monkeypatch.setattr(plugins, "entry_points", lambda group: [point])
    with pytest.raises(InputError, match=r"^plugin bad: ModuleNotFoundError"):
        data.names()
