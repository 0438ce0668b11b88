"""Values that cannot be: refused by name at the door, and reported inside `jit`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal

from gnio_jax import filtering
from gnio_jax.filtering.state import with_correlated_error
from tests.support import scekf_numpy
from tests.support.short_walk import CLONES, CONFIG, DT, INTERVALS, NOISE, WALK, N, run, start


def spoilt(name):
    _, gyro, accel, d, c = WALK
    given = dict(
        state=start(),
        gyro=gyro.copy(),
        accel=accel.copy(),
        displacement=d,
        covariance=c.copy(),
        config=CONFIG,
        noise=NOISE,
    )
    if name == "gyro":
        given["gyro"][7, 1] = np.nan
    elif name == "accel":
        given["accel"][9] = np.inf
    elif name == "covariance":
        given["covariance"][10] = -np.eye(3)
    elif name == "covariance skew":
        given["covariance"][10, 0, 1] += 1.0
    elif name == "imu_valid":
        given["imu_valid"] = np.ones(len(gyro), int)
    elif name == "imu_valid length":
        given["imu_valid"] = np.ones(3, bool)
    elif name == "state.core_covariance":
        given["state"] = start()._replace(core_covariance=start().core_covariance - jnp.eye(21))
    elif name == "state.rotation":
        given["state"] = start()._replace(rotation=2 * jnp.eye(3))
    elif name == "state.correlated":
        given["noise"] = NOISE._replace(correlation=filtering.CorrelatedError())
        state = with_correlated_error(start())
        given["state"] = state._replace(correlated=state.correlated.at[1].set(jnp.nan))
    elif name.startswith("state."):
        field = name.removeprefix("state.")
        value = getattr(start(), field)
        given["state"] = start()._replace(**{field: value.at[..., -1].set(jnp.nan)})
    elif name == "noise.accel_density":
        given["noise"] = NOISE._replace(accel_density=-1.0)
    elif name == "noise.gyro_bias_walk":
        given["noise"] = NOISE._replace(gyro_bias_walk=np.nan)
    return given


@pytest.mark.parametrize(
    "name",
    [
        "gyro",
        "accel",
        "covariance",
        "covariance skew",
        "imu_valid",
        "imu_valid length",
        "state.core_covariance",
        "state.rotation",
        "state.velocity",
        "state.offset",
        "state.gyro_bias",
        "state.accel_bias",
        "state.anchor",
        "state.move",
        "state.correlated",
        "state.clone_rotation",
        "state.clone_offset",
        "state.cross_covariance",
        "state.clone_covariance",
        "noise.accel_density",
        "noise.gyro_bias_walk",
    ],
)
def test_impossible_values_are_refused_by_name(name):
    with pytest.raises(ValueError, match=f"^{name.split(' skew')[0].split(' length')[0]}"):
        filtering.run_filter(**spoilt(name))


@pytest.mark.parametrize(
    "field,value",
    [
        ("velocity", np.nan),
        ("position", np.inf),
        ("gyro_bias", np.nan),
        ("rotation", 2 * np.eye(3)),
        ("std.tilt", -1.0),
        ("std.yaw", np.nan),
    ],
)
def test_an_impossible_start_is_refused_by_name(field, value):
    given = dict(
        rotation=np.eye(3), velocity=np.zeros(3), position=np.zeros(3), gyro_bias=np.zeros(3)
    )
    if field.startswith("std."):
        given["std"] = filtering.InitialStd(**{field[4:]: value})
    else:
        given[field] = given[field] + value if field != "rotation" else value
    with pytest.raises(ValueError, match=f"^{field}:"):
        filtering.initial_state(CONFIG, **given)


@pytest.mark.parametrize("name", ["gyro", "covariance"])
def test_inside_jit_the_history_says_so(name):
    given = spoilt(name)
    config, rest = given.pop("config"), given
    _, history = jax.jit(lambda given: filtering.run_filter(config=config, **given))(rest)
    healthy = np.asarray(history.healthy)
    bad = 1 if name == "gyro" else 10
    assert (healthy[:bad] == 1).all() and (healthy[bad:] == 0).all()


def test_log_likelihood_is_that_of_the_innovation():
    (R, v, p), gyro, accel, d, c = WALK
    _, history = run()
    noise = filtering.NoiseModel()
    wanted = scekf_numpy.run(
        gyro,
        accel,
        d,
        c,
        R,
        v,
        p,
        dt=DT,
        n=N,
        clones=CLONES,
        sigma_gyro=noise.gyro_density / np.sqrt(DT),
        sigma_accel=noise.accel_density / np.sqrt(DT),
        scale=2.0,
    )
    found = np.asarray(history.log_likelihood)
    assert np.isnan(found[:CLONES]).all()
    for k in range(CLONES, INTERVALS):
        expected = multivariate_normal.logpdf(
            wanted["innovation"][k], cov=wanted["innovation_covariance"][k]
        )
        np.testing.assert_allclose(found[k], expected, rtol=1e-7)
