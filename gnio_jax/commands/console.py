"""The terminal: exit statuses and one-line errors, the console, the progress bar."""

from __future__ import annotations

import contextlib
import errno
import io
import os
import re
import signal
import sys
import typing
import warnings
from collections.abc import Callable, Iterable, Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.segment import Segment
from rich.table import Column, Table
from rich.text import Text

import gnio_jax
from gnio_jax.errors import InputError

_DISK_ERRORS = {
    *(errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOSPC, errno.EFBIG, errno.EDQUOT, errno.EIO),
    *(errno.EEXIST, errno.EISDIR, errno.ENOTDIR, errno.ENAMETOOLONG),
}
"""Errors for a place that may not be written, for a full disk, and for an impossible name."""
_READER_LEFT = 128 + signal.SIGPIPE
_COMPILE_SECONDS = "0.1"
"""Compile time, s, from which a program is kept; JAX's own default is a second."""


def run(main: Callable[[], object]) -> None:
    """Call `main()` and exit with the shell's exit statuses.

    A user's mistake (`InputError`), a full disk or a folder that may not be written is one line on
    stderr and status 2, and so is a variable of JAX that cannot be followed; Ctrl-C gives status
    130. SIGTERM ends the program like an exception, so that no incomplete file remains, and gives
    status 143. So does SIGHUP, of a terminal that is closed, with status 129, unless nohup has
    switched it off. A warning is one line on stderr. A reader of the output who has left (head,
    less) ends the program without a word, with the status of SIGPIPE, 141. Any other exception is
    an error of the program and keeps its traceback.
    """
    try:
        _end_in_a_line(main)
    except BrokenPipeError:
        _drop_unread_output()
        raise SystemExit(_READER_LEFT) from None
    except SystemExit:
        _drop_unread_output()
        raise


def _end_in_a_line(main: Callable[[], object]) -> None:
    """Call `main()` as `run` does, but for a reader who has left."""
    signal.signal(signal.SIGTERM, _terminate)
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        signal.signal(signal.SIGHUP, _terminate)
    # Pictures are files. The backend of a notebook, which its commands inherit, may be missing.
    os.environ["MPLBACKEND"] = "agg"
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:  # it was closed before the start, as by >&-
            setattr(sys, name, open(os.devnull, "w"))
    if isinstance(sys.stdout, io.TextIOWrapper):  # names of files may have any bytes
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        with warnings.catch_warnings():
            warnings.showwarning = warn
            warn_of_other_sources()
            keep_compiled_programs()
            main()
        sys.stdout.flush()
    except InputError as error:
        _leave(str(error), 2)
    except KeyboardInterrupt:
        _leave("interrupted", 128 + signal.SIGINT)
    except OSError as error:
        if error.errno not in _DISK_ERRORS:
            raise
        _leave(f"{error.filename or 'output'}: {error.strerror}", 2)
    except FloatingPointError:
        if not os.environ.get("JAX_DEBUG_NANS"):
            raise
        _leave("JAX_DEBUG_NANS: gnio marks missing values by NaN, which it refuses; unset it", 2)
    except (AssertionError, RuntimeError):
        if (problem := lacking_device()) is None:
            raise
        _leave(problem, 2)


def _drop_unread_output() -> None:
    """Let stdout and stderr go nowhere if their reader has left. What they still hold would
    otherwise end in a message, and in another status, when Python ends."""
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except BrokenPipeError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
        except OSError:  # Python itself tells of a full disk
            continue


def lacking_device() -> str | None:
    """Why JAX has no device, if JAX_PLATFORMS names a platform that is not here; None if it has
    one."""
    import jax

    try:
        jax.devices()
        return None
    except (AssertionError, RuntimeError):  # an assertion where the platform's plugin is missing
        problem = f"JAX has no device of the platform '{os.environ.get('JAX_PLATFORMS')}' here"
        remedy = "unset it to use the CPU; a GPU needs pip install -U 'jax[cuda13]'"
        return f"JAX_PLATFORMS: {problem}; {remedy}"


def warn_of_other_sources() -> None:
    """Warn if the working folder has another gnio_jax than the one that runs, because changes there
    have no effect."""
    running = Path(gnio_jax.__file__)
    if os.path.isfile("gnio_jax/__init__.py") and not running.samefile("gnio_jax/__init__.py"):
        problem = f"runs the gnio_jax of {running.parent} and not that of this folder"
        warn(f"gnio {problem}; install this folder with pip install -e .")


def keep_compiled_programs() -> None:
    """Let JAX keep compiled programs in the user's cache, unless the user has chosen a place.

    JAX reads the variables when it is imported, and child processes inherit them. If the folder
    cannot be written, every command compiles again.
    """
    base = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    folder = Path(base) / "gnio-jax" / "compiled"
    with contextlib.suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
        if os.access(folder, os.W_OK):
            os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(folder))
            os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", _COMPILE_SECONDS)


def compile_quickly() -> None:
    """Let XLA compile in half the time, for commands that run each program once: on a CPU the
    filter is as fast without the last optimisations. The user's own flags have priority.

    XLA reads the variable with the first program, and refuses unknown flags.
    """
    flags = {"--xla_backend_optimization_level": "1"}
    if version("jax").startswith("0.10."):
        flags["--xla_cpu_use_fusion_emitters"] = "false"
    user_flags = os.environ.get("XLA_FLAGS", "")
    added = [f"{name}={value}" for name, value in flags.items() if name not in user_flags]
    os.environ["XLA_FLAGS"] = " ".join([*added, user_flags]).strip()


_CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]")
"""Characters that move a terminal's cursor, or change its colour or text direction; not tab and
newline.
"""


def without_controls(text: str) -> str:
    """`text` with Python's escapes in the place of control characters, which may be in names of
    files and recordings."""
    return _CONTROL.sub(lambda match: match[0].encode("unicode_escape").decode(), text)


class _Plain(Console):
    """A console that prints text without markup and without terminal controls."""

    def __init__(self, **options: Any):
        super().__init__(highlight=False, markup=False, emoji=False, **options)

    def render_str(self, text: str, **options: Any) -> Text:
        return super().render_str(without_controls(text), **options)

    def render(self, renderable: Any, options: Any = None) -> Iterator[Segment]:
        """Its parts without the controls in texts, such as names in the cells of a table. Rich's
        own controls are parts of their own."""
        for segment in super().render(renderable, options):
            if segment.control is None:
                segment = segment._replace(text=without_controls(segment.text))
            yield segment

    def on_broken_pipe(self) -> typing.NoReturn:
        """End as a signal does, so that files are still written. Rich's own status is 1."""
        _drop_unread_output()
        raise SystemExit(_READER_LEFT)


def stdout() -> Console:
    """The console of results. Into a file or a pipe, lines are not cut to a terminal's width."""
    console = _Plain()
    return console if console.is_terminal else _Plain(width=200)


def say(result: Any) -> None:
    """Print a line of any length, or a table, on the console of results. Into a file or a pipe,
    lines of tables have no blanks at their ends."""
    console = stdout()
    if isinstance(result, str) or console.is_terminal:
        console.print(result, soft_wrap=isinstance(result, str))
        return
    with console.capture() as capture:
        console.print(result)
    for line in capture.get().splitlines():
        console.print(line.rstrip(), soft_wrap=True)


def shown_path(path: Path) -> Path:
    """A path as people write it: below the working folder without that folder's name."""
    return path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path


def columns(*names: str, **options: Any) -> Table:
    """A table with these columns, whose long words are folded."""
    table = Table(**options)
    for name in names:
        table.add_column(name, overflow="fold")
    return table


def pairs(rows: Iterable[tuple[str, str]]) -> Table:
    """A table of names and values, without lines."""
    grid = Table.grid(padding=(0, 2))
    grid.add_column(no_wrap=True)
    grid.add_column(overflow="fold")
    for row in rows:
        grid.add_row(*row)
    return grid


def prepare_filter() -> None:
    """Set up JAX for the filter of many recordings: with float64 (the network states its float32),
    and with a device for each core. Call it late, because it imports JAX."""
    import jax

    from gnio_jax import filtering

    jax.config.update("jax_enable_x64", True)
    filtering.cores_as_devices()


class Terminal:
    """A `Reporter`: lines and one progress bar on stderr; only the lines if that is a file or a
    pipe."""

    def __init__(self, bars: Any):
        self._bars = bars
        self._task = bars.add_task("starting", total=None, numbers="")
        self._stage = "starting"

    def line(self, text: str) -> None:
        self._bars.console.print(text, soft_wrap=True)

    def progress(self, stage: str, share: float, numbers: str = "") -> None:
        if stage != self._stage:
            self._bars.reset(self._task)
            self._stage = stage
        self._bars.update(
            self._task, description=stage, completed=share, total=1.0, numbers=numbers
        )


@contextlib.contextmanager
def terminal(shown: bool = True) -> Iterator[Terminal]:
    """A `Terminal` whose bar is removed at the end, or one without a bar."""
    from rich import progress  # late, because neither help nor errors need it

    console = _Plain(stderr=True)
    # The times stand before the numbers, which are cut where a terminal is narrow.
    cut = Column(ratio=1, no_wrap=True, overflow="ellipsis")
    columns = (
        progress.TextColumn("{task.description}"),
        progress.BarColumn(bar_width=10),
        progress.TaskProgressColumn(),
        progress.TimeElapsedColumn(),
        progress.TimeRemainingColumn(elapsed_when_finished=True),
        progress.TextColumn("{task.fields[numbers]}", table_column=cut),
    )
    disable = not (shown and console.is_terminal)
    settings = {"transient": True, "disable": disable, "speed_estimate_period": 120, "expand": True}
    with progress.Progress(*columns, console=console, **settings) as bars:
        yield Terminal(bars)


def _leave(line: str, status: int) -> typing.NoReturn:
    with contextlib.suppress(OSError):  # the status remains, where stderr cannot be written
        print(without_controls(" ".join(line.split())), file=sys.stderr)
    raise SystemExit(status) from None


def _terminate(number: int, _frame: object) -> typing.NoReturn:
    # A shell and its terminal may both send it, and the second must not end what the first begins.
    for signal_number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(signal_number, signal.SIG_IGN)
    raise SystemExit(128 + number)


def warn(message: Warning | str, *_: object) -> None:
    print(f"warning: {without_controls(' '.join(str(message).split()))}", file=sys.stderr)
