"""Comparisons of made-up evaluations, by hand."""

import csv
import json
import shutil

import numpy as np
import pytest

from gnio_jax import config as configuration
from gnio_jax import data
from gnio_jax.apps import compare as comparison
from gnio_jax.config import CompareConfig, TrainConfig
from gnio_jax.errors import InputError
from gnio_jax.evaluation import reuse, tabulate
from tests.support.reports import LOST, digest, report_of, write_report, write_run

GROUPS = {"a": "ann", "b": "ann", "c": "bob"}
FILTER = configuration.to_plain(TrainConfig().filter)


def write(run, ates, name="synthetic_test_ekf", drop=(), groups=GROUPS, more=None, **settings):
    """An evaluation of a run; `ates`, `groups`, `more` and `drop` as in `report_of`."""
    settings = {"filter": FILTER, "weights": digest(write_run(run)), **settings}
    return write_report(run / "eval" / name, report_of(ates, groups, more, drop, **settings))


def compare(*words, metrics=("ate",), **options):
    return comparison.compare(CompareConfig(tuple(map(str, words)), metrics=metrics, **options))


def second(table, metric="ate"):
    """The difference of the second row."""
    difference = table.cells[metric][1].difference
    assert difference is not None
    return difference


@pytest.fixture
def runs(tmp_path):
    """`plain` with two seeds and `new` with one."""
    write(tmp_path / "plain_s0", {"a": 1.0, "b": 2.0, "c": 5.0})
    write(tmp_path / "plain_s1", {"a": 3.0, "b": 2.0, "c": 7.0})
    write(tmp_path / "new_s0", {"a": 1.0, "b": 3.0, "c": 3.0})
    return tmp_path


def test_by_hand(runs, monkeypatch):
    """Means over seeds 2, 2, 6 against 1, 3, 3: differences −1 and +1 of ann and −3 of bob. The
    means without ann and without bob are −3 and 0, so the standard error is √(1/2 (4 + 1))."""
    table = compare(runs / "plain", runs / "new")
    plain, new = table.cells["ate"]
    assert [row.label for row in table.rows] == ["plain", "new"] and plain.difference is None
    assert plain.summary.seeds == pytest.approx([8 / 3, 4.0])
    assert new.summary.seeds == pytest.approx([7 / 3])
    difference = second(table)
    assert difference.mean == pytest.approx(-1.0) and difference.gain == pytest.approx(30.0)
    reach = 12.7062 * 2.5**0.5  # t of one degree of freedom
    assert difference.interval == pytest.approx((-1 - reach, -1 + reach), rel=1e-5)
    assert (difference.better, difference.compared, difference.groups) == (2, 3, 2)
    assert comparison.lines(table) == [
        ["ATE (m)", "plain", "3.33 ± 0.94", "", ""],
        ["", "new", "2.33", "-1.00 (-21.09 to +19.09)", "2 of 3"],
    ]
    explanations = comparison.explanations(table)
    assert explanations[0].startswith("Seeds of plain: plain_s0, plain_s1; new: one.")
    assert comparison.title(table).startswith("synthetic test, ekf; differences to plain")
    assert list(compare(runs / "plain", runs / "new", metrics=None).cells) == ["ate", "rpe_1s"]
    # What diverged is in no difference, and more often it is not better: the walks that are left
    # may be the easy ones.
    for first, cells in (
        (1.5, ["", "lost", "2.25 † 1/3", "+0.25 (-2.93 to +3.43) over 2", "0 of 2"]),
        (0.5, ["", "lost", "1.75 † 1/3", "– ‡", ""]),
    ):
        write(runs / "lost", {"a": first, "b": LOST, "c": 3.0})
        table = compare(runs / "new_s0", runs / "lost")
        assert comparison.lines(table)[1] == cells
    assert any(explanation.startswith("‡ ") for explanation in comparison.explanations(table))
    # Of some metrics another value than zero is best.
    monkeypatch.setitem(tabulate.COLUMNS, "ate", tabulate.COLUMNS["ate"]._replace(best=4.0))
    table = compare(runs / "plain_s0", runs / "new")  # |1, 2, 5 − 4| against |1, 3, 3 − 4|
    assert comparison.lines(table)[0][0] == "ATE (m, best 4)" and second(table).better == 1


def test_means_over_other_recordings_say_so(runs):
    """a and c against b and c; of d and e there is nothing to compare."""
    groups = dict.fromkeys("abcde", "ann")
    write(runs / "more", {"b": 5.0, "c": 3.0}, groups=GROUPS)
    for row, ates in (("few", {"a": 1.0, "c": 5.0}), ("others", {"d": 1.0, "e": 2.0})):
        write(runs / row, ates, groups=groups | GROUPS)
    table = compare(runs / "few", runs / "more")
    assert comparison.lines(table) == [
        ["ATE (m)", "few", "3.00 over 2", "", ""],
        ["", "more", "4.00 over 2", "-2.00 over 1", "1 of 1"],
    ]
    explanations = comparison.explanations(table)
    assert "few has 2; more has 1 of them and 1 others" in explanations[1]
    lines = comparison.lines(compare(runs / "plain_s0", runs / "new"))
    assert not any("over" in cell for line in lines for cell in line)
    with pytest.raises(InputError, match=r"^others: shares no recording with few"):
        compare(runs / "few", runs / "others")
    # Nor have the seeds of one row a mean, if they have no recording in common.
    write(runs / "odd_s0", {"a": 1.0})
    write(runs / "odd_s1", {"c": 1.0})
    with pytest.raises(InputError, match=r"^odd: shares no recording with few"):
        compare(runs / "few", runs / "odd")


def test_names_without_a_seed_stand_for_all_seeds(tmp_path):
    """Also where the name itself looks like a seed."""
    names = ("net_s0", "net_s10", "net_s2", "net_s0_calibrated", "net_s2_calibrated")
    for name in (*names, "net_small_s1", "galaxy_s8_w8_s0", "galaxy_s8_w8_s1", "galaxy_s8_w9"):
        (write_run(tmp_path / name) / "eval" / "x").mkdir(parents=True)
    (tmp_path / "net_s4").mkdir()  # no run
    (tmp_path / "net_s5").touch()

    def run_names(word):
        return [str(path.relative_to(tmp_path)) for path in comparison.find(str(tmp_path / word))]

    assert run_names("net") == ["net_s0", "net_s2", "net_s10"]
    assert run_names("net_calibrated") == ["net_s0_calibrated", "net_s2_calibrated"]
    assert run_names("net_s2") == ["net_s2"]
    assert run_names("net/eval/x") == [f"net_s{k}/eval/x" for k in (0, 2, 10)]
    assert run_names("galaxy_s8_w8") == ["galaxy_s8_w8_s0", "galaxy_s8_w8_s1"]
    for word in ("net/eval/y", "nothing", "galaxy_w9"):
        with pytest.raises(InputError, match="is not there"):
            run_names(word)
    write_run(tmp_path / "galaxy_s8_w8_s01")
    with pytest.raises(InputError, match="has a seed twice"):
        run_names("galaxy_s8_w8")


def test_runs_are_evaluated_where_they_are_not_yet_and_read_once(runs, monkeypatch):
    evaluations, looked, look = [], [], reuse.find_existing

    def evaluate(config, progress, workers, **_):
        evaluations.append((config.network, config.split, config.estimator, workers))
        name = config.network.removeprefix(f"{runs}/")
        write(runs / name, {"a": 4.0}, "synthetic_val_ekf", split="val")

    monkeypatch.setattr(reuse, "evaluate", evaluate)
    monkeypatch.setattr(
        reuse, "find_existing", lambda settings: looked.append(settings.network) or look(settings)
    )
    config = CompareConfig((f"{runs}/plain", f"{runs}/new"), split="val", metrics=("ate",))
    table = comparison.compare(config, workers=3)
    names = [f"{runs}/{name}" for name in ("plain_s0", "plain_s1", "new_s0")]
    assert evaluations == [(name, "val", "ekf", 3) for name in names] and looked == names
    assert second(table).mean == 0
    comparison.compare(config)
    assert len(evaluations) == 3


def test_evaluations_by_their_folders(runs, monkeypatch):
    """Two estimators of one run, side by side, also named from inside. Options of the filter that
    differ are told, where one runs."""
    settings = {"estimator": "integrate", "coupling": None, "orientation_source": "reference"}
    other = write(runs / "new_s0", {"a": 2.0, "b": 4.0, "c": 4.0}, "summed", **settings)
    table = compare(runs / "new", other)
    assert second(table).mean == pytest.approx(1.0)
    assert [row.label for row in table.rows] == ["new", "new_s0/eval/summed"]
    explanations = comparison.explanations(table)
    assert (
        explanations[0].startswith("There is one seed")
        and "integrate, reference orientation" in explanations[1]
    )
    monkeypatch.chdir(runs / "new_s0" / "eval")
    table = compare("synthetic_test_ekf", "summed")
    assert [row.runs for row in table.rows] == [["new_s0"], ["new_s0"]]
    for name, gravity, density in (("here", 9.8, 1), ("there", 9.7, 1.0)):
        options = {"gravity": gravity, "accel_density": density}
        write(runs / name, {"a": 1.0}, "own", filter=options)
        write(runs / name, {"a": 1.0}, "summed", filter=options, estimator="integrate")
    for way, differ in (("own", ["gravity"]), ("summed", [])):
        table = compare(runs / f"here/eval/{way}", runs / f"there/eval/{way}")
        assert comparison.filter_options(table) == differ


def test_refusals(runs):
    def refused(*words, metrics=None, **options):
        with pytest.raises(InputError) as error:
            compare(*(runs / word for word in words), metrics=metrics, **options)
        return str(error.value)

    folder = "eval/synthetic_test_ekf"
    write(runs / "seen", {"a": 1.0}, split="seen")
    write(runs / "B", {"a": 1.0}, data_root="/B")  # though the recordings have the same names
    write(runs / "groups", {"a": 1.0, "b": 1.0}, groups={**GROUPS, "b": "eve"})
    for name, seconds in (("short", 60.0), ("long", 60.1), ("mix_s0", 60.0), ("mix_s1", 600.0)):
        write(runs / name, {"a": 1.0}, recordings={"a": seconds})
    for seed in (0, 1):
        (runs / f"linked_s{seed}").symlink_to(runs / "new_s0")
    write(runs / "new_s0", {"a": 0.5}, "aligned", alignment="se3")
    (runs / "untrained").mkdir()
    (runs / "untrained" / "config.yaml").write_text("dataset: synthetic\n")
    write(runs / "old", {"a": 1.0}, definitions=1)
    write(runs / "left", {"a": 1.0}, weights="0" * 64)
    for words, problem in (
        (("plain",), "needs two or more"),
        (("plain", "gone"), "is not there"),
        (("new", "new"), "new_s0: is named twice"),
        (("plain", f"seen/{folder}"), "is of split seen, the first row of test; give --split seen"),
        (("plain", f"B/{folder}"), "the first row of None; give --data-root /B for the runs"),
        (("plain", "groups"), f"sequence b is of eve here, of ann in {runs}/plain_s0/"),
        (("short", "long"), f"sequence a takes 60.1 s here, 60 s in {runs}/short/"),
        (("mix", "new"), f"mix_s1/{folder}: sequence a takes 600 s here"),
        (("linked", "plain"), "linked_s1: is the same evaluation as"),
        (("plain", "new_s0/eval/aligned"), "is of alignment se3, the first row of origin"),
        (("untrained", "plain"), "untrained: holds no weights"),
        (("plain", f"old/{folder}"), "another version"),
        (("plain", f"left/{folder}"), "of weights that the network has no more"),
        (("plain", "new_s0/eval"), "neither a run nor an evaluation"),
    ):
        assert problem in refused(*words)
    assert "no row has 'nis'; there are: ate, rpe_1s" in refused("plain", "new", metrics=("nis",))
    assert "no metric 'new'; write the runs before" in refused("plain", metrics=("ate", "new"))
    (runs / "plain_s1" / folder).rename(runs / "elsewhere")
    assert "exists for 1 of 2 seeds only; missing: " in refused(f"seen/{folder}", f"plain/{folder}")


def test_figures_of_recordings_that_have_changed_are_refused(runs, tmp_path):
    """Those of two runs on a folder that was changed in between, too, if the folder is gone."""
    root = tmp_path / "own"
    root.mkdir()
    (root / "a.csv").write_text("walk")
    source = {"dataset": "csv", "data_root": str(root)}
    for name in ("first", "second"):
        contents = data.describe_contents("csv", root, "test")
        write(runs / name, {"a": 1.0}, "csv_test_ekf", contents=contents, **source)
        if name == "first":
            (root / "a.csv").write_text("other walk")
    folders = [runs / name / "eval" / "csv_test_ekf" for name in ("first", "second")]
    problem = f"its figures are of other recordings: recording a in {root} has changed since"
    with pytest.raises(InputError) as error:
        compare(*folders)
    assert str(error.value) == f"{folders[0]}: {problem}; evaluate the run again with gnio evaluate"
    shutil.rmtree(root)
    with pytest.raises(InputError) as error:
        compare(*folders)
    problem = f"recording a has other files here than in {folders[0]}"
    assert str(error.value) == f"{folders[1]}: {problem}; evaluate it again, or {folders[0]}"


def test_recordings_that_were_left_out_are_told(runs):
    folder = write(runs / "holes", {"a": 1.0, "b": 2.0, "c": 3.0})
    content = json.loads((folder / "metrics.json").read_text())
    content["left_out"] = {name: f"{name}.csv: is damaged" for name in "defgh"}
    (folder / "metrics.json").write_text(json.dumps(content))
    explanations = comparison.explanations(compare(runs / "plain_s0", runs / "new"))
    assert not any("left out" in line for line in explanations)
    explanations = comparison.explanations(compare(runs / "plain_s0", runs / "holes"))
    assert "holes: 5 of 8 recordings were left out: d, e, f, ..." in explanations


def test_the_command_shows_and_writes(runs, gnio, mistake, monkeypatch):
    """A name that cannot be written is told first."""
    monkeypatch.chdir(runs)
    (runs / "a_file").touch()
    (runs / "c.csv").mkdir()
    before = sorted(runs.iterdir())
    for wrong in ("results/", "c", "x.md", "a_file/x", "y" * 248):
        mistake("compare", "plain", "new", "--out", wrong)
    assert sorted(runs.iterdir()) == before
    out = runs / "results" / "v1.5"
    (runs / "new_s0").rename(runs / "pipe|x")
    words = [f"{runs}/plain", f"{runs}/pipe|x", "--metrics", "ate", "rpe_1s", "--out", str(out)]
    shown = gnio("compare", *words)
    assert "-1.00 (-21.09 to +19.09)" in shown and str(out) in shown
    table = list(csv.DictReader((out.parent / "v1.5.csv").open(encoding="utf-8")))
    assert [(line["metric"], line["row"]) for line in table] == [
        (metric, row) for metric in ("ate", "rpe_1s") for row in ("plain", "pipe|x")
    ]
    assert float(table[1]["difference"]) == pytest.approx(-1.0) and table[0]["difference"] == ""
    assert float(table[0]["std"]) == pytest.approx(np.std([8 / 3, 4.0], ddof=1))
    text = (out.parent / "v1.5.md").read_text("utf-8")
    assert "| ATE (m) | plain | 3.33 ± 0.94 |" in text and r"|  | pipe\|x | 2.33 |" in text
    assert (out.parent / "v1.5.png").read_bytes().startswith(b"\x89PNG")
