"""Every layout that is read is found, checked and converted; what comes back is what its own loader
gives, to the bit."""

import json
import warnings

import pytest

from gnio_jax import data
from tests.support.command_lines import run
from tests.support.layouts import LAYOUTS
from tests.support.sequences import assert_same_arrays


@pytest.mark.parametrize("name", LAYOUTS)
def test_a_layout_survives_its_conversion(name, tmp_path, monkeypatch, capsys):
    layout = LAYOUTS[name]
    monkeypatch.setenv("GNIO_CACHE", str(tmp_path / "cache"))
    root, out = tmp_path / "native", tmp_path / "converted"
    layout.write(root, max(layout.shortest, 12.0))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        expected = data.load(layout.dataset, root, layout.split)

    at = [layout.dataset, "--data-root", str(root)]
    run("data", "check", *at, "--json", str(tmp_path / "figures.json"))
    rows = json.loads((tmp_path / "figures.json").read_text())["sequences"]
    assert set(rows) == {sequence.name for sequence in expected}
    assert all(row["used"] for row in rows.values())
    for sequence in expected:
        assert rows[sequence.name]["split"].split(", ").count(layout.split) == 1
        assert rows[sequence.name]["duration"] == sequence.time[-1] - sequence.time[0]

    run("data", "convert", *at, str(out))
    assert f"{len(expected)} sequences" in capsys.readouterr().out
    found = data.load("csv", out, layout.split)
    for ours, theirs in zip(
        found, sorted(expected, key=lambda sequence: sequence.name), strict=True
    ):
        assert ours.name == theirs.name and theirs.attributes.items() <= ours.attributes.items()
        assert_same_arrays(ours, theirs)
