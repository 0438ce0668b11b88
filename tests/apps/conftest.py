"""`gnio` as a person types it."""

import io
import sys

import pytest

from gnio_jax.commands import app, console


@pytest.fixture
def gnio(monkeypatch, capsys):
    """What `gnio` prints, with these lines on its standard input."""
    monkeypatch.setattr("gnio_jax.drawing.DOTS_PER_INCH", 30)

    def call(*words, lines=()):
        content = "\n".join(lines).encode("utf-8", "surrogateescape")
        monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(content)))
        monkeypatch.setattr(sys, "argv", ["gnio", *map(str, words)])
        console.run(app.main)
        output = capsys.readouterr()
        assert "\x1b" not in output.out + output.err  # no terminal: no control characters
        return output.out

    return call


@pytest.fixture
def mistake(gnio, capsys):
    """The one line with which `gnio` ends, and a status of 2."""

    def call(*words, lines=()):
        with pytest.raises(SystemExit, match="2"):
            gnio(*words, lines=lines)
        output = capsys.readouterr()
        assert output.err.count("\n") == 1, output.err
        return output.err

    return call


@pytest.fixture
def undrawn(monkeypatch):
    """Tracks without picture and page, which take a second."""
    monkeypatch.setattr("gnio_jax.apps.track._draw", lambda *_: None)
