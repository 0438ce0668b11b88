"""Every layout is found, checked and converted; what comes back is what was there, to the bit."""

import json
import warnings

import pytest

from gnio_jax import data
from tests.support.command_lines import run
from tests.support.damaged_recordings import check_sequence
from tests.support.layouts import LAYOUTS
from tests.support.sequences import assert_same_arrays


@pytest.mark.parametrize("name", LAYOUTS)
def test_a_layout_is_plausible_and_survives_its_conversion(name, tmp_path, monkeypatch, capsys):
    layout = LAYOUTS[name]
    monkeypatch.setenv("GNIO_CACHE", str(tmp_path / "cache"))
    root, out = tmp_path / "native", tmp_path / "converted"
    layout.write(root, layout.shortest)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        (expected,) = data.load(layout.dataset, root, layout.split)
    check_sequence(expected, name)
    assert expected.valid.mean() > 0.9 or expected.waypoints is not None

    at = [layout.dataset, "--data-root", str(root)]
    run("data", "check", *at, "--json", str(tmp_path / "figures.json"))
    (row,) = json.loads((tmp_path / "figures.json").read_text())["sequences"].items()
    assert row[0] == expected.name and row[1]["used"]
    assert row[1]["split"].split(", ").count(layout.split) == 1
    assert row[1]["duration"] == expected.time[-1] - expected.time[0]

    run("data", "convert", *at, str(out))
    assert "1 sequences" in capsys.readouterr().out
    (sequence,) = data.load("csv", out, layout.split)
    assert sequence.name == expected.name
    assert expected.attributes.items() <= sequence.attributes.items()
    assert_same_arrays(sequence, expected)
