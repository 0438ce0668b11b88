"""`gnio evaluate`: trajectories and errors of a trained network."""

from __future__ import annotations

from pathlib import Path

from gnio_jax.commands import console, options
from gnio_jax.config import EvaluateConfig
from gnio_jax.cores import usable_cores


def evaluate(asked: EvaluateConfig, call: options.Call) -> None:
    """Estimate the trajectories of a split with a trained network and report the errors.

    Results go to WORKDIR/eval/<dataset>_<split>_<estimator>/: metrics.json, metrics.csv,
    trajectories/ and references/ in TUM format (for evo), plots/, and report.html, a page with map,
    curves and a time slider. Every table has two rows to compare with: never_moves, the start pose
    throughout, and perfect_displacements, the same estimator fed with the reference's
    displacements.

    examples:
      {prog}                       the newest run below runs/
      {prog} --workdir runs/tlio --dataset oxiod --data-root ~/oxiod --split unseen
      {prog} --workdir runs/tlio --estimator integrate --orientation device
      {prog} --workdir runs/tlio --set filter.noise.measurement_scale=1
    """
    import jax  # late: mistakes do not wait for it

    from gnio_jax import evaluation, filtering
    from gnio_jax.apps import rerun
    from gnio_jax.evaluation import tabulate
    from gnio_jax.evaluation.estimate import in_one_frame

    if asked.rerun:
        rerun.check(asked.rerun)
    jax.config.update("jax_enable_x64", True)  # for the filter; the network states its float32
    filtering.cores_as_devices()
    with console.terminal() as terminal:
        found = evaluation.evaluate(asked, terminal, usable_cores(), str(call))
    output = console.stdout()
    output.print(tabulate.render(found.report))
    output.print(f"results: {found.folder}", soft_wrap=True)
    if asked.rerun:
        pairs = zip(found.estimates, found.recordings, strict=True)
        logged = [
            rerun.Logged(in_one_frame(estimate, asked.alignment), recording)
            for estimate, recording in pairs
        ]
        rerun.write(Path(asked.rerun), logged)
        output.print(f"for Rerun: {asked.rerun}", soft_wrap=True)
    if asked.plots:
        output.print(f"page: {found.folder / 'report.html'} (open it in a browser)", soft_wrap=True)
        pictures = found.folder / "plots" / "error_cdf.png"
        output.print(f"pictures: {pictures}, and there <name>.png of each sequence", soft_wrap=True)
