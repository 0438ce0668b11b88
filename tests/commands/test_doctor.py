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
    report = json.loads(capsys.readouterr().out)
    assert f"jax {jax.__version__}, " in report["packages"]
    assert "optax is not installed" in report["packages"]
    assert report["devices"] == f"{len(jax.devices())} × cpu" and report["float64"] == "works"
    assert report["extra bags"].startswith("rosbags ") and ", mcap " in report["extra bags"]
    assert report["extra rerun"] == "lacks rerun-sdk: pip install 'gnio-jax[rerun]'"
    places = {name: value for name, value in report.items() if name.startswith("dataset")}
    computed = {"dataset synthetic": "computed"}
    folders = {"dataset oxiod": "oxiod", "dataset tlio": "tlio_layout"}
    folders = {name: str(home / "recordings" / folder) for name, folder in folders.items()}
    assert places == computed | folders
    assert report["recordings read"] == str(home / "kept") and "pedestrian" in report["networks"]
    assert report["newest run"].startswith("none: runs: holds no run; train one with gnio train")
    monkeypatch.setenv("GNIO_WEIGHTS", str(home / "nowhere"))
    (home / "runs" / "mine").mkdir(parents=True)
    (home / "runs" / "mine" / "config.yaml").write_text("")
    run("doctor")
    text = capsys.readouterr().out
    assert len(text.splitlines()) <= 45 and "\x1b" not in text and "runs/mine" in text
    (line,) = [line for line in text.splitlines() if line.startswith("networks")]
    assert "$GNIO_WEIGHTS" in line and "is not a folder" in line
