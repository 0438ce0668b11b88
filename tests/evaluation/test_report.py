"""The files of an evaluation parse back, and keep what diverged apart."""

import csv
import json
import math
import re

import numpy as np
import pytest

from gnio_jax import evaluation
from gnio_jax.config import TrainConfig
from gnio_jax.errors import InputError
from gnio_jax.evaluation import Trajectory, folder, report, score
from tests.support.estimates import reported


def write(place, made, estimates, **options):
    """The folder, by default without pictures, and its metrics.json."""
    folder.write(place, made, estimates, TrainConfig(), plots=options.pop("plots", False))

    def strict(constant):
        raise AssertionError(f"{constant} is not JSON")

    return json.loads((place / "metrics.json").read_text(), parse_constant=strict)


def rows(place):
    with open(place / "metrics.csv", newline="") as file:
        return list(csv.DictReader(file))


def test_what_is_written_is_read_back_whole(tmp_path, estimates, made, with_divergence):
    made = made._replace(placements={"room 1/walk": "in a hand"})
    for place, of, wanted in (
        (tmp_path / "a", *with_divergence),
        (tmp_path / "e", estimates, made),
    ):
        found = write(place, wanted, of)
        assert evaluation.load(place) == wanted
    first, _, blind = found["sequences"].values()
    assert first["placement"] == "in a hand" and "placement" not in blind
    assert first["ate"] == made.scores["room 1/walk"].values["ate"]
    assert first["reasons"] == {} and first["infinite"] == [] and first["diverged"] is False
    assert first["accepted"] == pytest.approx(90, abs=0.5) and first["nis"] == 1.0
    assert blind["ate"] is None and blind["reasons"]["ate"] == "no trusted reference"
    assert blind["notes"] == ["start: rough"] and blind["nis"] == 1.0
    ates = [found["sequences"][f"room 1{c}walk"]["ate"] for c in "/:"]
    assert found["mean"]["ate"] == pytest.approx(np.mean(ates))
    assert found["n"]["ate"] == 2 and found["interval"]["ate"] is None
    assert len(found["interval"]["nis"]) == 2 and found["left_out"] == {"short": "0.5 s"}
    assert found["reference_rows"]["never_moves"]["mean"]["path_length_ratio"] == 0
    lines = rows(tmp_path / "e")
    assert float(lines[0]["ate"]) == first["ate"]
    assert lines[2]["ate"] == "" and lines[2]["sequence"] == "blind"
    trajectories, references = (
        sorted(path.name for path in (tmp_path / "e" / kind).iterdir())
        for kind in ("trajectories", "references")
    )
    assert trajectories == ["blind.txt", "room_1_walk.txt", "room_1_walk_.txt"]
    assert references == trajectories[1:]


def test_what_the_estimator_gave_is_there_for_numpy(tmp_path, estimates):
    walk, summed = estimates[0], estimates[1]._replace(filtered=None, states=None)
    write(tmp_path, reported([walk, summed]), [walk, summed])
    first, second = (np.load(tmp_path / "states" / f"room_1_walk{end}.npz") for end in ("", "_"))
    names = "time position orientation displacement displacement_covariance gate "
    names += "position_covariance nis accepted velocity gyro_bias accel_bias std innovation"
    found, gate = walk.displacements, walk.displacements.diagnostics["gate"]
    values = [*walk.trajectory, found.value, found.covariance, gate, *walk.filtered, *walk.states]
    wanted = dict(zip(names.split(), values, strict=True))
    assert set(first) == wanted.keys() and set(second) == {*list(wanted)[:6]}
    for name, own in wanted.items():
        np.testing.assert_array_equal(first[name], own)


def test_trajectories_are_read_back_at_their_own_stamps(tmp_path, estimates, made):
    whole, rows = estimates[0], np.arange(400)
    holes, ends = (rows >= 20) & (rows < 30), rows >= 390

    def without(of, gone):
        parts = (np.where(gone[:, None], np.nan, part) for part in of[1:])
        return Trajectory(of.time, *parts)

    path, reference = without(whole.trajectory, ends), without(whole.reference, holes)
    of = [whole._replace(trajectory=path, reference=reference), *estimates[1:]]
    write(tmp_path / "e", made, of)
    first, _, blind = folder.read_estimates(tmp_path / "e", list(made.scores))
    read, true = first.trajectory, first.reference
    assert len(read.time) == 390
    np.testing.assert_allclose(read.position, path.position[:390], atol=1e-8)
    np.testing.assert_allclose(true.position, reference.position[:390], atol=1e-8)
    assert not blind.reference.known.any() and blind.waypoints is None


def test_divergence_is_in_the_files(tmp_path, with_divergence):
    of, made = with_divergence
    found = write(tmp_path / "e", made, of)
    lost = found["sequences"]["room 1:walk"]
    assert lost["ate"] is None and "ate" in lost["infinite"] and lost["diverged"] is True
    assert lost["reasons"]["ate"] == "the estimate is not finite from 20.0 s on"
    assert {name: own["group"] for name, own in found["sequences"].items()} == made.groups
    assert found["diverged"]["ate"] == 1 and found["n"]["ate"] == 2
    ates = [found["sequences"][name]["ate"] for name in ("room 1/walk", "room 3")]
    assert found["mean"]["ate"] == pytest.approx(np.mean(ates))
    assert found["median"]["ate"] == max(ates)  # of two finite and an infinite one
    middle, reach = np.mean(ates), 12.7062 * np.ptp(ates) / 2  # t of one degree of freedom
    assert found["interval"]["ate"] == pytest.approx([middle - reach, middle + reach], rel=1e-4)
    assert found["groups"]["ate"] == 2
    assert [row["ate"] for row in rows(tmp_path / "e")][1:3] == ["inf", ""]
    assert found["reference_rows"]["never_moves"]["diverged"]["ate"] == 0


def test_no_page_is_lost_and_none_is_of_other_figures(tmp_path, estimates, made, no_pictures):
    place, of = tmp_path / "e", estimates[:1]
    first = made._replace(scores=score(of))
    write(place, first, of)
    assert not (place / "report.html").exists() and not (place / "plots").exists()
    write(place, first, of, plots=True)
    further = [of[0]._replace(trajectory=estimates[1].trajectory)]
    again = made._replace(scores=score(further))
    write(place, again, further)
    ates = [each.scores["room 1/walk"].values["ate"] for each in (first, again)]
    assert f"<td>{ates[1]:.2f}</td>" in (place / "report.html").read_text(encoding="utf-8")
    assert ates[0] != ates[1] and (place / "plots").is_dir()


DAMAGES = [
    (("sequences", "blind", "reasons"), {"ate": 5}),
    (("sequences", "blind", "group"), None),
    (("sequences", "blind", "nis"), 10**400),
    (("sequences", "blind", "nis"), math.inf),
    (("sequences", "blind", "infinite"), ["nis"]),
    (("sequences", "blind", "diverged"), "no"),
    (("sequences", "blind", "notes"), [5]),
    (("settings", "split"), 5),
    (("settings", "filter"), 5),
    (("settings",), []),
    (("sequences",), {}),
    (("left_out",), {"short": None}),
]


def test_what_is_no_evaluation_is_named(tmp_path, estimates, made):
    whole = json.dumps(write(tmp_path / "e", made, estimates))
    path = tmp_path / "e" / "metrics.json"

    def refused(content, problem):
        path.write_bytes(content)
        with pytest.raises(InputError, match=re.escape(problem)):
            folder.read(path.parent)

    for where, value in [*DAMAGES, (("settings", "definitions"), report.DEFINITIONS - 1)]:
        found = inner = json.loads(whole)
        for name in where[:-1]:
            inner = inner[name]
        inner[where[-1]] = value
        other = where[-1] == "definitions"
        words = "written by another version" if other else "is not a metrics.json of an evaluation"
        refused(json.dumps(found).encode(), words)
    for broken in (b"[" * 100_000, b"nothing", b"\xff"):
        refused(broken, "is not a metrics.json of an evaluation")
    path.unlink()
    for place in (tmp_path, path, tmp_path / "nowhere"):
        with pytest.raises(InputError, match="is neither a run nor an evaluation"):
            folder.read(place)
