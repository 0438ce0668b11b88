"""Runs of training, as many of which as can be share what is compiled."""

import contextlib
import functools

import pytest

from gnio_jax.training import loop, optimizer


@contextlib.contextmanager
def shared_programs():
    """Runs whose settings differ in nothing that is compiled share their programs.

    Tracing and compiling is nearly all that a tiny run costs, and both are done anew for another
    optimizer, which is equal to none but itself.
    """
    set_up, created = loop.set_up, functools.cache(optimizer.create)

    def shared(config, *more):
        run = set_up(config, *more)
        return run._replace(optimizer=created(config.optim, config.loss, run.steps_per_epoch))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loop, "set_up", shared)
        yield
