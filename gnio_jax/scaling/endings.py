"""The end of a process that has lost the others: one line in the place of a stack trace.

JAX's runtime notices that another process has ended by its missing heartbeats, and then aborts its
own process from a thread of its own, with pages of text. No exception reaches Python. So the abort
is handled here: it prints one line and leaves. What the runtime itself writes goes into a file that
this line names; it is removed when the process ends in peace.
"""

from __future__ import annotations

import atexit
import ctypes
import os
import signal
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple, NoReturn, TextIO


class LastWords(NamedTuple):
    """What to say when the runtime aborts the process."""

    line: str
    status: int


_HANDLER = ctypes.CFUNCTYPE(None, ctypes.c_int)
_words: LastWords | None = None
_log: Path | None = None


def speak_for_the_runtime(line: str, status: int) -> None:
    """From now on an abort of the runtime prints `line` and leaves with `status`."""
    global _words
    if _words is None:
        _redirect()
        ctypes.CDLL(None).signal(signal.SIGABRT, _on_abort)
    _words = LastWords(line, status)


def leave_in_silence(status: int) -> None:
    """From now on an abort leaves with `status`: this process has failed, and has said why."""
    global _words
    if _words is not None:
        _words = LastWords("", status)


@_HANDLER
def _on_abort(_signum: int) -> None:
    leave()


def leave() -> NoReturn:
    """Say what an abort would say, and leave at once, without waiting for the other processes."""
    line, status = _words or LastWords("aborted", 1)
    if line:
        sys.stderr.write(f"{line} (what the runtime says: {_log})\n")
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)


def _redirect() -> None:
    """Python's own streams keep the terminal; file descriptors 1 and 2, where the runtime writes,
    become the log."""
    global _log
    sys.stdout.flush()
    sys.stderr.flush()
    sys.stdout, sys.stderr = _kept(1), _kept(2)
    handle, name = tempfile.mkstemp(prefix=f"gnio_runtime_{os.getpid()}_", suffix=".log")
    os.dup2(handle, 1)
    os.dup2(handle, 2)
    _log = Path(name)
    atexit.register(_log.unlink, missing_ok=True)


def _kept(descriptor: int) -> TextIO:
    """A stream to where `descriptor` leads now."""
    return os.fdopen(os.dup(descriptor), "w", buffering=1, errors="backslashreplace")
