"""The benchmarks find what they measure: their own figures are taken by hand."""

import numpy as np

from benchmarks import train_step


def test_the_training_step_has_windows_to_learn_from():
    source = train_step.recordings(20, 4)
    rows = np.asarray(source.start)[:, None] + np.arange(20)
    assert rows.max() < len(source.imu) and len(source.visited) == len(source.start)
    first, last = np.asarray(source.stretch).T
    assert (first <= rows[:, 0]).all() and (rows[:, -1] <= last).all()
