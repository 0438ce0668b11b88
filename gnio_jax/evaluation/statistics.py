"""The interval of a mean over sequences, of which those of one person or session are not
independent."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.special import stdtrit


def interval(
    values: Float[np.ndarray, "n"], groups: Iterable[Any], level: float = 0.95
) -> tuple[float, float] | None:
    """The interval that holds the mean of the population with probability `level`.

    `groups` holds the group (person, session) of each value. Groups are taken to be drawn at
    random, so the standard error is the cluster-robust one,

        s = sqrt(G / (G − 1) Σ_g (Σ_{i in g} (x_i − x̄))²) / n

    for G groups and n values (Liang and Zeger 1986), and the quantile is Student's t with G − 1
    degrees of freedom. For groups of like sizes it covers the mean as often as it says, also where
    groups are few: a percentile bootstrap over 2, 3, 6 and 10 groups misses it in 50, 25, 15 and
    10 % of the cases. None for fewer than two groups, and where a value or the interval is not
    finite.
    """
    members, group = np.unique([str(name) for name in groups], return_inverse=True)
    count = len(members)
    if count < 2 or not np.isfinite(values).all():
        return None
    with np.errstate(over="ignore", invalid="ignore"):
        mean = float(values.mean())
        sums = np.bincount(group, values - mean)
        error = math.sqrt(count / (count - 1)) * float(np.linalg.norm(sums)) / len(values)
    reach = float(stdtrit(count - 1, 0.5 + level / 2)) * error
    found = mean - reach, mean + reach
    return found if all(map(math.isfinite, found)) else None
