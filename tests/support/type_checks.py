"""The run-time type checker, made for a function when that function is called first.

Beartype writes a checker for every function of the package as it is imported, and a worker calls
few of them.
"""

import functools

from beartype import beartype


def when_called(function):
    """`beartype.beartype(function)`, made at the first call."""

    @functools.cache
    def checked():
        return beartype(function)

    @functools.wraps(function)
    def call(*args, **options):
        return checked()(*args, **options)

    return call
