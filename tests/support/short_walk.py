"""A walk of sixty clone intervals, and the filter over it with parts of its input replaced."""

from gnio_jax import filtering
from tests.support.random_walk import random_walk

N, CLONES, DT, INTERVALS = 5, 4, 0.02, 60
CONFIG = filtering.FilterConfig(DT, N, CLONES, bridge_seconds=0.06, history="core")
NOISE = filtering.NoiseModel(measurement_scale=2.0)
WALK = random_walk(11, n=N, clones=CLONES, intervals=INTERVALS, dt=DT, bias=False)


def start(config=CONFIG, walk=None):
    (R, v, p), *_ = walk or WALK
    return filtering.initial_state(config, R, v, p)


def run(config=CONFIG, valid=None, gyro=None, accel=None, walk=WALK, state=None, rows=slice(None)):
    _, g, a, d, c = walk
    samples = slice(
        None if rows.start is None else rows.start * N, None if rows.stop is None else rows.stop * N
    )
    state = start(config, walk) if state is None else state
    return filtering.run_filter(
        state,
        (g if gyro is None else gyro)[samples],
        (a if accel is None else accel)[samples],
        d[rows],
        c[rows],
        config,
        NOISE,
        None if valid is None else valid[samples],
    )
