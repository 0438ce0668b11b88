"""The terminal: exit statuses and one-line errors, no control characters, the compilers' cache."""

import io
import os
import re
import signal
import subprocess
import sys
import warnings
from pathlib import Path

import pytest
from rich.table import Table

from gnio_jax.commands import console
from gnio_jax.errors import InputError
from gnio_jax.evaluation import tabulate
from tests.support.reports import report_of

ROOT = Path(__file__).parents[2]


@pytest.fixture(autouse=True)
def handlers(monkeypatch):
    """The signals' handlers as they were, and the caches' places."""
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGHUP)}
    signal.signal(signal.SIGHUP, signal.SIG_DFL)  # the tests may run below nohup
    for name in ("JAX_COMPILATION_CACHE_DIR", "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"):
        monkeypatch.setenv(name, os.environ.get(name, "0"))
    monkeypatch.setenv("MPLBACKEND", "agg")
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def interrupted():
    raise KeyboardInterrupt


def hung_up_twice():
    """A shell and its terminal may both send it."""
    try:
        os.kill(os.getpid(), signal.SIGHUP)
    finally:
        for number in (signal.SIGHUP, signal.SIGTERM):
            os.kill(os.getpid(), number)
        print("written", file=sys.stderr)


def mistaken():
    raise InputError("file.csv", "has no column x", "add\nit")


@pytest.mark.parametrize(
    "main, status, line",
    [
        (mistaken, 2, "file.csv: has no column x; add it\n"),
        (interrupted, 130, "interrupted\n"),
        (lambda: open("/dev/null/x", "w"), 2, "/dev/null/x: Not a directory\n"),
        (lambda: os.kill(os.getpid(), signal.SIGTERM), 143, ""),
        (lambda: os.kill(os.getpid(), signal.SIGHUP), 129, ""),
        (hung_up_twice, 129, "written\n"),
        (lambda: warnings.warn("two\nlines", stacklevel=1), None, "warning: two lines\n"),
    ],
)
def test_run_ends_in_one_line_and_a_status(main, status, line, capsys):
    with pytest.raises(ZeroDivisionError):  # faults of the program keep their traceback
        console.run(lambda: 1 / 0)
    if status is None:
        console.run(main)
    else:
        with pytest.raises(SystemExit) as end:
            console.run(main)
        assert end.value.code == status
    assert capsys.readouterr() == ("", line)


def test_nohup_keeps_a_command_alive():
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    console.run(lambda: os.kill(os.getpid(), signal.SIGHUP))


def test_variables_of_jax_and_matplotlib_do_not_end_in_a_traceback(monkeypatch, capsys):
    """A platform that is not here, the backend of a notebook, and the search for NaN."""

    def traced():
        raise FloatingPointError("invalid value (nan) encountered in stage")

    with pytest.raises(FloatingPointError):
        console.run(traced)
    monkeypatch.setenv("JAX_DEBUG_NANS", "1")
    with pytest.raises(SystemExit) as end:
        console.run(traced)
    assert end.value.code == 2 and "JAX_DEBUG_NANS: gnio marks missing" in capsys.readouterr().err
    environment = os.environ | {"JAX_PLATFORMS": "cuda"}
    commands = "from gnio_jax.commands.app import main; import sys; main(sys.argv[1:])"
    for words, status in ((["doctor"], 0), (["track", "examples/walk.csv", "--out", "no"], 2)):
        line = [sys.executable, "-c", commands, *words]
        result = subprocess.run(line, cwd=ROOT, env=environment, capture_output=True, text=True)
        output = result.stdout + result.stderr
        assert result.returncode == status, output
        assert "JAX has no device of the platform 'cuda' here; unset it" in output
        assert "Traceback" not in output
    monkeypatch.setenv("MPLBACKEND", "module://a_notebook.backend")
    console.run(lambda: None)
    assert os.environ["MPLBACKEND"] == "agg"


def test_names_of_files_are_no_controls_of_the_terminal(capsys):
    """A name may colour the terminal, retitle it or delete what it showed."""
    name = "walk\x1b]0;mine\x07\x1b[2J\x9b31m\u202e.zip"

    def main():
        console.stdout().print(f"{name}: read", soft_wrap=True)
        grid = Table()
        grid.add_column(name, overflow="fold")
        console.stdout().print(grid)
        console.say(tabulate.render(report_of({name: 1.0}, {name: "x"})))
        with console.terminal() as terminal:
            terminal.line(name)
        warnings.warn(name, stacklevel=1)
        raise InputError(name, "no such file")

    with pytest.raises(SystemExit, match="2"):
        console.run(main)
    out, err = capsys.readouterr()
    assert not set(out + err) & set("\x1b\x07\x9b\u202e")
    assert r"walk\x1b]0;mine\x07\x1b[2J\x9b31m\u202e.zip: read" in out
    assert err.count(r"walk\x1b]0;mine") == 3


@pytest.mark.parametrize("closed, status", [(">&-", 0), ("2>&-", 0), (">&- 2>&-", 0), ("<&-", 0)])
def test_a_stream_that_is_closed_is_no_fault(closed, status):
    command = f"{sys.executable} -m gnio_jax weights {closed}"
    result = subprocess.run(command, shell=True, cwd=ROOT, capture_output=True, text=True)
    assert (result.returncode, result.stderr) == (status, "")


@pytest.mark.parametrize("unbuffered", ["", "1"])
@pytest.mark.parametrize(
    "words",
    ["--version", "--completion", "--help", "weights --help", "weights", "data list", "doctor"],
)
def test_a_reader_who_has_left_ends_a_command_without_a_word(words, unbuffered):
    """As `gnio ... | head` does, but certainly before the first line."""
    environment = os.environ | {"PYTHONUNBUFFERED": unbuffered}
    command = [sys.executable, "-m", "gnio_jax", *words.split()]
    reading, writing = os.pipe()
    os.close(reading)
    try:
        result = subprocess.run(
            command, cwd=ROOT, env=environment, stdout=writing, stderr=subprocess.PIPE, text=True
        )
    finally:
        os.close(writing)
    assert result.stderr == "" and result.returncode in ((0, 141) if "help" in words else (141,))


def test_a_reader_of_errors_who_has_left_makes_no_traceback():
    """`gnio ... 2>&1 | head`."""
    command = f"{sys.executable} -m gnio_jax train --wrong 2>&1 | true; exit ${{PIPESTATUS[0]}}"
    result = subprocess.run(["bash", "-c", command], cwd=ROOT, capture_output=True, text=True)
    assert result.returncode in (2, 141) and result.stdout + result.stderr == ""


def test_a_full_disk_is_no_reader_who_has_left():
    command = f"{sys.executable} -m gnio_jax weights > /dev/full"
    result = subprocess.run(command, shell=True, cwd=ROOT, capture_output=True, text=True)
    assert result.returncode == 2 and result.stderr == "output: No space left on device\n"


def test_the_status_remains_where_errors_cannot_be_written():
    command = f"{sys.executable} -m gnio_jax train --wrong 2> /dev/full"
    result = subprocess.run(command, shell=True, cwd=ROOT, capture_output=True, text=True)
    assert result.returncode == 2 and result.stdout == ""


def test_the_line_of_progress_shows_its_times_in_80_columns(monkeypatch):
    screen = io.StringIO()
    options = {"file": screen, "force_terminal": True, "width": 80, "stderr": False}
    plain = console._Plain
    monkeypatch.setattr(console, "_Plain", lambda **_: plain(**options))
    numbers = "38/57  epoch 2  loss 65.09  lr 7.34e-04  5,744 windows/s"
    with console.terminal() as terminal:
        terminal.progress("training", 0.67, numbers)
        terminal._bars.refresh()
    line = re.findall(
        r"training[^\r\n]*", re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", screen.getvalue())
    )[-1]
    assert re.search(r"67% 0:00:\d\d (0:\d\d:\d\d|-:--:--) 38/57  epoch 2  loss", line)
    assert len(line) <= 80


def test_lines_of_a_table_in_a_pipe_have_no_blanks_at_their_ends(capsys):
    console.say(console.pairs([("name", "short"), ("other", "a longer value")]))
    lines = capsys.readouterr().out.splitlines()
    assert lines == ["name   short", "other  a longer value"]


def test_another_copy_of_the_package_in_the_working_folder_is_told(tmp_path, monkeypatch, capsys):
    """What is changed there would have no effect on `gnio`."""
    monkeypatch.chdir(tmp_path)
    console.warn_of_other_sources()
    (tmp_path / "gnio_jax").mkdir()
    (tmp_path / "gnio_jax" / "__init__.py").write_text("")
    assert capsys.readouterr().err == ""
    console.run(lambda: None)
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("warning: ") and "pip install -e ." in line


def test_compiled_programs_are_kept(tmp_path, monkeypatch):
    """In the user's cache, or where the user says, and nowhere if that cannot be written: a file in
    its place, a folder into which nobody may write."""
    (tmp_path / "file" / "gnio-jax").mkdir(parents=True)
    (tmp_path / "file" / "gnio-jax" / "compiled").write_text("")
    below = Path("gnio-jax") / "compiled"
    for variables, expected in (
        ({"HOME": str(tmp_path / "home")}, tmp_path / "home" / ".cache" / below),
        ({"XDG_CACHE_HOME": str(tmp_path), "JAX_COMPILATION_CACHE_DIR": "own"}, "own"),
        ({"XDG_CACHE_HOME": str(tmp_path / "file")}, None),
        ({"XDG_CACHE_HOME": "/proc"}, None),
    ):
        with monkeypatch.context() as patch:
            for name in ("XDG_CACHE_HOME", "JAX_COMPILATION_CACHE_DIR"):
                patch.setenv(name, "")
                patch.delenv(name)
            for name, value in variables.items():
                patch.setenv(name, value)
            console.keep_compiled_programs()
            cache_folder = os.environ.get("JAX_COMPILATION_CACHE_DIR")
        assert cache_folder == (None if expected is None else str(expected)), variables
    program = (
        "from gnio_jax.commands import console\n"
        "def main():\n    import jax\n"
        "    jax.config.update('jax_persistent_cache_min_compile_time_secs', 0)\n"
        "    print(jax.config.jax_compilation_cache_dir, jax.jit(lambda x: x + 1)(1.0))\n"
        "console.run(main)\n"
    )
    other_variables = {name: value for name, value in os.environ.items() if "CACHE" not in name}
    options = {"capture_output": True, "text": True, "timeout": 60}
    environment = {**other_variables, "XDG_CACHE_HOME": str(tmp_path)}
    shown = subprocess.run([sys.executable, "-c", program], env=environment, **options)
    assert shown.stdout == f"{tmp_path / below} 2.0\n" and shown.stderr == ""
    assert any((tmp_path / below).iterdir())
