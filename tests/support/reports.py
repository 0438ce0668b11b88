"""Made-up reports of evaluations, from metrics alone."""

import hashlib
import json

import numpy as np

from gnio_jax.config import ModelConfig, OptimConfig, TrainConfig
from gnio_jax.evaluation import report
from gnio_jax.evaluation.metrics import Measures
from gnio_jax.evaluation.report import Report
from gnio_jax.networks.folder import write_weights

BASE = TrainConfig(dataset="tlio", model=ModelConfig(width=4), optim=OptimConfig(epochs=40))
LOST = np.inf
"""An `ate` of an estimate that diverged."""
SETTINGS = {
    "dataset": "synthetic",
    "data_root": None,
    "split": "test",
    "estimator": "ekf",
    "coupling": "tight",
    "orientation_source": "filter",
    "initial_state": "reference",
    "gyro_bias": "zero",
    "imu_compensated": "no",
    "alignment": "origin",
    "checkpoint": "best",
    "filter": {},
    "definitions": report.DEFINITIONS,
}


def measures(**values):
    """Of a sequence; infinite where it diverged."""
    return Measures(values, {}, values.get("ate") == LOST)


def report_of(ates, groups, more=None, drop=(), **settings):
    """A report: `ate` of sequence -> m, `rpe_1s` a tenth of it. `groups` are those of the
    sequences; `more`: other metrics of each; `drop`: metrics that it lacks."""
    scores = {}
    for name, ate in ates.items():
        values = {"ate": ate, "rpe_1s": ate / 10, **(more or {})}
        scores[name] = measures(**{key: x for key, x in values.items() if key not in drop})
    seconds = {name: 60.0 for name in ates}
    settings = {**SETTINGS, "recordings": seconds, **settings}
    return Report(settings, scores, {}, {name: groups[name] for name in ates}, {}, {})


def write_report(folder, report_made):
    """Its metrics.json."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "metrics.json").write_text(json.dumps(report.as_json(report_made)), encoding="utf-8")
    return folder


def write_run(folder, text="dataset: synthetic\n", step=7):
    """A run whose weights have no array, as far as comparisons look at one."""
    folder.mkdir(parents=True, exist_ok=True)
    write_weights(folder, {}, epoch=1, step=step)
    (folder / "config.yaml").write_text(text)
    return folder


def write_log(folder, epochs):
    """The log of a run after so many epochs."""
    rows = [json.dumps({"epoch": epoch}) + "\n" for epoch in range(epochs)]
    (folder / "metrics.jsonl").write_text("".join(rows))


def digest(folder):
    """That of a run's weights, as its evaluations have it."""
    return hashlib.sha256((folder / "weights.safetensors").read_bytes()).hexdigest()
