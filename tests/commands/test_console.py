"""The terminal: exit statuses and one-line errors, no control characters, the compilers' cache."""

import os
import subprocess
import sys
import warnings
from pathlib import Path

import pytest
from rich.table import Table

import gnio_jax
from gnio_jax.commands import console
from gnio_jax.errors import InputError


def outcome(body, **options):
    program = (
        "from gnio_jax.commands import console\nfrom gnio_jax.errors import InputError\n"
        f"def main():\n    {body}\nconsole.run(main)\n"
    )
    return subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=60, **options
    )


@pytest.mark.parametrize(
    "body, status, line",
    [
        (
            "raise InputError('file.csv', 'has no column x', 'add\\nit')",
            2,
            "file.csv: has no column x; add it\n",
        ),
        ("raise KeyboardInterrupt", 130, "interrupted\n"),
        ("open('/dev/null/x', 'w')", 2, "/dev/null/x: Not a directory\n"),
        ("import os; os.kill(os.getpid(), 15)", 143, ""),
        ("import warnings; warnings.warn('two\\nlines')", 0, "warning: two lines\n"),
        ("print('fine')", 0, ""),
    ],
)
def test_run_ends_in_one_line_and_a_status(body, status, line):
    result = outcome(body)
    assert (result.returncode, result.stderr) == (status, line)


def test_faults_of_the_program_keep_their_traceback():
    result = outcome("1 / 0")
    assert result.returncode == 1 and "Traceback" in result.stderr


def test_names_of_files_are_no_controls_of_the_terminal(capsys):
    """A name may colour the terminal, retitle it or delete what it showed."""
    name = "walk\x1b]0;mine\x07\x1b[2J\x9b31m\u202e.zip"

    def told():
        console.stdout().print(f"{name}: read", soft_wrap=True)
        grid = Table()
        grid.add_column(name, overflow="fold")
        console.stdout().print(grid)
        with console.terminal() as terminal:
            terminal.line(name)
        warnings.warn(name, stacklevel=1)
        raise InputError(name, "no such file")

    with pytest.raises(SystemExit, match="2"):
        console.run(told)
    out, err = capsys.readouterr()
    assert not set(out + err) & set("\x1b\x07\x9b\u202e")
    assert r"walk\x1b]0;mine\x07\x1b[2J\x9b31m\u202e.zip: read" in out
    assert err.count(r"walk\x1b]0;mine") == 3


def test_another_copy_of_the_package_in_the_working_folder_is_told(tmp_path):
    """What is changed there would have no effect on `gnio`."""
    environment = {**os.environ, "PYTHONPATH": str(Path(gnio_jax.__file__).parents[1])}
    (tmp_path / "gnio_jax").mkdir()
    # `gnio` is a script in another folder; a program that is given by -c looks here first.
    body = "print('ran')"
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin" / "gnio.py").write_text(
        f"from gnio_jax.commands import console\nconsole.run(lambda: {body})\n"
    )
    command = [sys.executable, str(tmp_path / "bin" / "gnio.py")]

    def run():
        return subprocess.run(
            command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=60
        )

    assert (run().stderr, run().stdout) == ("", "ran\n")
    (tmp_path / "gnio_jax" / "__init__.py").write_text("")
    shown = run()
    (line,) = shown.stderr.splitlines()
    assert line.startswith("warning: ") and "pip install -e ." in line
    assert (shown.returncode, shown.stdout) == (0, "ran\n")


def test_what_is_compiled_is_kept(tmp_path):
    body = "import jax; jax.config.update('jax_persistent_cache_min_compile_time_secs', 0); "
    body += "print(jax.config.jax_compilation_cache_dir, jax.jit(lambda x: x + 1)(1.0))"
    kept = {name: value for name, value in os.environ.items() if "CACHE" not in name}
    shown = outcome(body, env={**kept, "XDG_CACHE_HOME": str(tmp_path)})
    place = tmp_path / "gnio-jax" / "compiled"
    assert shown.stdout == f"{place} 2.0\n" and shown.stderr == ""
    assert any(place.iterdir())


def test_where_compiled_programs_are_kept(tmp_path, monkeypatch):
    """In the user's cache, or where the user says, and nowhere if that cannot be written: a file in
    its place, a folder into which nobody may write."""
    (tmp_path / "file" / "gnio-jax").mkdir(parents=True)
    (tmp_path / "file" / "gnio-jax" / "compiled").write_text("")
    below = Path("gnio-jax") / "compiled"
    for given, place in (
        ({"XDG_CACHE_HOME": str(tmp_path)}, tmp_path / below),
        ({"HOME": str(tmp_path / "home")}, tmp_path / "home" / ".cache" / below),
        ({"XDG_CACHE_HOME": str(tmp_path), "JAX_COMPILATION_CACHE_DIR": "own"}, "own"),
        ({"XDG_CACHE_HOME": str(tmp_path / "file")}, None),
        ({"XDG_CACHE_HOME": "/proc"}, None),
    ):
        with monkeypatch.context() as patch:
            for name in ("XDG_CACHE_HOME", "JAX_COMPILATION_CACHE_DIR"):
                patch.setenv(name, "")
                patch.delenv(name)
            for name, value in given.items():
                patch.setenv(name, value)
            console.keep_compiled_programs()
            found = os.environ.get("JAX_COMPILATION_CACHE_DIR")
        assert found == (None if place is None else str(place)), given
