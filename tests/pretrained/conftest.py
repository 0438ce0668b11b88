"""A run of the smallest network, with the figures of one evaluation."""

import json

import pytest

from gnio_jax.config import DataConfig, ModelConfig, TrainConfig
from tests.support import tiny_run
from tests.support.filter_settings import changed

CONFIG = TrainConfig(
    dataset="synthetic",
    data_root="/home/somebody/recordings",
    init_from="runs/earlier",
    seed=7,
    data=DataConfig(rate=50.0),
    model=ModelConfig(name="tiny"),
    filter=changed(noise={"std_factor": (1.7, 1.0, 1.0)}, considered={"scale": 0.02}),
)
FIGURES = {
    "settings": {"dataset": "synthetic", "split": "test", "estimator": "ekf"},
    "sequences": {"a": {}, "b": {}},
    "mean": {"ate_2d": 1.234, "yaw_rmse": None},
    "interval": {"ate_2d": [0.9, 1.6], "yaw_rmse": None},
    "n": {"ate_2d": 2},
}


@pytest.fixture(scope="package")
def run(tmp_path_factory):
    with tiny_run.known():
        folder = tiny_run.save(tmp_path_factory.mktemp("trained") / "walk", CONFIG)
        evaluation = folder / "eval" / "synthetic_test_ekf"
        evaluation.mkdir(parents=True)
        (evaluation / "metrics.json").write_text(json.dumps(FIGURES))
        yield folder
