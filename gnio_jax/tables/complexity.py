"""Parameters, operations and latency of every network, beside the paper's columns."""

from __future__ import annotations

import time
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gnio_jax import models
from gnio_jax.cores import usable_cores
from gnio_jax.tables.markdown import grid

PUBLISHED = {
    "tlio": (5.42, 0.08),
    "deepils": (2.29, 0.03),
    "ctin": (0.56, 7.27),
    "imot": (14.49, 7.79),
    "gnio": (4.90, 0.08),
}
"""Parameters in millions and the column "GFLOPs", as the paper prints them."""
NETWORKS = ("tlio", "ronin_resnet", "deepils", "ctin", "imot", "imot_text", "gnio")
NOTE = (
    "The paper's CNN rows are 2 × multiply-adds of one window of 200 samples, as is the measured "
    "column, which leaves out the taps in the padding. Its transformer rows repeat those papers' "
    'own "GFLOPs/s", another quantity; compare the measured column. Its GNIO has no bank: '
    "4,901,385 parameters, 4,934,153 with it. DeepILS and RoNIN are counted with three outputs."
)


class Complexity(NamedTuple):
    """What one network costs."""

    network: str
    parameters: int
    gflops: float
    """Floating-point operations of one window in the compiled program, 10⁹."""
    latency: dict[int, float]
    """Batch -> time per window, ms, median."""


def measure(
    network: str, samples: int = 200, batches: tuple[int, ...] = (1, 128), seconds: float = 3.0
) -> Complexity:
    """Cost of a network's inference, batch norms folded, on this machine; each latency is timed for
    about `seconds`."""
    model = models.create(network)
    variables = models.initialise(model, jax.random.key(0), samples)
    frozen, inference = models.inference_variables(model, variables), models.Inference(model)
    latency, operations = {}, 0.0
    for batch in batches:
        drawn = np.random.default_rng(0).standard_normal((batch, samples, 6))
        windows = jnp.asarray(drawn, jnp.float32)
        compiled = jax.jit(inference).lower(frozen, windows).compile()
        if batch == batches[0]:
            operations = (compiled.cost_analysis() or {})["flops"] / batch
        latency[batch] = 1e3 * _median_time(compiled, frozen, windows, seconds) / batch
    parameters = sum(leaf.size for leaf in jax.tree.leaves(variables["params"]))
    return Complexity(network, parameters, operations / 1e9, latency)


def _median_time(compiled: Any, frozen: Any, windows: jax.Array, seconds: float) -> float:
    """Of one call, s, over about `seconds`."""
    jax.block_until_ready(compiled(frozen, windows))
    times: list[float] = []
    while sum(times) < seconds and len(times) < 500:
        began = time.perf_counter()
        jax.block_until_ready(compiled(frozen, windows))
        times.append(time.perf_counter() - began)
    return float(np.median(times))


def hardware() -> str:
    """What it runs on, for the notes of a table."""
    device, cores = jax.devices()[0], usable_cores()
    if device.platform != "cpu":
        return device.device_kind
    return f"{cores} CPU core{'s' if cores > 1 else ''}"


def markdown(found: list[Complexity], device: str) -> str:
    """The table."""
    batches = list(found[0].latency)
    header = [
        "",
        "parameters",
        "GFLOP / window",
        *(f"ms / window, batch {batch}" for batch in batches),
        "paper: parameters",
        'paper: "GFLOPs"',
    ]
    table = [
        [
            row.network,
            f"{row.parameters:,}",
            f"{row.gflops:.3f}",
            *(f"{row.latency[batch]:.2f}" for batch in batches),
            *_published(row.network),
        ]
        for row in found
    ]
    head = f"## Complexity\n\nOne window of 200 samples, float32, on {device}. {NOTE}\n\n"
    return head + grid(header, table)


def _published(network: str) -> tuple[str, str]:
    if network not in PUBLISHED:
        return "–", "–"
    millions, gflops = PUBLISHED[network]
    return f"{millions:.2f} M", f"{gflops:.2f}"
