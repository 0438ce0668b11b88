"""Runs of a tiny network on a tiny recording: what is logged, resumed, refused, warned of."""

import dataclasses
import shutil
import signal
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml

from gnio_jax import config as configuration
from gnio_jax import data
from gnio_jax.config import LossConfig, OptimConfig
from gnio_jax.errors import InputError
from gnio_jax.networks import read_network
from gnio_jax.training import checkpoint, loop, optimizer, run_folder, task, window_task
from gnio_jax.training.losses import Losses
from gnio_jax.training.recordings import TrainingData
from gnio_jax.training.window_task import WindowTask
from tests.support.drawn_state import fresh_state
from tests.support.tiny_network import Tiny
from tests.support.tiny_run import (
    STEPS,
    arrays,
    assert_same_runs,
    config,
    mean_square_error,
    rows,
    same,
    stopped_at,
)


def test_a_run_leaves_its_config_log_events_and_checkpoints(recording, finished):
    workdir, outcome = finished
    assert configuration.load(workdir / "config.yaml") == config(recording, workdir)
    log_rows = rows(workdir)
    assert [row["epoch"] for row in log_rows] == [0, 1, 2]
    count = 2 * len(range(0, 600 - 50, 5))  # a window of 1 s every 0.1 s, two recordings
    assert [row["step"] for row in log_rows] == [count // 16 * k for k in (1, 2, 3)]
    assert outcome.best_loss == min(row["val_loss"] for row in log_rows)
    assert log_rows[-1]["loss"] < log_rows[0]["loss"]
    total = 100 * log_rows[-1]["mse"] + 1e-4 * log_rows[-1]["nll"]
    assert log_rows[-1]["loss"] == pytest.approx(total, rel=1e-5)
    splits = yaml.safe_load((workdir / "splits.yaml").read_text())
    assert {split: list(names) for split, names in splits.items()} == {
        "train": ["a", "b"],
        "val": ["c"],
    }
    assert list((workdir / "tensorboard").glob("events*"))
    best = min(log_rows, key=lambda row: row["val_loss"])
    assert read_network(workdir).step == best["step"]
    assert checkpoint.load_latest(workdir).step == log_rows[-1]["step"]


def test_validation_is_the_plain_mean_over_every_window(recording, finished):
    (walk,) = data.load("tlio", recording, "val")
    error = mean_square_error(checkpoint.load_latest(finished[0]), walk)
    assert rows(finished[0])[-1]["val_mse"] == pytest.approx(error, rel=1e-4)


def test_stopped_and_killed_and_resumed_gives_the_same_bits(
    recording, finished, tmp_path, monkeypatch
):
    """One run that ends within an epoch, at its end, between the checkpoint and the weights of the
    second epoch, between weights and row of the log, after the row, and once more within one."""
    run = config(recording, tmp_path / "run")

    def stop(step, resume=True):
        with stopped_at(step):
            assert loop.train(run, resume=resume).stopped_by == signal.SIGTERM
        assert checkpoint.load_latest(tmp_path / "run").step == step

    def kill_after(owner, name):
        """As the process dies behind the first call."""

        def killed(*arguments):
            real(*arguments)
            raise RuntimeError("killed")

        real = getattr(owner, name)
        with monkeypatch.context() as patch, pytest.raises(RuntimeError, match="killed"):
            patch.setattr(owner, name, killed)
            loop.train(run, resume=True)

    stop(1, resume=False)
    stop(STEPS)
    for owner, name, step, count in (
        (checkpoint, "save", STEPS, 1),
        (checkpoint, "save_best", 2 * STEPS, 1),
        (run_folder.Log, "add", 2 * STEPS, 2),
    ):
        kill_after(owner, name)
        assert checkpoint.load_latest(tmp_path / "run").step == 2 * STEPS
        assert read_network(tmp_path / "run").step == step
        assert len(rows(tmp_path / "run")) == count
    stop(2 * STEPS + 4)
    assert loop.train(run, resume=True).stopped_by is None
    assert_same_runs(tmp_path / "run", finished[0])


def test_seeds_are_ordinary_runs_that_share_recordings_and_programs(
    recording, finished, tmp_path, capsys
):
    """And a signal stops the one that it meets, in whose place the command goes on."""
    jitted = task.train_steps, window_task.validate
    programs = [function._cache_size() for function in jitted]
    configs = configuration.with_seeds(config(recording, tmp_path / "run"), (3, 0))
    workdirs = [Path(run.workdir) for run in configs]
    with stopped_at(STEPS + 2):
        assert [outcome.stopped_by for outcome in loop.train_all(configs)] == [signal.SIGTERM]
    assert not workdirs[1].exists()
    with stopped_at(3 * STEPS):  # the first is complete, and a seed is missing
        outcomes = loop.train_all(configs, resume=True)
    assert [outcome.stopped_by for outcome in outcomes] == [signal.SIGTERM]
    capsys.readouterr()
    outcomes = loop.train_all(configs, resume=True)
    assert [(outcome.workdir, outcome.stopped_by) for outcome in outcomes] == [
        (w, None) for w in workdirs
    ]
    lines = capsys.readouterr().err.splitlines()
    assert sum(line.startswith("reading") for line in lines) == 1
    assert [function._cache_size() for function in jitted] == programs
    assert configuration.load(workdirs[1]) == configs[1]
    assert_same_runs(workdirs[1], finished[0])
    assert rows(workdirs[0])[-1]["val_loss"] != rows(workdirs[1])[-1]["val_loss"]


def test_a_run_is_not_resumed_with_other_recordings(recording, finished, tmp_path):
    shutil.copytree(finished[0], tmp_path / "run")
    shutil.copytree(recording, tmp_path / "data")
    run = config(tmp_path / "data", tmp_path / "run")
    before = (tmp_path / "run" / "splits.yaml").read_bytes()
    for names, problem in (
        ("b\na\n", r"splits\.yaml: .*split 'train' \(0 differ, their order does\)"),
        ("b\n", r"split 'train' \(1 differ, e\.g\. a\); resume with the same data"),
    ):
        (tmp_path / "data" / "train_list.txt").write_text(names)
        with pytest.raises(InputError, match=problem):
            loop.train(run, resume=True)
    assert (tmp_path / "run" / "splits.yaml").read_bytes() == before
    (tmp_path / "data" / "train_list.txt").write_text("a\nb\n")
    longer = yaml.safe_load(before)
    longer["train"]["b"] += 100
    (tmp_path / "run" / "splits.yaml").write_text(yaml.safe_dump(longer, sort_keys=False))
    with pytest.raises(InputError, match=r"split 'train' \(1 differ, e\.g\. b\)"):
        loop.train(run, resume=True)
    (tmp_path / "run" / "splits.yaml").write_text("{")
    with pytest.raises(InputError, match=r"splits\.yaml: cannot be read"):
        loop.train(run, resume=True)


def test_weights_without_a_checkpoint_are_not_trained_over(recording, finished, tmp_path):
    """As a calibrated run has them. A stray file is no checkpoint."""
    run = shutil.copytree(finished[0], tmp_path / "run")
    shutil.rmtree(run / "checkpoints" / "latest" / str(3 * STEPS))
    (run / "checkpoints" / "latest" / str(3 * STEPS)).touch()
    before = (run / "weights.safetensors").read_bytes()
    with pytest.raises(InputError, match=r"run: has weights, and no checkpoint .* --init-from"):
        loop.train(config(recording, run), resume=True)
    with pytest.raises(InputError, match="latest: holds no checkpoint"):
        checkpoint.load_latest(run)
    assert (run / "weights.safetensors").read_bytes() == before


def test_a_damaged_log_is_resumed_or_refused(recording, finished, tmp_path):
    """Its last line may be cut: the checkpoint has this row."""
    run = shutil.copytree(finished[0], tmp_path / "run")
    log = run / "metrics.jsonl"
    whole = log.read_bytes()
    lines = whole.splitlines(keepends=True)
    log.write_bytes(b"".join(lines[:-1]) + lines[-1][:40])
    loop.train(config(recording, run), resume=True)
    assert log.read_bytes() == whole
    for content in (b"[1]\n" + whole, whole + b"{}\n", b"{\n" + whole):
        log.write_bytes(content)
        with pytest.raises(InputError, match=r"metrics\.jsonl: line [14] is no row .*; remove"):
            loop.train(config(recording, run), resume=True)


def test_refused_before_anything_is_written(recording, finished, tmp_path):
    (tmp_path / "run").mkdir()
    shutil.copy(finished[0] / "config.yaml", tmp_path / "run")
    for folder, resume, changes, problem in (
        ("run", False, {}, "run: already holds a run; continue it with --resume"),
        ("run", True, {"seed": 5}, r"config\.yaml: 'seed' was 0 and is now 5"),
        ("run", True, {"init_from": "other"}, "'init_from' was None and is now other"),
        ("run", True, {"epochs": 9}, r"config\.yaml: 'optim\.epochs' was 3 and is now 9"),
        ("none", True, {}, "none: holds no run to resume"),
        ("none", False, {"batch_size": 999}, r"optim\.batch_size: is 999, but there are only 220"),
    ):
        experiment = config(recording, tmp_path / folder, **changes)
        with pytest.raises(InputError, match=problem):
            loop.train(experiment, resume=resume)
        assert [path.name for path in tmp_path.rglob("*")] == ["run", "config.yaml"]


@pytest.mark.parametrize(
    "loss, problem",
    [
        ({"name": "polar"}, "loss.name: is polar, which needs a length and an angle"),
        ({"name": "body_velocity"}, "loss.name: is body_velocity, which needs velocities"),
        ({"name": "bins"}, "loss.name: is bins, which needs a network with model.head: bins"),
        ({"name": "velocity_and_covariance"}, "loss.name: is velocity_and_covariance, which needs"),
        ({"balance_weight": 7.0}, "loss.balance_weight: is for networks with a router"),
        ({"preintegration_weight": 1.0}, "loss.preintegration_weight: needs a network with a corr"),
    ],
)
def test_a_loss_that_does_not_fit_the_network_is_refused_before_anything_is_written(
    recording, tmp_path, loss, problem
):
    experiment = config(recording, tmp_path / "run")
    experiment = dataclasses.replace(experiment, loss=LossConfig(**loss))
    with pytest.raises(InputError, match=problem):
        loop.train(experiment)
    assert not (tmp_path / "run").exists()


def test_the_trace_before_the_folder_is_that_of_the_steps(recording, tmp_path, monkeypatch):
    """The loss is traced once for the check and the run."""
    traces, losses = [], WindowTask.losses
    count = lambda *arguments: traces.append(1) or losses(*arguments)  # noqa: E731
    monkeypatch.setattr(WindowTask, "losses", count)
    loop.train(config(recording, tmp_path / "run", epochs=1, learning_rate=1.234e-3))
    assert len(traces) == 1


def test_two_trainings_in_one_folder(recording, tmp_path):
    """The second one is refused when both have passed the door before either has written, also
    where both resume."""
    first = config(recording, tmp_path / "run")
    recordings = TrainingData(None, {}, {"train": ["a", "b"], "val": ["c"]})

    def begin(seed):
        arguments = dataclasses.replace(first, seed=seed), recordings, {}, False
        with run_folder.open_run(*arguments):
            pass

    with run_folder.open_run(first, recordings, {}, resume=False):
        written = (tmp_path / "run" / "config.yaml").read_bytes()
        with pytest.raises(InputError, match="run: another process is training in it"):
            begin(1)
        with pytest.raises(InputError, match="run: another process is training in it"):
            loop.train(first, resume=True)
    with pytest.raises(InputError, match="run: already holds a run"):
        begin(1)
    assert (tmp_path / "run" / "config.yaml").read_bytes() == written


def no_checkpoint(run):
    shutil.rmtree(run / "checkpoints")


def wider_network(run):
    model = dataclasses.replace(configuration.load(run).model, width=5)
    wider = dataclasses.replace(configuration.load(run), model=model)
    configuration.save(run / "config.yaml", wider)


def cut_arrays(run):
    for array in (run / "checkpoints" / "latest").glob("*/variables/**/d/*"):
        array.write_bytes(array.read_bytes()[:10])


def empty_metadata(run):
    for file in (run / "checkpoints" / "latest").glob("*/meta/metadata"):
        file.write_text("{}")


@pytest.mark.parametrize(
    "change, problem",
    [
        (no_checkpoint, "latest: holds no checkpoint"),
        (wider_network, r"has shape \[.*\] in the checkpoint and \[.*\] in the conf"),
        (cut_arrays, "cannot be read"),
        (empty_metadata, f"latest/{3 * STEPS}: does not have the position of a run; .*--init-from"),
    ],
)
def test_checkpoints_that_cannot_be_loaded(finished, tmp_path, change, problem):
    run = shutil.copytree(finished[0], tmp_path / "run")
    change(run)
    with pytest.raises(InputError, match=problem):
        checkpoint.load_latest(run)


def test_a_head_that_no_gradient_reaches_is_told_of(recording, finished):
    row = rows(finished[0])[-1]
    assert not loop.stuck_layers(row)
    row |= {"gradient_norm/head/kernel": 0.0, "gradient_norm/head/bias": 0.0}
    training = WindowTask(Tiny(), config(recording, ""), STEPS)
    _, warned = loop.describe_epoch(row | {"windows_per_second": 9.0}, False, training)
    assert "no gradient reached head/bias, head/kernel in this epoch" in warned
    # Steps that Adam's ε swallows are none, and a loss that has not begun is no mistake.
    swallowed = rows(finished[0])[-1] | {"gradient_norm/head/kernel": 1e-12}
    assert loop.stuck_layers(swallowed) == ["head/kernel"]
    assert not loop.stuck_layers(swallowed | {"loss": 0.0})


def test_a_step_that_is_not_finite_leaves_the_last_good_checkpoint(
    recording, tmp_path, monkeypatch
):
    """Neither `latest` nor `best` takes the parameters that it spoils, in the last step of the
    second epoch. Its loss, of about 1e38, is finite, and the norm of its gradient is not."""
    take_steps = WindowTask.take_steps

    def spoiled(self, state, source, *arguments):
        if int(state.step) + int(arguments[2]) >= 2 * STEPS:
            source = source._replace(displacement=source.displacement + np.float32(5e17))
        return take_steps(self, state, source, *arguments)

    monkeypatch.setattr(WindowTask, "take_steps", spoiled)
    problem = rf"run: the loss or its gradient is not finite at step {2 * STEPS - 1} \(epoch 1\)"
    with stopped_at(-1), pytest.raises(FloatingPointError, match=problem):
        loop.train(config(recording, tmp_path / "run"))
    assert checkpoint.load_latest(tmp_path / "run").step == STEPS
    assert read_network(tmp_path / "run").step == STEPS
    for which in ("latest", "best"):
        assert all(np.isfinite(x).all() for x in jax.tree.leaves(arrays(tmp_path / "run", which)))


def test_two_stage_loss_without_float64(recording, tmp_path, monkeypatch):
    """Before its epoch the likelihood leaves the uncertainty's head alone. And, in the same run, as
    it takes long to compile: the step holds no float64 in a process with 64-bit types switched on,
    as the command lines switch them."""
    assert jax.config.jax_enable_x64
    texts = []

    def spy(function):
        def spying(*arguments, **options):
            texts.append(function.lower(*arguments, **options).as_text())
            return function(*arguments, **options)

        spying.eval_shape = getattr(function, "eval_shape", None)
        return spying

    monkeypatch.setattr(task, "train_steps", spy(task.train_steps))
    monkeypatch.setattr(window_task, "validate", spy(window_task.validate))
    loss = LossConfig(nll_from_epoch=99.0)
    experiment = config(recording, tmp_path / "run", epochs=1, loss=loss)
    loop.train(experiment)
    key = jax.random.split(jax.random.key(0), 3)[0]
    model = Tiny(uncertainty="calibrated")
    start = jax.tree.map(np.asarray, fresh_state(model, experiment, 1, key).variables["params"])
    trained = arrays(tmp_path / "run")[0]["params"]
    assert same(trained["uncertainty"], start["uncertainty"])
    assert not same(trained["head"], start["head"])
    assert len(texts) >= 2
    assert all("xf32>" in text and "f64" not in text for text in texts)
    assert {leaf.dtype for leaf in jax.tree.leaves(trained)} == {np.dtype("float32")}


@pytest.fixture
def counted(recording, tmp_path, monkeypatch):
    """A function that trains with these figures (loss, squared error) of validation, while only the
    steps count; it returns the outcome and the plateau's factors."""

    def train(figures, folder="run", resume=False, stop_at=0, **changes):
        pairs, factors, calls = iter(figures), [], []

        def train_steps(state, source, order, first, count, factor, *_, **__):
            factors.append(float(factor))
            sums = dict.fromkeys(("loss", "mse", "nll"), jnp.float32(0))
            return state._replace(step=state.step + count), task.DispatchSums(sums, jnp.int32(-1))

        def validate(*_, **__):
            calls.append(1)
            if len(calls) == stop_at:
                signal.raise_signal(signal.SIGTERM)
            loss, mse = next(pairs)
            one = jnp.ones(3, jnp.float32)
            means = Losses(jnp.float32(loss), jnp.float32(mse), jnp.float32(0))
            return window_task.Validation(means, one, one)

        optim = {"statistics_windows": 0, "schedule": "plateau", "epochs": len(figures)} | changes
        model = dataclasses.replace(config("", "").model, uncertainty=None)
        with monkeypatch.context() as patch:
            patch.setattr(task, "train_steps", train_steps)
            patch.setattr(WindowTask, "trace_steps", lambda *_: None)
            patch.setattr(window_task, "validate", validate)
            run = config(recording, tmp_path / folder, model=model, **optim)
            return loop.train(run, resume=resume), factors

    return train


@pytest.mark.parametrize(
    "criterion, best, epoch", [("loss", 6.0, 4), ("squared_error", 4.0, 3), ("latest", 5.0, 4)]
)
def test_the_best_checkpoint_begins_anew_where_what_is_trained_changes(
    counted, tmp_path, criterion, best, epoch
):
    """Losses before and after a switch do not compare: the first epoch's would win for ever."""
    # before, with the switch, the first whole epoch, one more
    figures = [(-100.0, 1.0), (-50.0, 2.0), (7.0, 4.0), (6.0, 5.0)]
    loss = LossConfig(nll_weight=1.0, nll_from_epoch=1.5)
    assert counted(figures, best_by=criterion, loss=loss)[0].best_loss == best
    assert read_network(tmp_path / "run").epoch == epoch


@pytest.mark.parametrize(
    "begin, figures, epoch",
    [(0.0, (1.0, 2.0, 3.0), 1), (1.0, (-9.0, 1.0, 2.0), 2), (2.0, (-9.0, -8.0, 1.0, 2.0), 3)],
)
def test_the_first_whole_epoch_of_what_is_trained_can_be_the_best(
    counted, tmp_path, begin, figures, epoch
):
    """Here what is trained changes between two epochs, or before the first one."""
    loss = LossConfig(nll_from_epoch=begin)
    outcome, _ = counted([(value, 1.0) for value in figures], loss=loss)
    assert outcome.best_loss == 1.0
    assert read_network(tmp_path / "run").epoch == epoch


def test_nan_on_validation_is_never_the_best(counted, tmp_path):
    nan, infinite = float("nan"), float("inf")
    outcome, _ = counted([(nan, nan), (3.0, 3.0), (infinite, 1.0), (2.0, 2.0), (4.0, 4.0)])
    assert outcome.best_loss == 2.0
    assert read_network(tmp_path / "run").epoch == 4
    assert counted([(1.0, 3.0), (nan, nan)], "latest", best_by="latest")[0].best_loss == 3.0
    assert read_network(tmp_path / "latest").epoch == 1
    assert counted([(nan, nan)], "none")[0].best_loss is None
    with pytest.raises(InputError, match="none: holds no weights"):
        read_network(tmp_path / "none")
    config, plateau = OptimConfig(schedule="plateau"), optimizer.Plateau()
    for error in (infinite, 1.0, nan, 0.5):
        plateau = optimizer.update_plateau(plateau, error, config)
    assert plateau == optimizer.Plateau(1.0, 0.5, 0)


def test_a_rate_that_has_fallen_stays_fallen_in_a_resumed_run(counted, tmp_path, monkeypatch):
    monkeypatch.setattr(optimizer, "PLATEAU_EPOCHS", 1)
    figures = [(1.0, 1.0), *[(2.0, 2.0)] * 5]  # the rate falls after epochs 2 and 4
    _, factors = counted(figures, "alone")
    assert sorted(set(factors), reverse=True) == pytest.approx([1.0, 0.1, 0.01])
    assert counted(figures[:4], stop_at=4, epochs=6)[0].stopped_by == signal.SIGTERM
    outcome, factors = counted(figures[4:], resume=True, epochs=6)
    assert outcome.stopped_by is None and (factors[0], factors[-1]) == pytest.approx((0.1, 0.01))
    rates = [[row["learning_rate"] for row in rows(tmp_path / name)] for name in ("alone", "run")]
    assert rates[0] == rates[1]


def test_a_signal_in_the_last_validation_finds_a_run_that_is_complete(counted):
    assert counted([(1.0, 1.0)], stop_at=1)[0].stopped_by is None


def test_what_makes_no_sense_is_warned_of(counted, recording, tmp_path, capsys):
    """A run that ends before its uncertainty learns; a recording in both splits. And the line of an
    epoch shows the parts of its loss."""
    counted([(1.0, 1.0)], "plain")
    assert "warning" not in capsys.readouterr().err
    shutil.copytree(recording, tmp_path / "data")
    (tmp_path / "data" / "val_list.txt").write_text("c\nb\n")
    loss = LossConfig(log_std_from_epoch=10.0)
    counted([(1.0, 1.0)], loss=loss, data_root=str(tmp_path / "data"))
    overlap, delay, epoch = [
        line for line in capsys.readouterr().err.splitlines() if line.startswith(("warn", "epoch"))
    ]
    assert "b in train and in val: the best checkpoint is chosen by" in overlap
    assert f"the uncertainty learns only from step {10 * STEPS} on, and the run ends at" in delay
    assert "mse 0 nll 0  val mse 1 nll 0" in epoch
