"""`gnio evaluate`, `gnio score`: trajectories and errors, of a trained network or of any
program."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from gnio_jax.commands import console, options
from gnio_jax.commands.names import check_names
from gnio_jax.config import EvaluateConfig
from gnio_jax.config.schema import UNNAMED
from gnio_jax.cores import usable_cores


@dataclass(frozen=True)
class ScoreOptions:
    reference: Annotated[Path, UNNAMED]
    """File in TUM format: t x y z qx qy qz qw."""
    estimate: Annotated[Path, UNNAMED]
    """The same for the estimate, with stamps of the same clock."""
    alignment: Literal["origin", "none", "yaw_position", "se3"] = "origin"
    """Alignment before the errors are computed (docs/tables.md)."""


def evaluate(request: EvaluateConfig, call: options.Call) -> None:
    """Estimate the trajectories of a split with a trained network and report the errors.

    Results go to NETWORK/eval/<dataset>_<split>_<estimator>/, or to evaluations/NAME/... for a
    published network: metrics.json, metrics.csv,
    trajectories/ and references/ in TUM format (for evo), plots/, and report.html, a page with map,
    curves and a time slider. If that folder has figures of another --data-root, they are kept, and
    the name of the new folder ends with that of the data folder. Every table has two rows to
    compare with: never_moves, which stays at the start pose, and perfect_displacements, the same
    estimator with the reference's displacements. A walk that has waypoints and no poses is compared
    with its waypoints. A run that has learnt from several datasets is evaluated on one of them,
    which --dataset names.

    examples:
      {prog}                       the newest run below runs/
      {prog} --network runs/tlio --dataset oxiod --data-root ~/oxiod --split unseen
      {prog} --network pedestrian --dataset oxiod --split unseen
      {prog} --network runs/tlio --estimator integrate --orientation device
      {prog} --network runs/tlio --set filter.noise.measurement_scale=1
    """
    check_names(datasets=[request.dataset] if request.dataset else [])
    from gnio_jax import evaluation  # late: mistakes do not wait for JAX
    from gnio_jax.apps import rerun
    from gnio_jax.evaluation import tabulate

    if request.rerun:
        rerun.check(request.rerun)
    console.prepare_filter()
    with console.terminal() as terminal:
        result = evaluation.evaluate(request, terminal, usable_cores(), str(call))
    console.say(tabulate.render(result.report))
    console.say(f"results: {result.folder}")
    if request.rerun:
        rerun.write(Path(request.rerun), result.estimates, result.recordings, request.alignment)
        console.say(f"for Rerun: {request.rerun}")
    if request.plots:
        console.say(f"page: {result.folder / 'report.html'} (open it in a browser)")
        pictures = result.folder / "plots" / "error_cdf.png"
        console.say(f"pictures: {pictures}, and there <name>.png of each sequence")
    if line := tabulate.gaps(result.report):
        console.say(f"warning: {line} (the reasons are below the table)")


def score(request: ScoreOptions, _call: options.Call) -> None:
    """Print errors of any trajectory against a reference, as gnio evaluate does.

    Each pose of the reference is compared with the nearest one of the estimate, if their stamps
    differ by at most 0.01 s.

    examples:
      {prog} truth.txt odometry.txt
      {prog} truth.txt odometry.txt --alignment se3      aligned as evo does
    """
    from gnio_jax import evaluation  # late: mistakes do not wait for JAX
    from gnio_jax.evaluation import tabulate

    report = evaluation.score_files(request.reference, request.estimate, request.alignment)
    console.say(tabulate.render(report))
