"""Exported models run by ONNX Runtime, as in a program without JAX.

This is the loop that a user writes in another language; `examples/onnx/track.cpp` is the same in
C++. It needs only NumPy and ONNX Runtime, except for the shapes in its annotations.
"""

# The extra `onnx` need not be installed where types are checked.
# pyright: reportMissingImports=false

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

STATE, NEXT, POSE = "state.", "next.", "pose."
"""Prefixes of the names of arrays of the state, of the state after a step, and of the pose."""


class Models(NamedTuple):
    """Open sessions of the four models, and the numbers of their metadata."""

    network: Any
    start: Any
    window: Any
    step: Any
    first_inferred: int
    first_measured: int
    log_std_min: float


class WalkResult(NamedTuple):
    """The results of the models for K clone intervals."""

    windows: Float[np.ndarray, "m n c"]
    """What the network saw. A network on windows sees none in the first F = `first_measured`
    intervals, so m = K − F; one with memory sees every interval."""
    displacement: Float[np.ndarray, "m2 3"]
    """Displacements that the filter measured, K − F, m."""
    position: Float[np.ndarray, "k 3"]
    """m."""
    rotation: Float[np.ndarray, "k 3 3"]
    """Body → world."""
    covariance: Float[np.ndarray, "k 15 15"]
    """Covariance of θ, v, p, b_g, b_a."""


def open_models(folder: Path, threads: int = 1) -> Models:
    """The models of an export."""
    names = ("network", "filter_start", "filter_window", "filter_step")
    network, start, window, step = (
        open_session(folder / f"{name}.onnx", threads) for name in names
    )
    metadata = step.get_modelmeta().custom_metadata_map
    return Models(
        network=network,
        start=start,
        window=window,
        step=step,
        first_inferred=int(metadata["first_inferred"]),
        first_measured=int(metadata["first_measured"]),
        log_std_min=float(metadata["log_std_min"]),
    )


def open_session(path: Path, threads: int = 1) -> Any:
    """An `onnxruntime.InferenceSession` on the CPU."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.log_severity_level = 3  # It warns of constants that it has folded itself.
    return onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])


def run(session: Any, arrays: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Outputs by name; of `arrays` the session gets those that it takes."""
    inputs = {array.name: arrays[array.name] for array in session.get_inputs()}
    names = [array.name for array in session.get_outputs()]
    return dict(zip(names, session.run(names, inputs), strict=True))


def walk(
    models: Models,
    state: Mapping[str, np.ndarray],
    gyro: Float[np.ndarray, "s 3"],
    accel: Float[np.ndarray, "s 3"],
) -> WalkResult:
    """Filter K·n samples, rad/s and m/s², raw, from the state of `models.start` or
    `start_arrays`."""
    n = next(array.shape[0] for array in models.step.get_inputs() if array.name == "gyro")
    windows, steps = [], []
    for k in range(len(gyro) // n):
        rows = slice(k * n, (k + 1) * n)
        stride = {"gyro": gyro[rows], "accel": accel[rows]}
        measured = {"displacement": np.full(3, np.nan), "covariance": np.eye(3)}  # none
        if k >= models.first_inferred:
            window = run(models.window, {**state, **stride})
            prediction = run(models.network, {**state, **window})
            windows.append(window["window"][0])
            if k >= models.first_measured:
                measured = measure(models, prediction)
            state = {**state, **next_state(prediction)}  # of a network with memory
        outputs = run(models.step, {**state, **stride, **measured})
        state = {**state, **next_state(outputs)}
        steps.append(outputs)
    position, rotation, covariance = (
        np.array([outputs[POSE + name] for outputs in steps])
        for name in ("position", "rotation", "covariance")
    )
    measured = np.array([outputs["measured"] for outputs in steps[models.first_measured :]])
    return WalkResult(np.array(windows), measured, position, rotation, covariance)


def next_state(outputs: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The arrays of the next state that a model gives."""
    arrays = {name: value for name, value in outputs.items() if name.startswith(NEXT)}
    return {STATE + name.removeprefix(NEXT): value for name, value in arrays.items()}


def measure(models: Models, prediction: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """A prediction of the network in the form that the filter step takes."""
    log_std = np.maximum(prediction["log_std"][0].astype(float), models.log_std_min)
    displacement = prediction["displacement"][0].astype(float)
    covariance = np.diag(np.exp(2 * log_std))
    if "axes" in prediction:
        cosine, sine = prediction["axes"][0].astype(float)
        turn = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])
        covariance = turn @ covariance @ turn.T
    return {"displacement": displacement, "covariance": covariance}
