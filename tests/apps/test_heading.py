"""Whether a device looks where its carrier walks, with a network whose displacement is the mean of
the horizontal acceleration."""

import dataclasses
import json
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from flax import linen as nn
from scipy.spatial.transform import Rotation

import gnio_jax
from gnio_jax import models
from gnio_jax.apps import heading
from gnio_jax.apps.summary import _warnings_of_heading
from gnio_jax.config import DataConfig, ModelConfig, TrainConfig
from gnio_jax.errors import InputError
from gnio_jax.evaluation import prepare
from gnio_jax.evaluation.trajectory import read_tum
from gnio_jax.models import registry
from gnio_jax.networks import TrainedNetwork
from gnio_jax.types import Prediction, Sequence
from tests.support import tiny_run

ROOT = Path(__file__).parents[2]

RATE = 20
CONFIG = TrainConfig(
    data=DataConfig(rate=float(RATE), stride_seconds=0.2, window_rotation="body_axes"),
    model=ModelConfig(name="pushed", equivariance="device_heading"),
)


class Pushed(nn.Module):
    @nn.compact
    def __call__(self, windows, train=False):
        level = windows[..., :3].mean(axis=1) * jnp.float32([[1, 1, 0]])
        return Prediction(level, jnp.zeros_like(level), {})


@pytest.fixture(scope="module")
def trained():
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(registry._MODELS, "pushed", Pushed)
        model = models.from_config(CONFIG.model)
        variables = {"params": {"facing_up": jnp.zeros(6, jnp.float32)}}
        yield TrainedNetwork(CONFIG, model, variables, 0, 0)


def pushed(angle, tilt, seconds=14, yaw=2.0, size=1.0, up=0.0):
    """A device that is tilted about its x axis, whose y axis looks along `yaw` and which is pushed
    `angle` degrees to the left of it. For the last `up` seconds it lies flat."""
    count = round(seconds * RATE) + 1
    tilts = np.where(np.arange(count) < count - round(up * RATE), tilt, 0.0)
    yaws = np.full(count, yaw - np.pi / 2)
    attitude = Rotation.from_euler("ZX", np.stack([yaws, np.radians(tilts)], axis=1))
    way = yaw + np.radians(angle)
    force = attitude.inv().apply([size * np.cos(way), size * np.sin(way), 9.81])
    turn = (attitude[:-1].inv() * attitude[1:]).as_rotvec() * RATE
    sequence = Sequence(
        name="pushed",
        time=np.arange(count) / RATE,
        gyro=np.concatenate([turn, np.zeros((1, 3))]),
        accel=force,
        orientation=attitude.as_quat(scalar_first=True),
        position=np.zeros((count, 3)),
        velocity=np.zeros((count, 3)),
        valid=np.ones(count, bool),
    )
    (ready,), _ = prepare([sequence], CONFIG.data, orientation="filter")
    return ready


@pytest.mark.parametrize("angle", [0.0, 70.0, -120.0])
def test_the_angle_is_from_the_y_axis_to_the_left(trained, angle):
    ready = pushed(angle, tilt=40.0)
    assert heading.misalignment(ready, trained) == pytest.approx(angle, abs=1e-2)
    warnings = _warnings_of_heading(ready, trained)
    if abs(angle) < heading.MISALIGNED:
        assert warnings == []
        return
    side = "left" if angle > 0 else "right"
    (warning,) = warnings
    assert f"walks {abs(angle):.0f}° to the {side}" in warning and "--heading gait" in warning
    assert _warnings_of_heading(ready, heading.without_heading(trained)) == []


@pytest.mark.parametrize(
    "how",
    [
        {"tilt": 80.0},
        {"tilt": 150.0},
        {"tilt": 20.0, "size": 0.1},
        {"tilt": 20.0, "seconds": 9},
        {"tilt": 80.0, "seconds": 30, "up": 8.0},
        {"tilt": 20.0, "seconds": 1.3},
    ],
    ids=["upright", "face down", "at rest", "short", "taken out of the pocket", "few windows"],
)
def test_there_is_no_angle(trained, how):
    ready = pushed(90.0, **how)
    assert np.isnan(heading.misalignment(ready, trained))
    assert _warnings_of_heading(ready, trained) == []


def test_a_screen_that_faces_up_for_ten_seconds_has_one(trained):
    ready = pushed(90.0, tilt=80.0, seconds=30, up=13.0)
    assert heading.misalignment(ready, trained) == pytest.approx(90.0, abs=1e-2)


def test_only_a_network_that_sees_the_axes_does_without(trained):
    alone = heading.without_heading(trained)
    assert alone.config.filter.window_rotation == "hidden_axes"
    models.check_experiment(alone.model, alone.config)
    model = dataclasses.replace(CONFIG.model, equivariance="none")
    plain = alone._replace(model=models.from_config(model))
    for config in (
        dataclasses.replace(alone.config, model=model),
        dataclasses.replace(CONFIG, model=ModelConfig(name="airio"), filter=alone.config.filter),
    ):
        with pytest.raises(InputError, match="window_rotation"):
            models.check_experiment(models.from_config(config.model), config)
    of_data = dataclasses.replace(CONFIG.data, window_rotation="hidden_axes")
    hidden = trained._replace(config=dataclasses.replace(CONFIG, data=of_data))
    assert heading.uses_heading(trained) and not heading.uses_heading(hidden)
    for network in (alone, hidden, plain):
        with pytest.raises(InputError, match=r"^--heading gait: .*does not use the heading"):
            heading.without_heading(network)


@pytest.fixture(scope="module")
def held(tmp_path_factory):
    """A run of the smallest network that sees the heading of a device, and eight seconds of a
    computed phone whose screen faces up."""
    folder = tmp_path_factory.mktemp("held")
    model = ModelConfig(name="tiny", equivariance="device_heading")
    windows = dataclasses.replace(CONFIG.data, rate=50.0)
    with tiny_run.registry_entry():
        tiny_run.save(folder / "run", TrainConfig(data=windows, model=model))
        lines = (ROOT / "examples" / "walk.csv").read_text().splitlines()[:802]
        (folder / "walk.csv").write_text("\n".join(lines) + "\n")
        yield folder


def test_every_command_hides_the_axes(gnio, mistake, undrawn, held, tmp_path):
    """The paths by both sources differ, and `track`, `live` and `gnio_jax.track` agree on them."""
    walk, run = held / "walk.csv", held / "run"
    paths = {}
    for source in ("device", "gait"):
        words = (walk, "--network", run, "--heading", source, "--out")
        gnio("track", *words, tmp_path / source)
        tracked = read_tum(tmp_path / source / "trajectory.txt")
        paths[source] = tracked.position
        gnio("live", *words, tmp_path / f"{source}.txt", "--speed", 0)
        live = read_tum(tmp_path / f"{source}.txt")
        rows = np.searchsorted(tracked.time, live.time - 1e-6)
        np.testing.assert_allclose(live.position, tracked.position[rows], atol=1e-6)
        columns = np.loadtxt(walk, delimiter=",", skiprows=1)
        samples = columns[:, 0], columns[:, 1:4], columns[:, 4:]
        odometry = gnio_jax.track(*samples, network=run, heading=source)
        np.testing.assert_allclose(odometry.position, paths[source], atol=1e-6)
    assert np.abs(paths["device"] - paths["gait"]).max() > 1e-2
    message = mistake("track", walk, "--heading", "gait", "--carrier", "car")
    assert "--heading gait: is for people" in message
    with pytest.raises(InputError, match=r"^heading: must be 'device' or 'gait', found 'Gait'"):
        gnio_jax.track(*samples, network=run, heading="Gait")


def test_no_error_is_stated_beside_the_warning(gnio, undrawn, held, tmp_path, monkeypatch):
    """And the warning comes first. The tiny network has no gait, so its angle is given."""
    shown, words = "expected error at the end", ("track", held / "walk.csv", "--network")
    words = (*words, held / "run", "--out")
    monkeypatch.setattr(heading, "misalignment", lambda *_: heading.MISALIGNED - 1.0)
    assert shown in gnio(*words, tmp_path / "ahead")
    monkeypatch.setattr(heading, "misalignment", lambda *_: heading.MISALIGNED + 1.0)
    output = gnio(*words, tmp_path / "across")
    assert output.startswith("warning: heading: by the gait, the carrier walks 61° to the left")
    assert shown not in output
    summary = json.loads((tmp_path / "across" / "summary.json").read_text())
    assert "expected_error" not in summary and summary["warnings"][0].startswith("heading: ")
    assert shown in gnio(*words, tmp_path / "gait", "--heading", "gait")
