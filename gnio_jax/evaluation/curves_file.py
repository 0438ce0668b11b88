"""What network and filter said over time, kept beside an evaluation's trajectories: a page that is
made later draws its strips from it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float

from gnio_jax.evaluation.estimators.result import Estimate

DIAGNOSTICS = ("gate", "scale")
"""Of the network; the page shows no others."""
_UPPER = np.triu_indices(3)
_ROW = {"gate": (3,), "scale": (3,), "std": (3,), "nis": (), "covariance": (6,)}
"""What a row of each curve is like."""


def write_curves(path: Path, estimate: Estimate) -> None:
    """Write an .npz, in float32, of the rows that the trajectory's file has."""
    trajectory = estimate.trajectory
    finite = np.isfinite(trajectory.position).all(1) & np.isfinite(trajectory.orientation).all(1)
    known = {name: estimate.diagnostics.get(name) for name in DIAGNOSTICS}
    known |= {"std": estimate.displacement_std, "nis": estimate.nis}
    covariance = estimate.position_covariance
    known["covariance"] = None if covariance is None else covariance[:, *_UPPER]
    arrays = {
        name: values[finite].astype(np.float32)
        for name, values in known.items()
        if values is not None
    }
    with open(path, "wb") as file:
        np.savez_compressed(file, **arrays)


def with_curves(estimate: Estimate, path: Path) -> Estimate:
    """An estimate that was read back, with the curves of `path`; as it is where an older version
    wrote none, or they are damaged."""
    rows = len(estimate.trajectory.time)
    try:
        with np.load(path, allow_pickle=False) as file:
            found = {name: file[name].astype(np.float64) for name in file.files}
    except Exception:  # a damaged file makes the parser fail in any way
        return estimate
    if any(found[name].shape != (rows, *_ROW[name]) for name in _ROW.keys() & found.keys()):
        return estimate
    return estimate._replace(
        diagnostics={name: found[name] for name in DIAGNOSTICS if name in found},
        displacement_std=found.get("std"),
        nis=found.get("nis"),
        position_covariance=_symmetric(found.get("covariance")),
    )


def _symmetric(upper: Float[np.ndarray, "k 6"] | None) -> Float[np.ndarray, "k 3 3"] | None:
    if upper is None:
        return None
    full = np.empty((len(upper), 3, 3))
    full[:, *_UPPER] = upper
    full[:, *_UPPER[::-1]] = upper
    return full
