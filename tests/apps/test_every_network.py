"""Every network of the package, and every recipe, from training to a live trajectory."""

import functools
import importlib.util
import json
import os
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax import config as configuration
from gnio_jax import models
from gnio_jax.apps import onnx
from gnio_jax.data.simulated.walks import pedestrian
from gnio_jax.evaluation.trajectory import read_tum
from tests.support import tlio_files
from tests.support.networks import SMALL

NETWORKS = set(models.names())
"""Those of the package, read before any test registers another one."""
EXAMPLE = Path(__file__).parents[2] / "examples" / "walk.csv"
OTHERS = {"gnio", "gru", "state_space"}
"""Networks without a recipe of their own."""
WITH_MEMORY = {"gru", "ronin_lstm", "ronin_tcn", "state_space"}
"""Networks that learn from segments, which are longer in the recipes than these walks."""
RECIPES = sorted(
    name.removeprefix("baselines/")
    for name in configuration.experiment_names()
    if name.startswith("baselines/")
)
ALWAYS = {"airimu", "gru", "ionet"}
"""A row takes minutes. These run with the slow tests, all of them with GNIO_EVERY_NETWORK=1."""
NAMED = {"airimu": "tlio", "bins": "gnio", "eqnio_ronin": "ronin_resnet", "eqnio_tlio": "tlio"}
NAMED |= {"rio": "ronin_resnet"}
"""The networks of recipes that have another name."""
OF_CONSTRAINT = {"ai_imu"}
"""Networks without displacements, which are trained through the filter and have a test of their
own."""
IN_CONFIG = {"width", "bank_size", "head", "output_dim"}
"""Options that have a place of their own in the file."""
CHANGED = ("--dataset", "tlio", "--data.rate", "100", "--data.stride-seconds", "0.2")
CHANGED += ("--data.train-stride-seconds", "0.2", "--optim.epochs", "1", "--optim.batch-size", "4")
CHANGED += ("--optim.statistics-windows", "8", "--optim.warmup-epochs", "0")

SMALL_CAR = ("--data.train-split", "train", "--data.val-split", "val", "--optim.epochs", "1")
SMALL_CAR += ("--optim.batch-size", "2", "--optim.warmup-epochs", "0")
SMALL_CAR += ("--through-filter.piece-seconds", "4")
SMALL_CAR += ("--set", "through_filter.displacement_weight=1.0")
"""Changes of configs/vehicles.yaml. A walk has no piece of 100 m."""


def smallest(network):
    """The words of the smallest options of a network."""
    for option, value in SMALL[network.removesuffix("_text")].items():
        name = option if option in IN_CONFIG else f"options.{option}"
        yield from ("--set", f"model.{name}={value}")


def walk_instead(parts, seed):
    """Write a pedestrian over the head that moves in a circle, so that no network of one epoch
    meets what it has never seen when the filter of a live walk and of an export is run."""
    walk = pedestrian(seed, seed, seconds=(tlio_files.N - 1) / 200)
    attitude = Rotation.from_quat(walk.orientation, scalar_first=True)
    parts["ts_us"] = np.round((walk.time + 1.0) * 1e6)[:, None]
    parts["gyr_compensated_rotated_in_World"] = attitude.apply(walk.gyro)
    parts["acc_compensated_rotated_in_World"] = attitude.apply(walk.accel)
    parts["qxyzw_World_Device"] = attitude.as_quat()
    parts["pos_World_Device"], parts["vel_World"] = walk.position, walk.velocity


def write_phone_log(path):
    """Seven seconds of another pedestrian, who stands in the first three."""
    walk = pedestrian(5, 5, seconds=7.0)
    table = np.column_stack([walk.time, walk.gyro, walk.accel])
    names = [f"gyro_{axis} [rad/s]" for axis in "xyz"] + [f"accel_{axis} [m/s^2]" for axis in "xyz"]
    np.savetxt(path, table, "%.6f", ",", header=",".join(["time [s]", *names]), comments="")


def test_every_network_has_a_row_here():
    networks = {NAMED.get(name, name) for name in RECIPES} | OTHERS
    assert networks | OF_CONSTRAINT == NETWORKS


@pytest.mark.slow
def test_the_network_of_a_cars_constraint_from_training_to_live(
    gnio, mistake, undrawn, tmp_path, tmp_path_factory, monkeypatch
):
    """Train `ai_imu` through the filter, evaluate, publish and follow a recording live. What needs
    displacements refuses it: the loose coupling, training on windows and the export."""
    monkeypatch.chdir(tmp_path)
    root = tlio_files.write_splits(tmp_path_factory.mktemp("data"))
    words = ("--config", "vehicles", "--dataset", "tlio", "--data-root", root, *SMALL_CAR)
    gnio("train", *words, "--workdir", "run")
    gnio("evaluate", "--network", "run", "--no-plots")
    score = json.loads(Path("run/eval/tlio_test_ekf/metrics.json").read_text())
    assert np.isfinite(score["mean"]["ate"])
    loose = mistake("evaluate", "--network", "run", "--no-plots", "--coupling", "loose")
    assert "needs displacements, and 'ai_imu' predicts none" in loose
    assert "no displacement that could be calibrated" in mistake("calibrate", "--network", "run")
    on_windows = (*words, "--workdir", "windows", "--set", "through_filter.learn=[]")
    assert "is trained in the filter's loop alone" in mistake("train", *on_windows)
    gnio("publish", "run", "--out", "named.zip", "--data", "simulated walks", "--license", "CC0")
    walk = Path("walk.csv")
    walk.write_text("\n".join(EXAMPLE.read_text().splitlines()[:502]) + "\n")
    gnio("live", walk, "--network", "named.zip", "--out", "live.txt")
    path = read_tum(Path("live.txt"))
    assert len(path.time) > 10 and np.isfinite(path.position).all()
    if all(map(importlib.util.find_spec, ("jax2onnx", "onnx", "onnxruntime"))):
        lowered = mistake("export", "named.zip", "--out", "models")
        assert "low_pass_seconds" in lowered or "predicts no displacement" in lowered


@pytest.mark.slow
@pytest.mark.parametrize("recipe", [*RECIPES, *sorted(OTHERS)])
def test_from_training_to_live(
    recipe, gnio, mistake, undrawn, tmp_path, tmp_path_factory, monkeypatch
):
    """Train, evaluate tight and loose, publish, export and follow a recording live."""
    if recipe not in ALWAYS and not os.environ.get("GNIO_EVERY_NETWORK"):
        pytest.skip("takes minutes; set GNIO_EVERY_NETWORK=1")
    if recipe == "ridi":
        pytest.importorskip("sklearn", reason="needs gnio-jax[ridi]")
    monkeypatch.chdir(tmp_path)
    folder, seeds = tmp_path_factory.mktemp("data"), iter(range(3))
    root = tlio_files.write_splits(folder, spoil=lambda parts: walk_instead(parts, next(seeds)))
    network = NAMED.get(recipe, recipe)
    words = () if recipe in OTHERS else ("--config", f"baselines/{recipe}")
    words += ("--segments.seconds", "4") if network in WITH_MEMORY else ()
    words += ("--model.equivariance", "four_headings") if network == "gru" else ()
    words += ("--model.name", network, *smallest(network), *CHANGED)
    if recipe == "ridi":  # which fits as many as it needs
        words = [word for word in words if "supports" not in word and word != "--set"]
    gnio("train", *words, "--data-root", root, "--workdir", "run")
    measured = []
    for coupling in ("tight", "loose"):
        gnio("evaluate", "--network", "run", "--no-plots", "--coupling", coupling)
        name = "tlio_test_ekf" + "_loose" * (coupling == "loose")
        score = json.loads((Path("run/eval") / name / "metrics.json").read_text())
        assert np.isfinite(score["mean"]["ate"])
        with np.load(Path("run/eval") / name / "states" / "c.npz") as states:
            measured.append(states["displacement"])
    # Both begin with the same attitude, which turns the first window. They differ by the drift of
    # the gyro since then.
    first = np.flatnonzero(np.isfinite(measured).all(axis=(0, 2)))[0]
    tight, loose = measured[0][first], measured[1][first]
    assert np.linalg.norm(tight - loose) < 0.2 * np.linalg.norm(tight) + 0.02
    gnio("publish", "run", "--out", "named.zip", "--data", "simulated walks", "--license", "CC0")
    walk = Path("walk.csv")
    write_phone_log(walk)
    gnio("live", walk, "--network", "named.zip", "--out", "live.txt")
    path = read_tum(Path("live.txt"))
    assert len(path.time) > 20 and np.isfinite(path.position).all()
    gnio("track", walk, "--network", "named.zip", "--out", "track")
    track = read_tum(Path("track/trajectory.txt"))
    assert np.linalg.norm(track.position[-1] - path.position[-1]) < 0.5
    if not all(map(importlib.util.find_spec, ("jax2onnx", "onnx", "onnxruntime"))):
        return
    brief = functools.partial(onnx.export_run, seconds=6.0)
    monkeypatch.setattr(onnx, "export_run", brief)
    assert "against gnio-jax" in gnio("export", "named.zip", "--out", "models")
