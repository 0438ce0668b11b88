"""Impossible values are rejected by name, eagerly, and reported inside `jit`."""

import dataclasses
import re
from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gnio_jax import filtering, models, types
from gnio_jax.filtering.checks import check_filter, checked_inputs
from gnio_jax.filtering.history import describe_failure
from gnio_jax.filtering.state import CLONE, with_correlated_errors
from tests.support.checks import unchecked
from tests.support.random_walk import random_walk

if TYPE_CHECKING:
    from gnio_jax.config.schema import Number

N, CLONES, DT, INTERVALS = 5, 4, 0.02, 60
CONFIG = filtering.FilterConfig(DT, N, CLONES, history="core")
NOISE = filtering.NoiseModel(measurement_scale=2.0)
WALK = random_walk(11, n=N, clones=CLONES, intervals=INTERVALS, dt=DT, bias=False)
POSE, GYRO, ACCEL, DISPLACEMENT, COVARIANCE = WALK
SAMPLES, NAN = len(GYRO), float("nan")


def start():
    return filtering.initial_state(filtering.Filter(CONFIG), *POSE)


def put(array, at, value):
    array = np.array(array)
    array[at] = value
    return array


def wrong():
    """Arguments of a run that cannot be, and how the message begins."""
    state, correlated = start(), NOISE._replace(correlation=filtering.CorrelatedError())
    yield "gyro: 1 of 300 rows", {"gyro": put(GYRO, (7, 1), NAN)}
    yield "gyro: the samples must be a multiple", {"gyro": GYRO[:-1]}
    yield "gyro", {"gyro": GYRO[:0]}
    yield "gyro", {"gyro": np.zeros((SAMPLES, 4))}
    yield "gyro: the filter runs in float64", {"gyro": GYRO.astype(np.float32)}
    yield "gyro", {"gyro": GYRO.astype(int)}
    yield "accel: 1 of 300 rows", {"accel": put(ACCEL, 9, np.inf)}
    fast, strong = put(GYRO, (7, 1), -101.0), put(ACCEL, (9, 2), 1001.0)
    yield "gyro: 1 of 300 rows are beyond 100 rad/s, the first is row 7", {"gyro": fast}
    yield "accel: 1 of 300 rows are beyond 1000 m/s², the first is row 9", {"accel": strong}
    only_this = np.arange(SAMPLES) == 7  # what is missing may be anything
    yield "gyro: 1 of 300 rows are beyond", {"gyro": fast, "imu_valid": only_this}
    yield "accel: the shape", {"accel": ACCEL[N:]}
    yield "displacement: the shape", {"displacement": DISPLACEMENT[1:]}
    yield "covariance: the shape", {"covariance": COVARIANCE[:, 0]}
    yield "covariance: 1 of 60 rows", {"covariance": put(COVARIANCE, 10, -np.eye(3))}
    yield "covariance: 1 of 60 rows", {"covariance": put(COVARIANCE, (10, 0, 1), 1.0)}
    yield "imu_valid: must be booleans", {"imu_valid": np.ones(SAMPLES, int)}
    yield "imu_valid: the shape", {"imu_valid": np.ones(3, bool)}
    for field, number in (
        ("accel_density", -1.0),
        ("gyro_density", np.zeros(3)),
        ("measurement_scale", 0.0),
        ("measurement_scale", "10"),
        ("std_factor", (1.0, 0.0, 1.0)),
    ):
        noise = NOISE._replace(**{field: number})
        yield f"ekf.noise.{field}", {"ekf": filtering.Filter(CONFIG, noise)}
    for factor in (1.0, np.ones(3), (1.0, 1.0)):
        ekf = filtering.Filter(CONFIG, NOISE._replace(std_factor=factor))
        yield "ekf.noise.std_factor: must be a tuple of three numbers", {"ekf": ekf}
    for part, value, kind in (
        ("config", {"dt": DT}, "FilterConfig"),
        ("noise", (1e-3, 1e-2), "NoiseModel"),
        ("noise.correlation", (0.5, 0.5), "CorrelatedError"),
        ("start", {"yaw": 0.1}, "InitialStd"),
        ("considered", 0.1, "ConsideredStd"),
    ):
        parts = {"config": CONFIG, part: value}
        if part == "noise.correlation":
            parts = {"config": CONFIG, "noise": NOISE._replace(correlation=value)}
        with unchecked():
            ekf = filtering.Filter(**parts)
        yield f"ekf.{part}: must be a {kind}, e.g. ", {"ekf": ekf}
    standstill, constraint = filtering.ZeroVelocity(0.1), filtering.NonHolonomic(lateral_std=NAN)
    for measurements, problem in (
        ((filtering.ZeroVelocity(-0.1),), r"\[0\].std: must be positive"),
        ((filtering.ZeroVelocity("a"),), r"\[0\].std: must be a number, found 'a'"),
        ((standstill, constraint), r"\[1\].lateral_std: must be positive"),
        ((filtering.ZeroVelocity,), r"\[0\]: is the class ZeroVelocity"),
        ({"zero_velocity": {"std": 0.1}}, r": must be a tuple .* dict; write \(\) for none$"),
        (standstill, r": must be a tuple .* ZeroVelocity; write \(zero_velocity,\) for one$"),
    ):
        with unchecked():
            ekf = filtering.Filter(CONFIG, NOISE, measurements=measurements)
        yield f"ekf.measurements{problem}", {"ekf": ekf}
    alone = r"measurements\[0\].std: must have a row .* is a part of the Filter$"
    yield alone, {"measurements": (standstill,)}
    for nothing in (None, "rows", GYRO.astype(object), [[0.0, 0.0, 0.0], [0.0]]):
        yield "gyro: must be an array of numbers, found", {"gyro": nothing}
    yield "covariance: must be an array of numbers, found NoneType", {"covariance": None}
    for value in (None, dict(state._asdict()), POSE):
        yield r"state: must be a FilterState, e.g. initial_state\(", {"state": value}
    yield r"accel: the shape must be \(300, 3\), found \(300, 2\)$", {"accel": ACCEL[:, :2]}
    yield r"gyro: the shape .*; for a batch of sequences use jax.vmap$", {"gyro": GYRO[None]}
    batch = {"displacement": np.stack([DISPLACEMENT, DISPLACEMENT])}
    yield r"displacement: the shape .*; for a batch of sequences use jax.vmap$", batch
    other = filtering.initial_state(filtering.Filter(filtering.FilterConfig(DT, N, 3)), *POSE)
    yield r"state.clone_rotation: the shape must be \(5, 3, 3\)", {"state": other}
    less = state.core_covariance - jnp.eye(21)
    yield "state.core_covariance", {"state": state._replace(core_covariance=less)}
    for entry in ((2, 5), (5, 2)):
        lopsided = put(state.core_covariance, entry, 1e-3)
        yield (
            "state.core_covariance: is not symmetric",
            {"state": state._replace(core_covariance=lopsided)},
        )
    clones = CLONE * CONFIG.clones
    angles_and_offsets = np.tile(np.repeat([1e-4, 1e8], 3), CONFIG.clones)  # rad² and m²
    for problem, covariance in (
        ("positive definite", np.diag(angles_and_offsets - 2e-4 * (np.arange(clones) == 6))),
        ("positive definite", -np.eye(clones)),
        ("positive definite", np.eye(clones) + 1.1 * (np.eye(clones, k=6) + np.eye(clones, k=-6))),
        ("symmetric", np.eye(clones) + 0.1 * np.eye(clones, k=1)),
        ("symmetric", np.eye(clones) + 0.1 * np.eye(clones, k=-1)),
    ):
        wrong_state = state._replace(clone_covariance=covariance)
        yield f"state.clone_covariance: is not {problem}", {"state": wrong_state}
    yield "frame: must be 'own' or 'turning' or 'given' or 'body', found 'onw'", {"frame": "onw"}
    yield "frame: must be 'own' or 'turning' or 'given' or 'body', found None", {"frame": None}
    position = np.zeros((INTERVALS, 2))
    covariance = np.tile(np.eye(2), (INTERVALS, 1, 1))
    fix = filtering.Fix(position, covariance, *np.ones((3, INTERVALS)))
    for measurements, problem in (
        (fix, r": must be a tuple of measurements, found Fix; write \(fix,\) for one$"),
        (position, ": must be a tuple of measurements, found ndarray"),
        (None, ": must be a tuple of measurements, found NoneType"),
        ((fix, position), r"\[1\]: ndarray has no method update"),
    ):
        yield f"measurements{problem}", {"measurements": measurements}
    yield "state.rotation", {"state": state._replace(rotation=2 * jnp.eye(3))}
    lost = with_correlated_errors(state, 3)._replace(correlated=np.array([0.0, NAN, 0.0]))
    correlated = filtering.Filter(CONFIG, correlated)
    yield "state.correlated", {"state": lost, "ekf": correlated}
    car = filtering.Filter(CONFIG, measurements=(filtering.NonHolonomic(lever_std=0.5),))
    second = type("Second", (filtering.NonHolonomic,), {"name": "second"})
    for measurements, problem in (
        ((filtering.NonHolonomic(mounting_seconds=5.0),), r"\[0\].mounting_seconds: has no effect"),
        ((*car.measurements, second(mounting_std=0.1)), ": a filter estimates the mounting of one"),
    ):
        ekf = filtering.Filter(CONFIG, measurements=measurements)
        yield f"ekf.measurements{problem}", {"ekf": ekf}
    yield r"measurements\[0\]: the mounting is estimated", {"measurements": car.measurements}
    problem = "state.correlated: the state has 3 correlated errors, and the filter 6"
    yield problem, {"state": with_correlated_errors(state, 3), "ekf": car}
    for field in (
        *("velocity", "offset", "gyro_bias", "accel_bias", "anchor", "move", "clone_rotation"),
        *("clone_offset", "cross_covariance", "clone_covariance"),
    ):
        spoilt = put(getattr(state, field), (..., -1), NAN)
        yield f"state.{field}", {"state": state._replace(**{field: spoilt})}


def arguments(**others):
    names = ("gyro", "accel", "displacement", "covariance")
    signals = dict(zip(names, WALK[1:], strict=True))
    return {"ekf": filtering.Filter(CONFIG, NOISE), "state": start(), **signals, **others}


def test_arguments_that_cannot_be_are_refused_by_name():
    for words, spoilt in wrong():
        with unchecked(), pytest.raises(ValueError, match=f"^{words}"):
            filtering.run_filter(**arguments(**spoilt))
    missing = np.arange(SAMPLES) != 7
    ekf = filtering.Filter(CONFIG, NOISE)
    checked_inputs(ekf, start(), put(GYRO, (7, 1), -101.0), ACCEL, missing, ())
    for beginning in (
        *(
            "covariance: 1 of",
            "ekf.noise.accel_density",
            "imu_valid: must",
            "frame: must",
            "measurements",
        ),
    ):
        spoilt = next(changes for words, changes in wrong() if words.startswith(beginning))
        with unchecked(), pytest.raises(ValueError, match=f"^{beginning}"):
            filtering.smooth(**arguments(**spoilt))


def test_an_impossible_start_is_refused_by_name():
    for field, value in (
        ("rotation", 2 * np.eye(3)),
        ("rotation", np.eye(4)),
        ("velocity", np.full(3, NAN)),
        ("position", np.zeros((1, 3))),
        ("gyro_bias", np.full(3, NAN)),
        ("gyro_bias", None),
        ("accel_bias", np.zeros((3, 1))),
        ("accel_bias", "zero"),
        ("velocity", None),
        ("position", [[0.0], 0.0]),
        ("ekf.start.tilt", -1.0),
        ("ekf.start.yaw", np.zeros(3)),
        ("level_gyro_bias", -0.05),
        ("level_gyro_bias", NAN),
        ("level_gyro_bias", np.full(3, 0.05)),
    ):
        pose = dict(zip(("rotation", "velocity", "position"), POSE, strict=True))
        *part, name = field.split(".")
        std = filtering.InitialStd(**{name: value} if part else {})
        pose |= {} if part else {name: value}
        with unchecked(), pytest.raises(ValueError, match=f"^{field}:"):
            filtering.initial_state(filtering.Filter(CONFIG, start=std), **pose)


def test_settings_that_make_no_sense_are_refused_by_name():
    for name, values in {
        "dt": (0.0, NAN, "0.01", True),
        "samples_per_clone": (0, 2.5),
        "clones_per_window": (0, True),
        "mahalanobis_fail_scale": (-1.0,),
        "history": ("all",),
        "log_std_min": (float("-inf"),),
        "gate_threshold": (0.0,),
        "speed_limit": (0.0, np.inf),
    }.items():
        for value in values:
            fields = {"dt": 0.01, "samples_per_clone": 2, "clones_per_window": 3, name: value}
            with pytest.raises(ValueError, match=f"^FilterConfig: field '{name}' "):
                filtering.FilterConfig(**fields)


def test_the_precision_is_asked_for():
    single = [part.astype(np.float32) for part in POSE]
    with pytest.raises(ValueError, match=r"^rotation: .*float64, found float32.*allow_float32"):
        filtering.initial_state(filtering.Filter(CONFIG), *single)
    with jax.enable_x64(False), pytest.raises(ValueError, match="jax_enable_x64"):
        filtering.initial_state(filtering.Filter(CONFIG), *POSE)
    config = dataclasses.replace(CONFIG, allow_float32=True)
    state = filtering.initial_state(filtering.Filter(config), *single)
    inputs = arguments(state=state, ekf=filtering.Filter(config, NOISE))
    shapes = jax.eval_shape(lambda inputs: filtering.run_filter(**inputs), inputs)
    floating = [x for x in jax.tree.leaves(shapes) if jnp.issubdtype(x.dtype, jnp.floating)]
    assert all(leaf.dtype == jnp.float32 for leaf in floating)


@pytest.mark.parametrize("correlation", [None, filtering.CorrelatedError()])
def test_inside_jit_the_history_reports_it(correlation):
    """Also where the χ² gate tests the displacement: row 10 is its sixth."""
    config = dataclasses.replace(CONFIG, convergence_seconds=0.0)
    noise = NOISE._replace(correlation=correlation)
    run = jax.jit(lambda arguments: filtering.run_filter(**arguments)[1])
    for name, bad in (("gyro", 1), ("covariance", 10)):
        spoilt = next(changes for words, changes in wrong() if words.startswith(f"{name}: 1 of"))
        history = run(arguments(**spoilt, ekf=filtering.Filter(config, noise)))
        np.testing.assert_array_equal(history.healthy, np.arange(INTERVALS) < bad)


def test_the_cause_of_what_is_not_healthy_is_told():
    """A force of 50 m/s² for a second, a value that is not finite, a hole, a start that was bad."""
    limited = dataclasses.replace(CONFIG, speed_limit=20.0)
    valid = np.ones(SAMPLES, bool)
    valid[50:75] = False
    run = jax.jit(lambda arguments: filtering.run_filter(**arguments)[1])

    def cause(config, **changes):
        ekf, missing = filtering.Filter(config, NOISE), np.full((INTERVALS, 3), NAN)
        history = run(arguments(**{"ekf": ekf, "displacement": missing, **changes}))
        return filtering.explain_failure(history, config)

    pushed = put(ACCEL, np.s_[100:200, 0], 50.0)
    too_fast = r"a speed of 2\d m/s, above the limit of 20 m/s"
    assert cause(CONFIG) == ""
    assert cause(CONFIG, gyro=put(GYRO, (7, 1), NAN)) == "a value is not finite"
    assert re.fullmatch(too_fast, cause(limited, accel=pushed))
    behind = rf"{too_fast}, after a hole of 0\.5 s in the IMU's samples"
    assert re.fullmatch(behind, cause(limited, accel=pushed, imu_valid=valid))
    held = np.ones(SAMPLES, bool)
    held[60] = False  # the filter holds a sample, which is no hole that it coasts through
    assert re.fullmatch(too_fast, cause(limited, accel=pushed, imu_valid=held))
    bad = start()._replace(healthy=jnp.bool_(False))
    assert cause(CONFIG, state=bad) == "an earlier estimate was impossible"
    mean, variances = start().mean, np.full(15, 1e-3)
    variances[4] = -1e-9
    assert describe_failure(mean, variances, CONFIG) == "a variance is below 0"


def test_what_a_run_in_float32_leaves_is_a_state():
    """Its covariances are those of a start, up to rounding, and a later run takes it."""
    config = dataclasses.replace(CONFIG, allow_float32=True)
    values = arguments(
        state=filtering.initial_state(filtering.Filter(config), *POSE),
        ekf=filtering.Filter(config, NOISE),
    )
    single = {
        name: np.asarray(values[name], np.float32)
        for name in ("gyro", "accel", "displacement", "covariance")
    }
    state = jax.tree.map(
        lambda leaf: leaf.astype(np.float32) if leaf.dtype == np.float64 else leaf,
        values["state"],
    )
    for _ in range(3):
        state, history = filtering.run_filter(**{**values, **single, "state": state})
    assert history.healthy.all() and state.clone_covariance.dtype == np.float32


def test_a_network_that_is_no_function_of_windows_is_refused():
    """A module without its variables, and what `networks.load` gives, cannot be called."""
    model = models.create("tlio", width=2)
    bound = model.bind(models.initialise(model, jax.random.key(0), N * CLONES))
    ekf, rows = filtering.Filter(CONFIG, NOISE), (start(), GYRO[:N], ACCEL[:N])
    jax.eval_shape(lambda: filtering.run_odometry(bound, ekf, *rows))
    for predict in (None, model, models.Network.of(model, bound.variables)):
        with (
            unchecked(),
            pytest.raises(ValueError, match=r"^predict: must be a function .*Network\.of\("),
        ):
            filtering.run_odometry(predict, ekf, *rows)
        with unchecked(), pytest.raises(ValueError, match=r"^predict: must be a function"):
            filtering.Tracker(predict, ekf)
    prediction = types.Prediction(jnp.zeros((1, 3)), None)
    with unchecked(), pytest.raises(ValueError, match=r"^predict: log_std must .* found NoneType"):
        filtering.run_odometry(lambda _: prediction, ekf, *rows)
    reference = np.tile(np.eye(3), (4, 1, 1)), np.zeros((4, 3))
    rotation, position = (part.tolist() for part in reference)
    listed = filtering.displacements(rotation, position, CONFIG)
    assert listed.shape == (3, 3)
    for rotation, position in (
        (reference[0][:3], reference[1]),
        (np.zeros((4, 4)), reference[1]),
        (reference[0], np.zeros((4, 2))),
    ):
        with unchecked(), pytest.raises(ValueError, match=r"^rotation and position: must be \(K"):
            filtering.displacements(rotation, position, CONFIG)
    with unchecked(), pytest.raises(ValueError, match=r"^considered: must be a ConsideredStd"):
        filtering.considered_covariance(np.zeros((4, 15, 6)), 0.1)
    with unchecked(), pytest.raises(ValueError, match=r"^state: must be a FilterState"):
        filtering.Tracker(lambda _: prediction, ekf, "level")


def test_a_measurement_whose_types_are_known_to_a_type_checker_alone_is_taken():
    class Height(NamedTuple):
        std: "Number"
        name = "height"

        def update(self, state, step): ...

    check_filter(filtering.Filter(CONFIG, measurements=(Height(1.0),)))
