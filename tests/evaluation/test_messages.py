"""What the evaluation refuses, and why a metric has no value: a table of calls and messages."""

import json
import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from gnio_jax import data
from gnio_jax.config import EvaluateConfig
from gnio_jax.errors import InputError
from gnio_jax.evaluation import (
    Undefined,
    align,
    evaluate,
    load,
    measure,
    metrics,
    prepare,
    reuse,
    score_files,
)
from gnio_jax.evaluation.report import DEFINITIONS, as_json
from gnio_jax.evaluation.trajectory import Trajectory, read_tum, read_waypoints, write_tum
from gnio_jax.types import Sequence, Waypoints
from tests.support.estimators import CONFIG, with_waypoints
from tests.support.reports import write_run
from tests.support.trajectories import STEP, lost, masked, walk

WALK = walk()
LINE = 0.125 * np.arange(501)[:, None] * [1.0, 0.0, 0.0]
"""Positions on a straight line, at 1.25 m/s."""
BEFORE_AND_AFTER = Waypoints(WALK.time[[0, -1]] + [0.0, 1.0], np.zeros((2, 2)))
"""One waypoint at the start of the walk, and one a second after its end."""

UNDEFINED = [
    (lambda: metrics.drift(0.01 * LINE, 0.01 * LINE, STEP), "is 0.62 m long, under 1 m"),
    (lambda: metrics.rte(LINE[:1], LINE[:1], STEP), "a single trusted row"),
    (lambda: metrics.rte_distance(LINE, LINE, STEP, 100.0), "no unbroken reference of 100 m"),
    (lambda: metrics.stationary_drift(LINE, LINE, STEP), "never stands still for 2 s"),
    (lambda: metrics.yaw_drift(*[WALK.orientation[:50]] * 2, STEP), "less than 10 s"),
    (lambda: metrics.t_rel(WALK, WALK, STEP), "no unbroken reference of 100 m"),
    (lambda: align(WALK, BEFORE_AND_AFTER), "fewer than two waypoints are within the estimate"),
    *(
        (
            lambda how=how: align(lost(WALK, 500), masked(WALK, slice(0, 500)), how),
            "the estimate is not finite in any trusted row",
        )
        for how in ("origin", "yaw_position", "se3")
    ),
]


@pytest.mark.parametrize("call, message", UNDEFINED)
def test_a_metric_without_a_value_has_a_reason(call, message):
    with pytest.raises(Undefined, match=message):
        call()


@pytest.mark.parametrize("time, rows", [(5.0, 900), (0.0, 899)])
def test_a_reference_has_the_stamps_of_the_estimate(time, rows):
    reference = Trajectory(WALK.time[:rows] + time, *(part[:rows] for part in WALK[1:]))
    with pytest.raises(ValueError, match="reference: has other stamps than the estimate"):
        measure(WALK, reference)


class Inputs(NamedTuple):
    """What the calls below take."""

    walk: Sequence
    folder: Path
    run: Path


@pytest.fixture
def inputs(walks, trained, tmp_path, monkeypatch):
    monkeypatch.setattr(data, "load", lambda *_: [with_waypoints(walks[0])._replace(name="tapped")])
    return Inputs(walks[0], tmp_path, trained)


def write(path, text):
    path.write_text(text)
    return path


def without_reference(walk):
    return walk._replace(valid=np.zeros(len(walk.time), bool))


def prepared(sequence, **options):
    return prepare([sequence], CONFIG, **options)


def scored(inputs, rows, shift):
    """The walk against some of its rows, with stamps that are `shift` s later."""
    reference = Trajectory(*(part[rows] for part in WALK))
    paths = inputs.folder / "truth.txt", inputs.folder / "odometry.txt"
    write_tum(paths[0], reference._replace(time=reference.time + shift))
    write_tum(paths[1], WALK)
    return score_files(*paths)


def evaluated(inputs, **options):
    return evaluate(EvaluateConfig(str(inputs.run), batch_size=2, plots=False, **options))


def found_without_weights(inputs):
    run = write_run(inputs.folder / "run")
    (run / "weights.safetensors").unlink()
    return reuse.find_existing(EvaluateConfig(str(run), plots=False))


REFUSED = [
    (lambda x: prepared(without_reference(x.walk)), "has no reference; give --init static"),
    (
        lambda x: prepared(without_reference(x.walk), init="static", gyro_bias="reference"),
        "has no reference; give --gyro-bias zero",
    ),
    (
        lambda x: prepared(without_reference(x.walk), init="static", orientation="reference"),
        "has no reference; give --orientation filter",
    ),
    (
        lambda x: prepared(x.walk._replace(device_orientation=None), orientation="device"),
        "has no device orientation",
    ),
    (
        lambda x: prepared(with_waypoints(x.walk), gyro_bias="reference"),
        "has waypoints, no poses; give --gyro-bias zero",
    ),
    (
        lambda x: prepared(with_waypoints(x.walk), orientation="reference"),
        "has waypoints, no poses; give --orientation filter",
    ),
    (lambda x: read_tum(write(x.folder / "a.txt", "1 2 3\n4 5 6\n")), "a.txt: .*3 columns, not 8"),
    (lambda x: read_waypoints(write(x.folder / "a.txt", "1 2\n")), "a.txt: .*2 columns, not 3"),
    (
        lambda x: scored(x, slice(None), 1e4),
        "odometry.txt: fewer than two stamps are the same to 0.01 s as in .*truth.txt",
    ),
    (
        lambda x: scored(x, slice(0, 1), 0.0),
        "odometry.txt: the reference has a single pose as in .*truth.txt",
    ),
    (
        lambda x: scored(x, [0, 1, 2, 899], 0.0),
        "odometry.txt: only 4 stamps in 90 s, unevenly spaced, are the same as in .*truth",
    ),
    (found_without_weights, "holds no weights .*; let gnio train finish its first epoch"),
    (lambda x: evaluated(x, estimator="imu_only", orientation="device"), "leave it out, or choose"),
    *(
        (
            lambda x, how=how: evaluated(x, estimator=how, coupling="loose"),
            f"^--coupling loose: {how} has no filter",
        )
        for how in ("integrate", "imu_only")
    ),
    (
        lambda x: evaluated(x, estimator="integrate", set=("filter.noise.gyro_density=5",)),
        "^--set filter.noise.gyro_density=5: integrate has no filter; leave it out",
    ),
    (lambda x: evaluated(x, alignment="se3"), "^tapped: has waypoints, .*leave it out"),
    (
        lambda x: evaluated(x, estimator="integrate"),
        "^tapped: has waypoints, .*--orientation filter",
    ),
    (lambda x: load(x.folder), "is neither a run nor an evaluation"),
    (lambda x: load(write(x.folder / "metrics.json", "{}")), "is neither a run nor an evaluation"),
    (lambda x: load(x.folder / "nowhere"), "is neither a run nor an evaluation"),
]


@pytest.mark.parametrize("call, message", REFUSED)
def test_a_mistake_is_named_in_one_line(inputs, call, message):
    with pytest.raises(InputError, match=message) as caught:
        call(inputs)
    assert "\n" not in str(caught.value)


NO_FIGURES = "metrics.json: is not a metrics.json of an evaluation; evaluate the run again"
DAMAGED = [
    (("sequences", "blind", "reasons"), {"ate": 5}, NO_FIGURES),
    (("sequences", "blind", "group"), None, NO_FIGURES),
    (("sequences", "blind", "nis"), 10**400, NO_FIGURES),
    (("sequences", "blind", "nis"), math.inf, NO_FIGURES),
    (("sequences", "blind", "infinite"), ["nis"], NO_FIGURES),
    (("sequences", "blind", "diverged"), "no", NO_FIGURES),
    (("sequences", "blind", "notes"), [5], NO_FIGURES),
    (("settings", "split"), 5, NO_FIGURES),
    (("settings", "filter"), 5, NO_FIGURES),
    (("settings",), [], NO_FIGURES),
    (("sequences",), {}, NO_FIGURES),
    (("left_out",), {"short": None}, NO_FIGURES),
    (("settings", "definitions"), DEFINITIONS - 1, "metrics.json: was written by another version"),
]


@pytest.mark.parametrize("fields, value, message", DAMAGED)
def test_figures_of_another_structure_are_refused(made_report, tmp_path, fields, value, message):
    content = inner = json.loads(json.dumps(as_json(made_report)))
    for name in fields[:-1]:
        inner = inner[name]
    inner[fields[-1]] = value
    write(tmp_path / "metrics.json", json.dumps(content))
    with pytest.raises(InputError, match=message):
        load(tmp_path)


@pytest.mark.parametrize("content", [b"[" * 100_000, b"nothing", b"\xff"])
def test_a_file_that_is_no_json_is_refused(tmp_path, content):
    (tmp_path / "metrics.json").write_bytes(content)
    with pytest.raises(InputError, match=NO_FIGURES):
        load(tmp_path)
