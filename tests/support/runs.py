"""Runs of training, as many of which as can be share what is compiled."""

import contextlib
import dataclasses
import functools

import pytest

from gnio_jax.training import loop, optimizer


def shared_config(config):
    """The settings of a run without those that change nothing of what is compiled."""
    optim = dataclasses.replace(config.optim, best_by="loss")
    return dataclasses.replace(config, workdir="", data_root="", seed=0, optim=optim)


@contextlib.contextmanager
def shared_programs():
    """Runs whose settings differ in nothing that is compiled share their programs.

    Tracing and compiling is nearly all that a tiny run costs, and both are done anew for other
    static arguments: where files lie, the seed, and what makes a checkpoint the best.
    """
    set_up, created = loop.set_up, functools.cache(optimizer.create)

    def shared(config, *more):
        run = set_up(config, *more)
        same = shared_config(config)
        steps = created(same.optim, config.loss, run.steps_per_epoch)
        return run._replace(config=same, optimizer=steps)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loop, "set_up", shared)
        yield
