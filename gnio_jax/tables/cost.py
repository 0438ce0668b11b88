"""What a table's network costs: its parameters, and the time of network and filter for an interval.
It is measured once and stays in the folder of the network's first run."""

from __future__ import annotations

import json
from pathlib import Path
from typing import NamedTuple

import jax

from gnio_jax.cores import processor_name
from gnio_jax.evaluation.speed import interval_seconds
from gnio_jax.files import write_text
from gnio_jax.networks import read_network
from gnio_jax.reporting import Reporter

FILE = "cost.json"


class RunCost(NamedTuple):
    """The cost of a trained network."""

    parameters: int
    """Numbers that were trained; for support vectors, those that were kept."""
    interval_ms: float
    """Time of network and filter for a clone interval, ms (`evaluation.speed`)."""
    device: str
    """Name of the device (`device_name`)."""


def device_name() -> str:
    """The name of the device on which networks run. JAX has one name for all processors."""
    device = jax.devices()[0]
    return processor_name() if device.platform == "cpu" else device.device_kind


def load_or_measure(run: Path, reporter: Reporter) -> RunCost:
    """The cost of a run's network. It is measured again on another device, and if its file cannot
    be read."""
    device = device_name()
    try:
        cost = RunCost(**json.loads((run / FILE).read_text(encoding="utf-8")))
        if cost.device == device:
            return cost
    except (OSError, ValueError, TypeError):
        pass
    reporter.line(f"timing {run.name} with the filter")
    trained = read_network(run)
    parameters = sum(leaf.size for leaf in jax.tree.leaves(trained.variables["params"]))
    cost = RunCost(parameters, 1e3 * interval_seconds(trained), device)
    write_text(run / FILE, json.dumps(cost._asdict()) + "\n")
    return cost
