"""A package of a run, for those who do not have its data."""

from __future__ import annotations

import dataclasses
import json
from importlib.metadata import version
from pathlib import Path

from gnio_jax import config as configuration
from gnio_jax.errors import InputError
from gnio_jax.files import file_stem
from gnio_jax.pretrained import arrays, card, figures, package
from gnio_jax.pretrained.arrays import Storage
from gnio_jax.pretrained.card import Description, Origin
from gnio_jax.pretrained.package import About
from gnio_jax.training.checkpoint import Run, Which, load_run


def publish(
    workdir: Path,
    out: Path,
    said: Description,
    storage: Storage = "float32",
    which: Which = "best",
) -> About:
    """Make a package of a run at `out`: a zip if its name ends so, else a folder.

    It is written whole or not at all. Folders of this machine are left out of its config.yaml.
    Raises `InputError` for a run that cannot be loaded, a name that is none of a file, empty texts,
    or something at `out` that is no package.
    """
    _check(said)
    run = load_run(workdir, which)
    content = arrays.to_bytes(run.variables, storage)
    stored = arrays.from_bytes(content, run.variables, workdir)
    loss = arrays.StorageLoss(0.0, 0.0)
    if storage != "float32":
        loss = arrays.storage_loss(run.model, run.variables, stored, run.config.data.seen)
    evaluations = figures.read(workdir)
    about = _about(said, run, storage, figures.key_metric(evaluations, run.config.dataset))
    begun = run.config.init_from
    calibrated = (workdir / "calibration.json").is_file()
    origin = Origin(calibrated, Path(begun).name if begun else "", loss)
    config = dataclasses.replace(run.config, workdir=None, data_root=None, init_from=None)
    files = {
        package.WEIGHTS: content,
        package.CONFIG: configuration.text(config).encode(),
        package.CARD: card.text(said, about, config, origin, evaluations).encode(),
        package.FIGURES: (json.dumps(evaluations, indent=1, ensure_ascii=False) + "\n").encode(),
    }
    package.write(out, about, files)
    return package.about(out)


def _check(said: Description) -> None:
    if said.name != file_stem(said.name):
        problem = f"'{said.name}' is no name of a folder"
        raise InputError("--name", problem, "use letters, digits, '.', '_', '+' and '-'")
    for option in ("data", "license"):
        if not getattr(said, option).strip():
            raise InputError(f"--{option}", "is empty", "say it in a sentence: others rely on it")


def _about(said: Description, run: Run, storage: str, metric: package.Metric | None) -> About:
    return About(
        name=said.name,
        network=run.config.model.name,
        data=said.data,
        license=said.license,
        storage=storage,
        epoch=run.epoch,
        step=run.step,
        metric=metric,
        made_by=f"gnio-jax {version('gnio-jax')}",
    )
