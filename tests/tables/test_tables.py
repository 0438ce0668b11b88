"""The tables: what they vary, their statistics by hand, and one made from nothing to its pictures,
then again without training."""

import csv
import dataclasses
import json

import numpy as np
import pytest
import yaml
from rich.console import Console

from gnio_jax import config as configuration
from gnio_jax import models
from gnio_jax.commands import tables as commands
from gnio_jax.config import DataConfig, ModelConfig, OptimConfig, TrainConfig
from gnio_jax.evaluation import report
from gnio_jax.evaluation.metrics import Trajectory
from gnio_jax.tables import complexity, experiments, matrix, pictures, summary, windows
from gnio_jax.tables.experiments import Cell, Experiment
from gnio_jax.tables.matrix import Result
from gnio_jax.training import loop
from gnio_jax.training.checkpoint import create_model
from gnio_jax.types import InputError
from tests.support.tlio_files import write_sequence

BASE = TrainConfig(dataset="tlio", model=ModelConfig(width=4), optim=OptimConfig(epochs=40))


LOST = np.inf
"""An `ate` of an estimate that diverged."""


def result(name, ate, published=None, groups=None):
    """`ate`: (seeds, sequences); the other metrics are the same number. `groups`: of each sequence,
    else each is one."""
    lost = {"ate": None, "undefined": {"ate": "the estimate is not finite from 2.0 s on"}}
    figures = []
    for row in ate:
        sequences = {
            f"s{k}": {"ate": value} if np.isfinite(value) else dict(lost)
            for k, value in enumerate(row)
        }
        for sequence, group in zip(sequences.values(), groups or sequences, strict=True):
            sequence["group"] = group
        finite = [value for value in row if np.isfinite(value)]
        mean = float(np.mean(finite)) if finite else None
        means = {"ate": mean, "rpe_1s": mean, "stationary_drift": None}
        figures.append({"sequences": sequences, "mean": means})
    return Result(Cell(name, name.upper(), BASE, published), figures, [])


def compared(first, second):
    """The rows of a table of two results, and its text."""
    experiment = Experiment("Title", "source", [first.cell, second.cell])
    found = summary.rows(experiment, [first, second])
    return *found, summary.markdown(experiment, found, [])


def test_statistics_by_hand():
    first = result("a", [[1.0, 2.0, 6.0], [3.0, 2.0, 4.0]], 2.4)
    second = result("b", [[1.0, 1.0, 1.0], [2.0, 2.0, 2.0]], 1.8)
    experiment = Experiment("Title", "source", [first.cell, second.cell])
    one, two = summary.rows(experiment, [first, second], {"b": {"more": 0.5}})
    assert (
        one.seeds["ate"] == [3.0, 3.0]
        and one.gain == 0
        and one.difference == 0
        and one.interval is None
    )
    assert (
        two.gain == pytest.approx(50.0)
        and two.difference == pytest.approx(-1.5)
        and two.published_gain == pytest.approx(25.0)
    )
    assert "stationary_drift" not in one.seeds
    # Differences of the sequences: −0.5, −0.5, −3.5. Of 27 equally likely draws of three, the
    # mean's extremes have 1/27 (3.7 %) and 8/27.
    assert two.interval == pytest.approx((-3.5, -0.5))
    text = summary.markdown(experiment, [one, two], ["a note"])
    assert (
        "| B | 1.50 ± 0.71 | 1.50 | 1.50 ± 0.71 | 0.5 | ↓ 50.0 % | -1.50 (-3.50 to -0.50) "
        "| 1.80 | ↓ 25.0 % |"
    ) in text
    assert "| A | 3.00 ± 0.00 | 2.50 | 3.00 ± 0.00 | – |  |  | 2.40 |  |" in text
    assert "a note" in text
    assert "diverge" not in text and "†" not in text


def test_only_sequences_that_all_seeds_measured_count():
    whole = result("a", [[1.0, 2.0], [3.0, 4.0]])
    whole.figures[1]["sequences"]["s0"]["ate"] = None
    assert {name: list(ates) for name, ates in summary.errors(whole).items()} == {"s1": [2.0, 4.0]}


def test_sequences_are_paired_by_name():
    """The second row lacks a sequence and has another: what both have is compared, in any order."""
    first, second = result("a", [[9.0, 2.0, 4.0]]), result("b", [[9.0, 1.0, 2.0]])
    second.figures[0]["sequences"] = {
        name: {"ate": ate, "group": name} for name, ate in [("s9", 50.0), ("s2", 2.0), ("s1", 1.0)]
    }
    *_, row, text = compared(first, second)
    assert (row.compared, row.sequences) == (2, 4)
    assert row.difference == pytest.approx(-1.5) and row.gain == pytest.approx(50.0)
    assert row.interval == pytest.approx((-2.0, -1.0))
    assert "↓ 50.0 % | -1.50 (-2.00 to -1.00) over 2 of 4 |" in text
    second.figures[0]["sequences"] = {"other": {"ate": 1.0, "group": "other"}}
    *_, row, text = compared(first, second)
    assert (row.gain, row.difference, row.interval) == (None, None, None)
    assert "| 4.00 | – | – | – |" in text


def test_rows_that_diverged_in_other_sequences_are_no_better_than_each_other():
    """Equal errors in every sequence that both finished."""
    first, second = result("a", [[LOST, 2.0, 9.0, 4.0]]), result("b", [[1.0, 2.0, LOST, 4.0]])
    for pair in ((first, second), (second, first)):
        one, two, text = compared(*pair)
        assert (one.diverged, two.diverged, two.estimates) == (1, 1, 4)
        assert (two.compared, two.sequences) == (2, 4)
        assert two.gain == 0 and two.difference == 0 and two.interval == (0, 0)
        assert "| 1 of 4 | 0 % | +0.00 (+0.00 to +0.00) over 2 of 4 |" in text
        assert "† Over the estimates that did not diverge" in text


@pytest.mark.parametrize("seeds", [1, 3])
@pytest.mark.parametrize("share", [1.0, 0.5])
def test_a_row_is_never_better_for_having_diverged(seeds, share):
    """Its hardest sequence diverges with one seed; its other errors are as small or smaller."""
    ates = np.array([1.0, 2.0, 3.0, 40.0])
    wrong = np.tile(share * ates, (seeds, 1))
    wrong[0, 3] = LOST
    first = result("a", [list(ates)] * seeds)
    _, row, text = compared(first, result("b", wrong.tolist()))
    assert row.diverged == 1 and row.estimates == 4 * seeds
    assert row.gain == (0 if share == 1 else None) and "↓" not in text
    cells = "0 % | +0.00 (+0.00 to +0.00) over 3 of 4" if share == 1 else "– | –"
    assert f"| 1 of {4 * seeds} | {cells} |" in text and row.compared == 3
    assert (row.difference, row.interval) == ((0, (0, 0)) if share == 1 else (None, None))
    whole, back, _ = compared(result("b", wrong.tolist()), first)  # the other way about it may lose
    assert (whole.diverged, back.diverged) == (1, 0)
    assert back.gain == pytest.approx(100 * (1 - 1 / share))
    assert back.difference == pytest.approx((1 - share) * 2)


def test_the_median_is_infinite_where_half_diverged():
    first = result("a", [[1.0, 2.0], [3.0, 5.0]])
    for ates, median, cells in [
        ([[1.0, 2.0], [3.0, LOST]], 2.5, "| B | 2.25 ± 1.06 † | 2.50 |"),
        ([[1.0, LOST], [3.0, LOST]], np.inf, "| B | 2.00 ± 1.41 † | ∞ |"),
        # A seed without any has no mean to spread.
        ([[LOST, LOST], [1.0, 1.0]], np.inf, "| B | – | ∞ | – | 2 of 4 | – | – |"),
        ([[LOST, LOST], [LOST, LOST]], np.inf, "| B | – | ∞ | – | 4 of 4 | – | – |"),
    ]:
        _, row, text = compared(first, result("b", ates))
        assert row.median == median and cells in text


def test_intervals_draw_groups():
    """Two sessions of three walks: a draw is one session twice or both, whatever their walks."""

    def row_and_text(first_groups, second_groups):
        first = result("a", [[5.0] * 6], groups=first_groups)
        second = result("b", [[4.0, 4.1, 4.2, 2.0, 2.1, 2.2]], groups=second_groups)
        return compared(first, second)[1:]

    row, text = row_and_text("xxxyyy", "xxxyyy")
    assert row.groups == 2 and row.interval == pytest.approx((-2.9, -0.9))
    assert "there are 2." in text
    row, text = row_and_text("xxxxxx", "xxxxxx")
    assert row.groups == 1 and row.interval is None
    assert "↓ 38.0 % | -1.90 | –" in text and "interval draws" not in text
    alone, _ = row_and_text("abcdef", "abcdef")
    assert alone.groups == 6 and -2.9 < alone.interval[0] < alone.interval[1] < -0.9


@pytest.mark.parametrize(
    "definitions, group, step, kept",
    [
        (report.DEFINITIONS, True, 7, True),
        (1, True, 7, False),
        (report.DEFINITIONS + 1, True, 7, False),
        (None, True, 7, report.DEFINITIONS == 2),
        (None, False, 7, False),
        (report.DEFINITIONS, True, 6, False),
    ],
)
def test_figures_of_other_definitions_or_steps_are_made_anew(
    tmp_path, monkeypatch, definitions, group, step, kept
):
    configuration.save(tmp_path / "config.yaml", BASE)
    (tmp_path / "checkpoints" / "best" / "7").mkdir(parents=True)
    path = tmp_path / "eval" / "tlio_test_ekf" / "metrics.json"
    path.parent.mkdir(parents=True)
    settings = {"step": step} | ({} if definitions is None else {"definitions": definitions})
    sequences = {
        "a": {"ate": 1.0, "group": "x"},
        "b": {"ate": 1.0} | ({"group": "y"} if group else {}),
    }
    path.write_text(json.dumps({"settings": settings, "sequences": sequences}))
    monkeypatch.setattr(matrix.evaluation, "evaluate", lambda config, **_: path.write_text("{}"))
    found = matrix.evaluated(tmp_path, "test", "ekf", Console(quiet=True))
    assert (found != {}) == kept


def test_divergence_is_in_the_files_and_the_picture(tmp_path):
    first = result("a", [[1.0, 2.0, 4.0]], groups="xyz")
    second = result("b", [[LOST, LOST, 8.0]], groups="xyz")
    third = result("c", [[LOST, LOST, LOST]], groups="xyz")
    fourth = result("d", [[0.5, 1.0, LOST]], groups="xyz")
    results = [first, second, third, fourth]
    experiment = Experiment("Title", "source", [each.cell for each in results])
    found = summary.rows(experiment, results)
    summary.write(tmp_path / "table", experiment, found, [])
    with open(tmp_path / "table.csv", newline="", encoding="utf-8") as file:
        one, two, three, four = csv.DictReader(file)
    assert (one["ate_median"], one["diverged"], one["estimates"]) == ("2.0", "0", "3")
    assert (two["ate"], two["ate_median"], two["diverged"]) == ("8.0", "inf", "2")
    assert (two["compared"], two["sequences"], two["groups"]) == ("1", "3", "1")
    assert float(two["gain_percent"]) == -100
    assert (two["difference"], two["difference_low"]) == ("4.0", "")
    assert (three["ate"], three["gain_percent"], three["difference"]) == ("", "", "")
    assert three["diverged"] == "3"
    withheld = ("gain_percent", "difference", "difference_low", "difference_high")
    assert [four[name] for name in withheld] == [""] * 4 and four["compared"] == "2"
    axes = pictures.table(experiment, results[:3], found[:3]).axes[0]
    labels = [label.get_text() for label in axes.get_yticklabels()]
    assert labels == ["A", "B\n(2 of 3 diverged)", "C\n(3 of 3 diverged)"]
    assert [bar.get_width() for bar in axes.patches] == [pytest.approx(7 / 3), 8.0, 0.0]


def test_paths_end_where_the_estimate_diverged(tmp_path):
    configuration.save(tmp_path / "config.yaml", BASE)
    time = np.arange(50) * 0.1
    position, level = np.column_stack([time, np.zeros((50, 2))]), np.tile([1.0, 0, 0, 0], (50, 1))
    seen, moved = position.copy(), position + np.array([3.0, 2.0, 1.0])
    seen[10:15] = np.nan
    moved[30:] = np.nan
    folder = tmp_path / "eval" / "tlio_test_ekf"
    for kind, path in (("references", seen), ("trajectories", moved)):
        (folder / kind).mkdir(parents=True)
        report.write_tum(folder / kind / "walk.txt", Trajectory(time, path, level))
    made = Result(Cell("a", "A", BASE), [{"sequences": {"walk": {}}}], [tmp_path])
    ((reference, estimate),) = matrix.paths(made, "test", "ekf").values()
    kept = np.r_[0:10, 15:50]
    np.testing.assert_allclose(reference, position[kept, :2], atol=1e-8)
    expected = np.where(kept[:, None] < 30, position[kept, :2], np.nan)
    np.testing.assert_allclose(estimate, expected, atol=1e-8)


def test_arrows_point_as_the_error_goes():
    assert [summary.arrow(x) for x in (12.34, -5.0, 0.01, None)] == [
        "↓ 12.3 %",
        "↑ 5.0 %",
        "0 %",
        "",
    ]


@pytest.mark.parametrize(
    "make",
    [
        experiments.components,
        experiments.gates,
        experiments.bank_sizes,
        experiments.bank_spread,
        lambda base: experiments.comparison(base, "test"),
    ],
)
def test_rows_differ_in_the_network_alone(make):
    """Every row can be built, two are never the same, those of a name are; loss and regularisation
    apart, only the network differs. Every checkpoint is chosen by one criterion."""
    seen = {}
    for cell in make(BASE).cells:
        assert create_model(cell.config) is not None
        assert seen.setdefault(cell.name, cell.config) == cell.config
        optim = dataclasses.replace(
            cell.config.optim, clip_norm=BASE.optim.clip_norm, weight_decay=BASE.optim.weight_decay
        )
        assert optim.best_by == "squared_error"
        same = dataclasses.replace(
            BASE, optim=dataclasses.replace(BASE.optim, best_by="squared_error")
        )
        assert (
            dataclasses.replace(cell.config, model=BASE.model, loss=BASE.loss, optim=optim) == same
        )
        assert cell.config.model.name != "gnio" or (cell.config.loss, cell.config.optim) == (
            same.loss,
            same.optim,
        )
    assert len(set(map(str, seen.values()))) == len(seen)


def test_remedies_change_the_uncertainty_alone():
    """The constant comes from the validation split: the heads beside it are calibrated there too,
    but for the published one."""
    constant, calibrated, likelihood, published = (
        cell.config for cell in experiments.remedies(BASE).cells
    )
    assert [c.model.uncertainty for c in (constant, calibrated, likelihood)] == [
        "constant",
        "calibrated",
        "calibrated",
    ]
    assert create_model(published).uncertainty == "head"
    assert (published.loss.nll_weight, likelihood.loss.nll_weight) == (1e-4, 1.0)
    assert dataclasses.replace(likelihood, loss=published.loss) == calibrated
    for row in (constant, calibrated):
        assert create_model(row) is not None
        assert dataclasses.replace(row, model=published.model) == published


@pytest.mark.parametrize(
    "epochs, batch, held",
    [(200, 128, 10), (200, 1024, 10), (24, 1024, 10), (24, 128, 1.25), (8, 1024, 4), (2, 512, 1)],
)
def test_tlio_is_held_for_the_published_steps_or_half_of_the_run(epochs, batch, held):
    base = dataclasses.replace(
        BASE, optim=dataclasses.replace(BASE.optim, epochs=epochs, batch_size=batch)
    )
    assert experiments.method("tlio", base).loss.log_std_from_epoch == held


def test_cells_of_one_name_are_one_run_in_every_table():
    tables = [
        make(BASE)
        for make in (
            experiments.components,
            experiments.gates,
            experiments.bank_sizes,
            experiments.bank_spread,
            experiments.remedies,
        )
    ]
    made = [
        cell for table in (*tables, experiments.comparison(BASE, "test")) for cell in table.cells
    ]
    by_name = {}
    for cell in made:
        assert by_name.setdefault(cell.name, cell.config) == cell.config
    assert len(by_name) < len(made)


def test_rows_are_the_published_configurations():
    gates = {cell.label: cell.config.model for cell in experiments.gates(BASE).cells}
    assert (
        all(model.bank_size == 0 for model in gates.values()) and gates["tanh × exp"].scale == "exp"
    )
    banks = {cell.label: cell.config.model for cell in experiments.bank_sizes(BASE).cells}
    assert all(model.head == "linear" for model in banks.values())
    assert [create_model(cell.config).bank_size for cell in experiments.bank_sizes(BASE).cells] == [
        0,
        16,
        32,
        64,
        128,
    ]
    parts = [
        (cell.config.model.name, cell.published) for cell in experiments.components(BASE).cells
    ]
    assert parts == [("tlio", 2.40), ("gnio", None), ("gnio", 1.98), ("gnio", 1.84), ("gnio", 1.66)]


@pytest.mark.parametrize("network", [*experiments.METHODS, "imot_text"])
def test_losses_and_regularisation_are_those_of_the_published_recipes(network):
    row = experiments.method(network, BASE)
    budget = dataclasses.replace(
        row.optim,
        clip_norm=BASE.optim.clip_norm,
        weight_decay=BASE.optim.weight_decay,
        best_by="loss",
    )
    assert budget == BASE.optim and (row.data, row.augment) == (BASE.data, BASE.augment)
    if network == "gnio":
        assert row.loss is BASE.loss and row.optim == dataclasses.replace(
            BASE.optim, best_by="squared_error"
        )
        return
    recipe = configuration.validate(configuration.load(f"configs/baselines/{network}.yaml"))
    assert recipe.model.name == network
    published = dataclasses.replace(BASE, optim=dataclasses.replace(BASE.optim, epochs=200))
    assert experiments.loss(network, published) == recipe.loss
    assert (row.optim.clip_norm, row.optim.weight_decay) == (
        recipe.optim.clip_norm,
        recipe.optim.weight_decay,
    )
    assert create_model(recipe) is not None


# Windows by activity
# --------------------------------------------------------------------------------------------------


def test_activities_by_speed():
    truth = np.array(
        [[0.01, 0, 0], [0.3, 0.4, 0], [1.3, 0, 0.02], [0, 2.5, 0], [0.4, 0, 0.3], [0, 0, 0.08]]
    )
    names = [windows.ACTIVITIES[k] for k in windows.activity(truth, 1.0)]
    assert names == ["standing", "slow", "walking", "running", "stairs", "slow"]
    assert [windows.ACTIVITIES[k] for k in windows.activity(truth, 2.0)[[1, 3]]] == [
        "slow",
        "walking",
    ]  # the same way in twice the time


def test_figures_of_windows_by_hand():
    attention = np.array([[[1.0, 0.0], [0.5, 0.5]], [[0.0, 1.0], [0.5, 0.5]]])
    said = windows.Said(
        np.zeros((2, 3)),
        np.array([[0.3, 0, 0.4], [0.0, 0.1, 0]]),
        np.full((2, 3), np.log(0.1)),
        {"gate": np.array([[-0.2, 0.4, 9.0], [1.0, 1.0, 9.0]]), "attention": attention},
        np.array([0, 2]),
    )
    found = windows.by_activity(said)
    assert set(found) == {"standing", "walking"}
    assert found["standing"]["error"] == pytest.approx(0.5) and found["standing"][
        "gate"
    ] == pytest.approx(0.3)
    assert found["standing"]["normalised"] == pytest.approx(np.sqrt((9 + 16) / 3)) and found[
        "walking"
    ]["length"] == pytest.approx(0.1)
    # First head certain and different, second undecided: half the entropy in a window, all of it in
    # their mean.
    assert windows.entropy(attention) == pytest.approx((0.5, 1.0))


def test_information_of_prototypes():
    rng = np.random.default_rng(0)
    activity = rng.integers(0, 4, 4000)
    attention = np.full((4000, 2, 8), 0.05)
    attention[np.arange(4000), :, activity] = 0.65
    said = windows.Said(*[np.zeros((4000, 3))] * 3, {"attention": attention}, activity)
    told, chance = windows.information(said)
    assert (
        told == pytest.approx(2.0, abs=0.01) and chance < 0.01
    )  # four equally frequent activities: two bits
    names, lifts = windows.attention_by_activity(said)
    assert names == ["standing", "slow", "walking", "running"]
    np.testing.assert_array_equal(lifts.argmax(1), [0, 1, 2, 3])
    np.testing.assert_allclose(lifts[:, 4:], 1.0)


# Complexity
# -----------------------------------------------------------------------------------------------------------


def multiply_adds(convolutions, dense, padding):
    """By hand: every output of a convolution costs its kernel, with or without its taps in the
    padding, every dense layer its matrix."""
    total = sum(i * o for i, o in dense)
    for length, stride, size, i, o in convolutions:
        for output in range(-(-length // stride)):
            first = output * stride - size // 2
            total += sum(padding or 0 <= first + tap < length for tap in range(size)) * i * o
    return total


def encoder():
    """(length of the input, stride, kernel, channels in, out) of each convolution, for 200 samples."""
    layers, before, length = [(200, 2, 7, 6, 64)], 64, 50
    for group, width in enumerate((64, 128, 256, 512)):
        stride = 2 if group else 1
        layers.append((length, stride, 3, before, width))
        if group:
            layers.append((length, stride, 1, before, width))
        length = -(-length // stride)
        layers += [(length, 1, 3, width, width)] * 3
        before = width
    return layers


HEADS = {
    "tlio": ([(7, 1, 1, 512, 128)] * 2, [(896, 512), (512, 512), (512, 3)] * 2),
    "gnio": ([], [(512, 512), (512, 64), (512, 64), (512, 512), *[(512, 3)] * 3]),
}


@pytest.mark.parametrize(
    "network, parameters, published", [("tlio", 5_424_646, 39.15e6), ("gnio", 4_934_153, 37.4e6)]
)
def test_complexity_against_a_hand_count(network, parameters, published):
    convolutions, dense = HEADS[network]
    assert multiply_adds([*encoder(), *convolutions], dense, padding=True) == pytest.approx(
        published, rel=2e-3
    )
    by_hand = multiply_adds([*encoder(), *convolutions], dense, padding=False)
    found = complexity.measure(network, batches=(1,), seconds=0.05)
    assert found.parameters == parameters
    assert 1e9 * found.gflops == pytest.approx(
        2 * by_hand, rel=0.02
    )  # additions, ReLUs and the like besides
    assert found.latency[1] > 0
    assert network in complexity.markdown([found], "a machine")


# From nothing to the pictures
# -----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder with recordings, a base config and the arguments that all tables share."""
    root = tmp_path_factory.mktemp("tables")
    for name in "abc":
        write_sequence(root / "data" / name)
    for split, names in [("train", "a\nb\n"), ("val", "c\n"), ("test", "b\nc\n")]:
        (root / "data" / f"{split}_list.txt").write_text(names)
    base = TrainConfig(
        dataset="tlio",
        data=DataConfig(rate=50.0),
        model=ModelConfig(width=2, bank_size=3, bank_heads=2),
        optim=OptimConfig(epochs=2, batch_size=16, learning_rate=1e-3),
    )
    configuration.save(root / "base.yaml", base)
    return root, [
        "--base",
        str(root / "base.yaml"),
        "--data-root",
        str(root / "data"),
        "--out",
        str(root / "out"),
        "--seeds",
        "2",
        "--methods",
        "gnio",
        "--split",
        "test",
        "--estimator",
        "integrate",
    ]


def test_a_table_from_nothing_and_again_without_training(made, monkeypatch, capsys):
    root, arguments = made
    commands.main(["comparison", *arguments])
    text = (root / "out" / "comparison_test_integrate.md").read_text(encoding="utf-8")
    assert "2 seeds" in text and "| gnio |" in text and text in capsys.readouterr().out
    table = list(
        csv.DictReader((root / "out" / "comparison_test_integrate.csv").open(encoding="utf-8"))
    )
    seeds = [
        json.loads(
            (
                root
                / "out"
                / "runs"
                / f"gnio_s{seed}"
                / "eval"
                / "tlio_test_integrate"
                / "metrics.json"
            ).read_text()
        )
        for seed in range(2)
    ]
    assert float(table[0]["ate"]) == pytest.approx(np.mean([seed["mean"]["ate"] for seed in seeds]))
    assert float(table[0]["ate_std"]) == pytest.approx(
        np.std([seed["mean"]["ate"] for seed in seeds], ddof=1)
    )
    assert seeds[0]["mean"]["ate"] != seeds[1]["mean"]["ate"]
    assert (root / "out" / "comparison_test_integrate.png").read_bytes()[:4] == b"\x89PNG"

    def never(*_, **__):
        raise AssertionError("done already")

    monkeypatch.setattr(loop, "train", never)
    monkeypatch.setattr(matrix.evaluation, "evaluate", never)
    (root / "out" / "comparison_test_integrate.md").unlink()
    commands.main(["comparison", *arguments])
    assert (root / "out" / "comparison_test_integrate.md").read_text(encoding="utf-8") == text
    commands.main(["standing", *arguments])
    text = (root / "out" / "standing_test_integrate.md").read_text(encoding="utf-8")
    assert "most attended prototype tells" in text and "| gnio | walking |" in text
    commands.main(["trajectories", *arguments, "--sequences", "c"])
    for name in (
        "standing_test_integrate",
        "standing_test_integrate_gnio_gate",
        "standing_test_integrate_gnio_attention",
        "trajectories_test_integrate",
    ):
        assert (root / "out" / f"{name}.png").read_bytes()[:4] == b"\x89PNG", name
    with pytest.raises(InputError, match="no sequence 'x' in split 'test'; there are: b, c"):
        commands.main(["trajectories", *arguments, "--sequences", "x"])
    changed = yaml.safe_load((root / "base.yaml").read_text())
    changed["optim"]["learning_rate"] = 2e-3
    (root / "other.yaml").write_text(yaml.safe_dump(changed))
    with pytest.raises(InputError, match=r"'optim' was .* and is now"):
        commands.main(["comparison", *arguments, "--base", str(root / "other.yaml")])


def test_a_signal_ends_the_table_and_says_how_to_go_on(made, monkeypatch, capsys):
    root, arguments = made
    monkeypatch.setattr(loop, "train", lambda config, *_, **__: loop.Outcome(root, None, 15))
    with pytest.raises(SystemExit) as left:
        commands.main(["gates", *arguments, "--out", str(root / "elsewhere")])
    assert left.value.code == 128 + 15 and "goes on from here" in capsys.readouterr().err


@pytest.mark.parametrize(
    "more, words",
    [
        (["--seeds", "0"], "--seeds: must be at least 1"),
        (["--methods", "gnio,nosuch"], "no network 'nosuch'; known: ctin"),
        (["--methods", " , "], "names no network"),
        (["--base", "nosuch.yaml"], "no such config file"),
        (["--base", "configs/baselines/tlio.yaml"], "is of the network 'tlio'"),
    ],
)
def test_mistakes_are_named(made, more, words):
    with pytest.raises(InputError, match=words):
        commands.main(["comparison", *made[1], *more])


def test_every_network_has_a_colour_and_a_place_in_the_tables():
    assert set(complexity.NETWORKS) == set(models.names())
