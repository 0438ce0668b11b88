"""A package as a run, which all commands take."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from gnio_jax import config as configuration
from gnio_jax.errors import InputError
from gnio_jax.files import replacing_folder
from gnio_jax.pretrained.loading import load_pretrained
from gnio_jax.training import checkpoint


def write_run(which: str | Path, workdir: Path) -> None:
    """Make a run of a package: its settings and its weights as the best checkpoint. The folder is
    written whole or not at all. Raises `InputError` as `load_pretrained` does, and for a folder
    that is there already."""
    if workdir.exists():
        raise InputError(workdir, "is there already", "name another folder")
    run = load_pretrained(which)
    config = dataclasses.replace(run.config, workdir=str(workdir))
    with replacing_folder(workdir) as new:
        configuration.save(new / "config.yaml", config)
        checkpoint.write_best(new, run._replace(config=config))
