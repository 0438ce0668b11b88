"""Comparisons of made-up evaluations, by hand."""

import csv
import json
import math

import numpy as np
import pytest

from gnio_jax import comparison
from gnio_jax.commands import app
from gnio_jax.comparison import comparing, figures, pairs, picture, rows, text
from gnio_jax.config import CompareConfig
from gnio_jax.errors import InputError
from gnio_jax.evaluation import report

GROUPS = {"a": "ann", "b": "ann", "c": "bob"}


def write(run, ates, name="oxiod_test_ekf", drop=(), groups=GROUPS, more=None, **settings):
    """An evaluation of a run: `ate` of sequence -> m, infinite where it diverged; `rpe_1s` is a
    tenth of it. `drop`: metrics that it lacks; `more`: of each sequence."""
    sequences = {}
    for sequence, ate in ates.items():
        values = {"ate": ate, "rpe_1s": ate / 10}
        if math.isinf(ate):
            reason = "the estimate is not finite from 2.0 s on"
            values = {"ate": None, "rpe_1s": 0.5, "undefined": {"ate": reason}}
        kept = {key: value for key, value in values.items() if key not in drop}
        sequences[sequence] = {**kept, **(more or {}), "group": groups[sequence]}
    finite = [ate for ate in ates.values() if math.isfinite(ate)]
    mean = {"ate": np.mean(finite), "rpe_1s": np.mean(finite) / 10, **(more or {})}
    found = {
        "settings": {
            "dataset": "oxiod",
            "split": "test",
            "definitions": report.DEFINITIONS,
            **settings,
        },
        "sequences": sequences,
        "mean": {
            **{key: value for key, value in mean.items() if key not in drop},
            "diverged": len(ates) - len(finite),
        },
    }
    folder = run / "eval" / name
    folder.mkdir(parents=True)
    (run / "config.yaml").write_text("dataset: oxiod\n")
    (run / "checkpoints" / "best" / "7").mkdir(parents=True, exist_ok=True)
    (folder / "metrics.json").write_text(json.dumps(found))
    return folder


@pytest.fixture
def runs(tmp_path):
    """`plain` with two seeds and `new` with one."""
    write(tmp_path / "plain_s0", {"a": 1.0, "b": 2.0, "c": 5.0})
    write(tmp_path / "plain_s1", {"a": 3.0, "b": 2.0, "c": 7.0})
    write(tmp_path / "new_s0", {"a": 1.0, "b": 3.0, "c": 3.0})
    return tmp_path


def second(found, metric="ate"):
    """The difference of the second row."""
    difference = found.cells[metric][1].difference
    assert difference is not None
    return difference


def test_by_hand(runs):
    """Means over seeds 2, 2, 6 against 1, 3, 3: differences −1 and +1 of ann and −3 of bob. The
    sums of the deviations from −1 are 2 and −2, so the standard error is √2 √8 / 3."""
    found = comparison.compare(CompareConfig((f"{runs}/plain", f"{runs}/new"), metrics=("ate",)))
    plain, new = found.cells["ate"]
    assert plain.label == "plain" and plain.difference is None
    assert plain.seeds == pytest.approx([8 / 3, 4.0]) and new.seeds == pytest.approx([7 / 3])
    difference = second(found)
    assert difference.mean == pytest.approx(-1.0)
    reach = 12.7062 * 4 / 3  # t of one degree of freedom
    assert difference.interval == pytest.approx((-1 - reach, -1 + reach), rel=1e-5)
    assert difference.gain == pytest.approx(30.0)
    assert (difference.better, difference.compared, difference.groups) == (2, 3, 2)
    assert text.lines(found) == [
        ["ATE (m)", "plain", "3.33 ± 0.94", "", ""],
        ["", "new", "2.33", "-1.00 (-17.94 to +15.94)", "2 of 3"],
    ]
    assert "there are 2." in text.explanations(found)[1]
    assert text.explanations(found)[0].startswith("Seeds of plain: plain_s0, plain_s1; new: one.")


def test_what_diverged_is_in_no_difference(runs):
    """Its other metrics neither, although they may have values."""
    write(runs / "lost", {"a": 1.5, "b": math.inf, "c": 3.0})
    words = (f"{runs}/new_s0", f"{runs}/lost")
    found = comparison.compare(CompareConfig(words, metrics=("ate", "rpe_1s")))
    for metric, scale in (("ate", 1.0), ("rpe_1s", 0.1)):
        assert second(found, metric).compared == 2 and found.cells[metric][1].diverged == 1
        assert second(found, metric).mean == pytest.approx(0.25 * scale)
    assert text.lines(found)[1][2] == "2.25 † 1/3" and text.lines(found)[1][3].endswith("over 2")
    assert text.explanations(found)[-1].startswith("†")
    names = [label.get_text() for label in picture.draw(found).axes[0].get_yticklabels()]
    assert [name for name in names if "†" in name] == ["b  (ann) †"]


def test_what_diverged_more_often_is_not_better(runs, tmp_path):
    """The walks that are left may be the easy ones."""
    write(runs / "lost", {"a": 0.5, "b": math.inf, "c": 3.0})
    words = (f"{runs}/new_s0", f"{runs}/lost")
    found = comparison.compare(CompareConfig(words, metrics=("ate",)))
    assert second(found).withheld and second(found).mean is None
    assert text.lines(found)[1] == ["", "lost", "1.75 † 1/3", "– ‡", ""]
    assert text.explanations(found)[-1].startswith("‡ Would be better than new_s0")
    text.write(tmp_path / "both", found)
    table = list(csv.DictReader((tmp_path / "both.csv").open(encoding="utf-8")))
    assert [table[1][name] for name in ("difference", "better", "compared", "estimates")] == [
        "",
        "",
        "2",
        "3",
    ]
    assert [table[0][name] for name in ("better", "compared", "groups")] == ["", "", ""]
    found = comparison.compare(CompareConfig(words[::-1], metrics=("ate",)))
    assert second(found).mean == pytest.approx(0.25)


def test_seeds_are_averaged_over_the_sequences_that_all_have(tmp_path):
    """Or ± would be of the walk that one seed lacks."""
    for name, more in (("one", 0.0), ("two", 0.5)):
        write(tmp_path / f"{name}_s0", {"a": 1.0 + more, "b": 2.0 + more, "c": 9.0})
        write(tmp_path / f"{name}_s1", {"a": 1.0 + more, "b": 2.0 + more})
    words = (f"{tmp_path}/one", f"{tmp_path}/two")
    found = comparison.compare(CompareConfig(words, metrics=("ate",)))
    assert [cell.seeds for cell in found.cells["ate"]] == [[1.5, 1.5], [2.0, 2.0]]
    assert (second(found).compared, second(found).sequences) == (2, 3)
    assert any("with every seed" in line for line in text.explanations(found))


def test_an_infinite_covariance_is_no_divergence(runs):
    too_large = {"nees": None, "undefined": {"nees": "the error is too large for a number"}}
    write(runs / "bad", {"a": 1.0, "b": 3.0, "c": 3.0}, more=too_large)
    write(runs / "good", {"a": 1.0, "b": 3.0, "c": 3.0}, more={"nees": 1.0})
    words = (f"{runs}/good", f"{runs}/bad")
    found = comparison.compare(CompareConfig(words, metrics=("nees", "ate")))
    assert text.lines(found)[1] == ["", "bad", "∞", "–", ""]
    assert any(line.startswith("∞") for line in text.explanations(found))
    labels = [label.get_text() for label in picture.draw(found).axes[0].get_yticklabels()]
    assert not any("†" in label for label in labels)


def test_a_difference_has_the_digits_of_its_interval():
    """A mean of 3.0 ° may differ by 0.0045 °."""
    found = pairs.Difference(0.00452, (0.00213, 0.00709), None, 1, 2, 2, 2)
    cell = comparing.Cell("x", [3.0], 0, 2, found)
    assert text._texts(cell, 1)[2] == "+0.0045 (+0.0021 to +0.0071)"


def test_how_the_rows_are_estimated_is_said(runs):
    other = write(
        runs / "new_s0",
        {"a": 2.0, "b": 4.0, "c": 4.0},
        "oxiod_test_integrate",
        estimator="integrate",
        orientation_source="reference",
    )
    words = (f"{runs}/plain_s0", str(other))
    found = comparison.compare(CompareConfig(words, metrics=("ate",)))
    assert "integrate, attitude of the reference" in text.explanations(found)[1]
    found = comparison.compare(CompareConfig((f"{runs}/plain", f"{runs}/new"), metrics=("ate",)))
    assert text.title(found).startswith("oxiod test, estimator not known; differences to plain")


def test_names_that_markdown_and_matplotlib_read(runs, tmp_path):
    names = ["a$x^$", "_under", "pipe|x", "\udcff_x"]
    for name in names:
        write(runs / name, {"a": 1.0, "b": 3.0, "c": 3.0})
    words = tuple(f"{runs}/{name}" for name in names)
    found = comparison.compare(CompareConfig(words, metrics=("ate",)))
    figure = picture.draw(found)
    picture.save(tmp_path / "p.png", figure)
    legend = [entry.get_text() for entry in figure.legends[0].get_texts()]
    assert legend == [r"a\$x^\$", "\u200b_under", "pipe|x", r"\udcff_x"]
    text.write(tmp_path / "v1.5", found)
    assert r"|  | pipe\|x | 2.33 |" in (tmp_path / "v1.5.md").read_text(encoding="utf-8")


def test_a_metric_that_one_row_lacks(runs):
    write(runs / "other", {"a": 1.0, "b": 1.0, "c": 1.0}, drop=("rpe_1s",))
    words = (f"{runs}/plain", f"{runs}/other", f"{runs}/new")
    found = comparison.compare(CompareConfig(words, metrics=("rpe_1s",)))
    assert text.lines(found)[1] == ["", "other", "–", "", ""]
    assert text.lines(found)[2][3].startswith("-0.100")
    found = comparison.compare(CompareConfig(words[1:], metrics=("rpe_1s",)))
    assert text.lines(found)[1][3] == "–"  # nothing to compare with


def test_one_group_has_no_interval(tmp_path):
    for name, ate in (("one", 1.0), ("two", 2.0)):
        write(tmp_path / name, {"a": ate, "b": ate})
    found = comparison.compare(
        CompareConfig((f"{tmp_path}/one", f"{tmp_path}/two"), metrics=("ate",))
    )
    assert text.lines(found)[1][3] == "+1.00"
    assert any(line.startswith("No interval") for line in text.explanations(found))


def test_names_without_a_seed_stand_for_all_seeds(tmp_path):
    names = [
        "net_s0",
        "net_s10",
        "net_s2",
        "net_s0_calibrated",
        "net_s2_calibrated",
        "net_small_s1",
    ]
    for name in names:
        (tmp_path / name / "eval" / "x").mkdir(parents=True)
        (tmp_path / name / "config.yaml").touch()
    (tmp_path / "net_s4").mkdir()  # no run
    (tmp_path / "net_s5").touch()
    found = {
        word: [str(path.relative_to(tmp_path)) for path in rows.of_all_seeds(tmp_path / word)]
        for word in ("net", "net_calibrated", "net_s2", "net/eval/x", "net/eval/y", "nothing")
    }
    assert found == {
        "net": ["net_s0", "net_s2", "net_s10"],
        "net_calibrated": ["net_s0_calibrated", "net_s2_calibrated"],
        "net_s2": ["net_s2"],
        "net/eval/x": ["net_s0/eval/x", "net_s2/eval/x", "net_s10/eval/x"],
        "net/eval/y": [],
        "nothing": [],
    }


def test_runs_are_evaluated_where_they_are_not_yet(runs, monkeypatch):
    made = []

    def evaluate(config, progress, workers):
        made.append((config.workdir, config.split, config.estimator, config.data_root, workers))
        write(
            runs / config.workdir.removeprefix(f"{runs}/"), {"a": 4.0}, "oxiod_val_ekf", split="val"
        )

    monkeypatch.setattr(figures.evaluation, "evaluate", evaluate)
    words = (f"{runs}/plain", f"{runs}/new")
    config = CompareConfig(words, split="val", metrics=("ate",), data_root="there")
    found = comparison.compare(config, workers=3)
    assert made == [
        (f"{runs}/{name}", "val", "ekf", "there", 3) for name in ("plain_s0", "plain_s1", "new_s0")
    ]
    assert found.split == "val" and second(found).mean == 0
    comparison.compare(config)
    assert len(made) == 3


def test_evaluations_by_their_folders(runs):
    """Two estimators of one run, side by side."""
    other = write(runs / "new_s0", {"a": 2.0, "b": 4.0, "c": 4.0}, "oxiod_test_integrate")
    found = comparison.compare(CompareConfig((f"{runs}/new", str(other)), metrics=("ate",)))
    assert second(found).mean == pytest.approx(1.0)
    assert [row.label for row in found.rows] == ["new", "new_s0/eval/oxiod_test_integrate"]
    assert text.explanations(found)[0].startswith("One seed each")
    words = [f"{runs}/{name}_s0/eval/oxiod_test_ekf" for name in ("plain", "new")]
    found = comparison.compare(CompareConfig(tuple(words), metrics=("ate",)))
    assert [row.label for row in found.rows] == ["plain_s0", "new_s0"]


def test_rows_without_a_common_sequence(tmp_path):
    write(tmp_path / "one", {"a": 1.0})
    write(tmp_path / "two", {"c": 2.0})
    words = (f"{tmp_path}/one", f"{tmp_path}/two")
    found = comparison.compare(CompareConfig(words, metrics=("ate",)))
    assert text.lines(found)[1] == ["", "two", "2.00", "–", ""]
    assert any("both rows have" in line for line in text.explanations(found))
    assert not any("No interval" in line for line in text.explanations(found))


def test_better_is_nearer_to_the_best_value():
    """Each seed for itself: 0.7 and 1.4 are no 1.05."""
    first, own = {"a": np.array([0.7, 1.4])}, {"a": np.array([0.9])}
    assert pairs.difference(own, first, {"a": "x"}, best=1.0).better == 1
    assert pairs.difference(first, own, {"a": "x"}, best=1.0).better == 0


def test_a_comparison_knows_which_value_is_best(runs, monkeypatch):
    words = (f"{runs}/plain_s0", f"{runs}/new")
    monkeypatch.setitem(comparing.BEST, "ate", 4.0)  # |1, 2, 5 − 4| against |1, 3, 3 − 4|
    found = comparison.compare(CompareConfig(words, metrics=("ate",)))
    assert text.lines(found)[0][0] == "ATE (m, best 4)"
    assert second(found).better == 1


def test_without_metrics_the_usual_ones_that_are_there(runs):
    found = comparison.compare(CompareConfig((f"{runs}/plain", f"{runs}/new")))
    assert list(found.cells) == ["ate", "rpe_1s"]


def test_a_name_may_look_like_a_seed(tmp_path):
    for name in ("galaxy_s8_w8_s0", "galaxy_s8_w8_s1", "galaxy_s8_w9"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "config.yaml").touch()
    assert len(rows.of_all_seeds(tmp_path / "galaxy_s8_w8")) == 2
    assert rows.of_all_seeds(tmp_path / "galaxy_w9") == []
    (tmp_path / "galaxy_s8_w8_s01").mkdir()
    (tmp_path / "galaxy_s8_w8_s01" / "config.yaml").touch()
    with pytest.raises(InputError, match="has a seed twice"):
        rows.of_all_seeds(tmp_path / "galaxy_s8_w8")


def test_refusals(runs):
    def refused(*words, **options):
        with pytest.raises(InputError) as error:
            comparison.compare(CompareConfig(tuple(f"{runs}/{word}" for word in words), **options))
        return str(error.value)

    assert "needs two or more" in refused("plain")
    assert "is not there" in refused("plain", "gone")
    assert "no row has 'nis'; there are: ate, rpe_1s" in refused("plain", "new", metrics=("nis",))
    assert "no metric 'new'; name RUNS before it" in refused("plain", metrics=("ate", "new"))
    assert "plain_s1: is named twice" in refused("plain", "plain_s1")
    assert "new_s0: is named twice" in refused("new", "new")
    write(runs / "seen", {"a": 1.0}, split="seen")
    seen = "seen/eval/oxiod_test_ekf"
    assert "is of split seen, the first row of test; give --split seen" in refused("plain", seen)
    assert "plain_s0: is of split test, the first row of seen; give --split seen" in refused(
        seen, "plain"
    )
    other = {"a": "ann", "b": "eve", "c": "bob"}
    write(runs / "groups", {"a": 1.0, "b": 1.0}, groups=other)
    assert f"sequence b is of eve here, of ann in {runs}/plain_s0/" in refused("plain", "groups")
    for name, seconds in (("short", 60.0), ("long", 100.0)):
        write(runs / name, {"a": 1.0}, more={"duration": seconds})
    assert f"sequence a takes 100 s here, 60 s in {runs}/short/" in refused("short", "long")
    for seed, seconds in enumerate((60.0, 600.0)):
        write(runs / f"mix_s{seed}", {"a": 1.0}, more={"duration": seconds})
    assert "mix_s1/eval/oxiod_test_ekf: sequence a takes 600 s here" in refused("mix", "new")
    (runs / "linked_s0").symlink_to(runs / "new_s0")
    (runs / "linked_s1").symlink_to(runs / "new_s0")
    assert "linked_s1: is the same evaluation as" in refused("linked", "plain")
    assert "is the same evaluation as" in refused("new_s0", "new_s0/eval/oxiod_test_ekf")
    se3 = write(runs / "new_s0", {"a": 0.5}, "oxiod_test_ekf_se3-alignment", alignment="se3")
    assert "is of alignment se3, the first row of origin" in refused(
        "plain", str(se3.relative_to(runs))
    )
    (runs / "untrained").mkdir()
    (runs / "untrained" / "config.yaml").write_text("dataset: oxiod\n")
    assert "checkpoints/best: holds no checkpoint" in refused("untrained", "plain")
    old = "old/eval/oxiod_test_ekf"
    write(runs / "old", {"a": 1.0}, definitions=1)
    assert "another version" in refused("plain", old)
    write(runs / "gone", {"a": 1.0}, checkpoint="best", step=6)
    assert "of a checkpoint that the run has no more" in refused(
        "plain", "gone/eval/oxiod_test_ekf"
    )
    (runs / "new_s0" / "eval" / "oxiod_test_ekf" / "metrics.json").write_text("[]")
    assert "is not a metrics.json" in refused("plain", "new_s0/eval/oxiod_test_ekf")
    assert "names no metric" in refused("plain", "new", metrics=())
    assert "neither a run nor an evaluation" in refused("plain", "new_s0/eval")
    (runs / "plain_s1" / "eval" / "oxiod_test_ekf").rename(runs / "elsewhere")
    assert "is there for 1 of 2 seeds; missing: " in refused("seen", "plain/eval/oxiod_test_ekf")


def test_the_command_shows_and_writes(runs, capsys):
    out = runs / "results" / "both"
    words = [f"{runs}/plain", f"{runs}/new", "--metrics", "ate", "rpe_1s", "--out", str(out)]
    app.main(["compare", *words])
    shown = capsys.readouterr().out
    assert "-1.00 (-17.94 to +15.94)" in shown and str(out) in shown
    table = list(csv.DictReader((out.parent / "both.csv").open(encoding="utf-8")))
    assert [(line["metric"], line["row"]) for line in table] == [
        ("ate", "plain"),
        ("ate", "new"),
        ("rpe_1s", "plain"),
        ("rpe_1s", "new"),
    ]
    assert float(table[1]["difference"]) == pytest.approx(-1.0) and table[0]["difference"] == ""
    assert float(table[0]["std"]) == pytest.approx(np.std([8 / 3, 4.0], ddof=1))
    assert "| ATE (m) | plain | 3.33 ± 0.94 |" in (out.parent / "both.md").read_text("utf-8")
    assert (out.parent / "both.png").read_bytes().startswith(b"\x89PNG")


def test_errors_are_infinite_where_the_estimate_diverged(tmp_path):
    folder = write(tmp_path, {"a": math.inf, "b": 2.0})
    made = json.loads((folder / "metrics.json").read_text())
    found = pairs.errors([made], "rpe_1s")
    assert {name: list(values) for name, values in found.items()} == {"a": [math.inf], "b": [0.2]}


@pytest.mark.parametrize("out", [".", "..", "results/", "", "c", "x.md", "a_file/x", "y" * 248])
def test_a_name_that_cannot_be_written_is_told_first(runs, out, monkeypatch, capsys):
    monkeypatch.chdir(runs)
    (runs / "c.csv").mkdir()
    (runs / "a_file").touch()
    before = sorted(runs.iterdir())
    with pytest.raises(SystemExit) as left:
        app.main(["compare", "plain", "new", "--out", out])
    assert left.value.code == 2 and sorted(runs.iterdir()) == before
    said = capsys.readouterr()
    assert not said.out and len(said.err.splitlines()) == 1


def test_options_of_the_filter_that_differ_are_told(runs):
    """Not where no filter runs."""
    for name, gravity, density in (("here", 9.8, 1), ("there", 9.7, 1.0)):
        options = {"gravity": gravity, "accel_density": density}
        write(runs / name, {"a": 1.0}, "own", filter=options)
        write(runs / name, {"a": 1.0}, "kept", filter=options, estimator="integrate")
    folders = (f"{runs}/here/eval/own", f"{runs}/there/eval/own")
    found = comparison.compare(CompareConfig(folders))
    assert text.filter_options(found) == ["gravity"]
    assert "The rows differ in options of the filter: gravity." in text.explanations(found)
    folders = (f"{runs}/here/eval/kept", f"{runs}/there/eval/kept")
    assert text.filter_options(comparison.compare(CompareConfig(folders))) == []


def test_an_evaluation_may_be_named_from_inside(runs, monkeypatch):
    write(runs / "new_s0", {"a": 1.0, "b": 3.0, "c": 3.0}, "oxiod_test_ekf_loose")
    monkeypatch.chdir(runs / "new_s0" / "eval")
    found = comparison.compare(CompareConfig(("oxiod_test_ekf", "oxiod_test_ekf_loose")))
    assert [row.runs for row in found.rows] == [["new_s0"], ["new_s0"]]


@pytest.mark.parametrize(
    ("where", "value"),
    [
        (("sequences", "a", "undefined"), ["x"]),
        (("sequences", "a", "undefined"), ""),
        (("sequences", "a", "undefined"), {"ate": 5}),
        (("sequences", "a", "group"), None),
        (("sequences", "a", "ate"), 10**400),
        (("sequences", "a", "ate"), math.inf),
        (("mean", "diverged"), None),
        (("mean", "diverged"), "1"),
        (("mean", "diverged"), 0.5),
        (("settings", "checkpoint"), 5),
        (("settings", "filter"), 5),
        (("sequences",), {}),
        (("sequences",), [[1]]),
    ],
)
def test_a_damaged_evaluation_is_refused(runs, where, value):
    path = runs / "new_s0" / "eval" / "oxiod_test_ekf" / "metrics.json"
    found = inner = json.loads(path.read_text())
    for name in where[:-1]:
        inner = inner[name]
    inner[where[-1]] = value
    path.write_text(json.dumps(found))
    with pytest.raises(InputError, match=r"is not a metrics\.json of an evaluation"):
        comparison.compare(CompareConfig((f"{runs}/plain", str(path.parent))))
    for broken in ("[" * 100_000, "nothing"):
        path.write_text(broken)
        with pytest.raises(InputError, match=r"is not a metrics\.json of an evaluation"):
            figures.of_evaluation(path.parent)
    path.unlink()
    path.symlink_to(path)
    assert figures._read(path) is None
