"""What `gnio doctor` finds in an installation that is made up."""

import json
from email.message import Message
from importlib import metadata

import jax
import numpy as np
import pytest

from gnio_jax.commands import app, options


@pytest.fixture
def home(tmp_path, monkeypatch):
    """A folder with datasets of two names, and an installation whose extras lack one package."""
    for name in ("oxiod", "tlio_layout", "thesis"):
        (tmp_path / "recordings" / name).mkdir(parents=True)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("GNIO_DATA", str(tmp_path / "recordings"))
    monkeypatch.setenv("GNIO_CACHE", str(tmp_path / "kept"))
    monkeypatch.delenv("GNIO_WEIGHTS", raising=False)
    required = [
        "numpy>=2",
        "no-such-core>=1",
        'numpy; extra == "whole"',
        'no-such-part>=1; extra == "bags"',
        'no-such-test; extra == "test"',
    ]
    about = Message()
    for extra in ("whole", "bags", "test"):
        about["Provides-Extra"] = extra
    monkeypatch.setattr(metadata, "requires", lambda _: required)
    monkeypatch.setattr(metadata, "metadata", lambda _: about)
    return tmp_path


def told(capsys, *arguments):
    """What the command prints; it leaves without an error."""
    options.execute(app.GNIO, ["doctor", *arguments], "gnio")
    return capsys.readouterr().out


def test_what_is_found(home, capsys):
    found = json.loads(told(capsys, "--json"))
    assert (
        found["packages"]["numpy"] == np.__version__ and found["packages"]["no-such-core"] is None
    )
    assert found["extras"] == {"whole": [], "bags": ["no-such-part"]}
    assert len(found["devices"]["kinds"]) == len(jax.devices()) and found["devices"]["float64"]
    recordings = home / "recordings"
    assert found["datasets"] == {
        "oxiod": str(recordings / "oxiod"),
        "tlio": str(recordings / "tlio_layout"),
        "randomised": "computed",
        "synthetic": "computed",
    }
    assert found["caches"]["recordings"] == str(home / "kept")
    assert found["weights"]["newest_run"] is None
    text = " ".join(found["remarks"])
    assert "not installed: no-such-core" in text


def test_it_fits_a_screen_and_says_what_to_do(home, capsys, monkeypatch):
    monkeypatch.setenv("GNIO_WEIGHTS", str(home / "nowhere"))
    run = home / "runs" / "mine"
    run.mkdir(parents=True)
    (run / "config.yaml").write_text("")
    text = told(capsys, "--data-root", str(home))
    assert len(text.splitlines()) <= 45 and "\x1b" not in text
    assert "pip install 'gnio-jax[bags]'" in text
    assert f"looked in {home} " in " ".join(text.split())
    assert "dataset oxiod" not in text and "runs/mine" in text
    remarks = [line for line in text.splitlines() if line.startswith("remark: ")]
    assert any("$GNIO_WEIGHTS" in line and "is no folder" in line for line in remarks)
