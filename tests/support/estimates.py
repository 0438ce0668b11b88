"""Made-up estimates and reports about them."""

import numpy as np
from scipy.spatial.transform import Rotation

from gnio_jax.evaluation import (
    Displacements,
    Filtered,
    Report,
    SequenceEstimate,
    States,
    Trajectory,
    never_moves,
    score,
)
from tests.support import reports

SETTINGS = reports.SETTINGS | {
    "dataset": "made",
    "recordings": dict.fromkeys(("room 1/walk", "room 1:walk", "blind", "room 3"), 40.0),
}


def reported(estimates, groups=None, notes=None, left_out=None, settings=SETTINGS):
    """The report about estimates, each a group of its own."""
    groups = groups or {estimate.name: estimate.name for estimate in estimates}
    still = {"never_moves": score(never_moves(estimates))}
    return Report(settings, score(estimates), still, groups, notes or {}, left_out or {})


def with_covariance(estimate, covariance):
    return estimate._replace(filtered=estimate.filtered._replace(covariance=covariance))


def estimate(name, seed, n=400, truth=True):
    random = np.random.default_rng(seed)
    angle = np.arange(n) * 0.02
    angle[150:220] = angle[150]
    angle[220:] -= angle[220] - angle[150]
    position = np.stack([8 * np.cos(angle), 8 * np.sin(angle), 0.1 * angle], 1)
    orientation = Rotation.from_euler("z", angle[:, None]).as_quat(scalar_first=True)
    time = 1.5e9 + np.arange(n) * 0.1
    reference = Trajectory(time, position if truth else position * np.nan, orientation)
    moved = position + np.cumsum(random.normal(0, 0.03, (n, 3)), 0)
    displacement = np.full((n, 3), np.nan)
    displacement[11:] = np.array([1.6, 0, 0]) + random.normal(0, 0.1, (n - 11, 3))
    covariance = np.tile(0.3**2 * np.eye(3), (n, 1, 1))
    spread = 0.03 * np.sqrt(np.arange(n) + 1)
    accepted = np.where(np.arange(n) < 11, np.nan, (np.arange(n) % 10 > 0).astype(float))
    return SequenceEstimate(
        name,
        Trajectory(time, moved, orientation),
        reference,
        Displacements(displacement, covariance, {"gate": np.tanh(displacement)}),
        Filtered(
            spread[:, None, None] ** 2 * np.eye(3),
            np.where(np.isnan(accepted), np.nan, 3.0),
            accepted,
        ),
        States(*random.normal(size=(3, n, 3)), np.repeat(spread[:, None], 15, 1), moved),
    )
