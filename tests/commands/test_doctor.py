"""What `gnio doctor` finds in a home that is made up."""

import json
from importlib import metadata

import jax
import pytest

from tests.support.command_lines import run


@pytest.fixture
def home(tmp_path, monkeypatch):
    """A folder with datasets of two names, and two packages that are missing."""
    for name in ("oxiod", "tlio_layout", "thesis"):
        (tmp_path / "recordings" / name).mkdir(parents=True)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("GNIO_DATA", str(tmp_path / "recordings"))
    monkeypatch.setenv("GNIO_CACHE", str(tmp_path / "kept"))
    monkeypatch.delenv("GNIO_WEIGHTS", raising=False)
    version = metadata.version

    def without_optax(name):
        if name in ("optax", "rerun-sdk"):
            raise metadata.PackageNotFoundError(name)
        return version(name)

    monkeypatch.setattr(metadata, "version", without_optax)
    return tmp_path


def test_what_is_found_fits_a_screen_and_says_what_is_wrong(home, capsys, monkeypatch):
    run("doctor", "--json")
    found = json.loads(capsys.readouterr().out)
    assert f"jax {jax.__version__}, " in found["packages"]
    assert "optax is not installed" in found["packages"]
    assert found["devices"] == f"{len(jax.devices())} × cpu" and found["float64"] == "works"
    assert found["extra bags"].startswith("rosbags ") and ", mcap " in found["extra bags"]
    assert found["extra rerun"] == "lacks rerun-sdk: pip install 'gnio-jax[rerun]'"
    places = {name: place for name, place in found.items() if name.startswith("dataset")}
    computed = {"dataset synthetic": "computed"}
    there = {"dataset oxiod": "oxiod", "dataset tlio": "tlio_layout"}
    there = {name: str(home / "recordings" / place) for name, place in there.items()}
    assert places == computed | there
    assert found["recordings read"] == str(home / "kept") and "pedestrian" in found["networks"]
    assert found["newest run"].startswith("none: runs: holds no run; train one with gnio train")
    monkeypatch.setenv("GNIO_WEIGHTS", str(home / "nowhere"))
    (home / "runs" / "mine").mkdir(parents=True)
    (home / "runs" / "mine" / "config.yaml").write_text("")
    run("doctor")
    text = capsys.readouterr().out
    assert len(text.splitlines()) <= 45 and "\x1b" not in text and "runs/mine" in text
    (line,) = [line for line in text.splitlines() if line.startswith("networks")]
    assert "$GNIO_WEIGHTS" in line and "is not a folder" in line
