"""The run-time checks of shapes and types, where tens of thousands of calls would pay for them."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager

from jaxtyping import config


@contextmanager
def unchecked() -> Iterator[None]:
    """Nothing is checked inside: for arguments that a function refuses by itself, as a user's
    process calls it."""
    config.update("jaxtyping_disable", True)
    try:
        yield
    finally:
        config.update("jaxtyping_disable", False)


def checked_at_first(samples: Iterable, count: int = 200) -> Iterator:
    """The samples, one after the other; what is called with sample `count` and later is not
    checked.

    A check takes longer than most of the functions that are called once per sample.
    """
    try:
        for number, sample in enumerate(samples):
            if number == count:
                config.update("jaxtyping_disable", True)
            yield sample
    finally:
        config.update("jaxtyping_disable", False)
