"""Runs of a tiny network on a tiny recording: what is logged, resumed, refused; whole processes
where signals matter."""

import dataclasses
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml

from gnio_jax import config as configuration
from gnio_jax.config import DataConfig, LossConfig, ModelConfig, OptimConfig, TrainConfig
from gnio_jax.data import windows
from gnio_jax.errors import InputError
from gnio_jax.models import registry
from gnio_jax.training import (
    checkpoint,
    epochs,
    loop,
    optimizer,
    run_folder,
    task,
    window_task,
)
from gnio_jax.training.losses import Losses
from gnio_jax.training.task import Recordings
from gnio_jax.training.window_task import WindowTask
from tests.support import tiny_run
from tests.support.drawn_state import fresh_state
from tests.support.tiny_network import Tiny
from tests.support.tlio_files import write_splits

ROOT = Path(__file__).parents[2]

order_of = WindowTask(Tiny(), TrainConfig(), 1).order


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """A TLIO folder of three short walks."""
    return write_splits(tmp_path_factory.mktemp("tlio"))


def tiny(recording, workdir, **changes):
    config = TrainConfig(
        dataset="tlio",
        data_root=str(recording),
        workdir=str(workdir),
        data=DataConfig(rate=50.0),
        model=ModelConfig("tiny"),
        optim=OptimConfig(epochs=6, batch_size=16, learning_rate=1e-3, warmup_epochs=1.0),
    )
    return dataclasses.replace(config, **changes)


def parameters(workdir, which="latest"):
    return jax.tree.map(np.asarray, checkpoint.load_run(Path(workdir), which).variables)


def same(a, b):
    return all(jax.tree.leaves(jax.tree.map(np.array_equal, a, b)))


@pytest.fixture(scope="module", autouse=True)
def registered():
    with tiny_run.known():
        yield


@pytest.fixture(scope="module")
def finished(recording, tmp_path_factory):
    """A run of six epochs that nothing interrupted."""
    workdir = tmp_path_factory.mktemp("finished") / "run"
    outcome = loop.train(tiny(recording, workdir))
    return workdir, outcome


def test_a_run_leaves_its_config_log_events_and_checkpoints(recording, finished):
    workdir, outcome = finished
    assert configuration.load(workdir / "config.yaml") == tiny(recording, workdir)
    rows = [json.loads(line) for line in (workdir / "metrics.jsonl").read_text().splitlines()]
    assert [row["epoch"] for row in rows] == list(range(6))
    windows_per_epoch = 2 * len(
        range(0, 600 - 50, 5)
    )  # 12 s at 50 Hz, a window of 1 s every 0.1 s, two recordings
    assert [row["step"] for row in rows] == [windows_per_epoch // 16 * (i + 1) for i in range(6)]
    assert outcome.best_loss == min(row["val_loss"] for row in rows)
    assert rows[-1]["loss"] < rows[0]["loss"]
    assert rows[-1]["loss"] == pytest.approx(
        100 * rows[-1]["mse"] + 1e-4 * rows[-1]["nll"], rel=1e-5
    )
    assert yaml.safe_load((workdir / "splits.yaml").read_text()) == {
        "train": ["a", "b"],
        "val": ["c"],
    }
    assert list((workdir / "tensorboard").glob("events*"))
    best = min(rows, key=lambda row: row["val_loss"])
    assert checkpoint.load_run(workdir, "best").step == best["step"]
    assert checkpoint.load_run(workdir, "latest").step == rows[-1]["step"]


def windows_of(recording, split, config):
    from gnio_jax import data

    sequences = [data.resample(s, 50.0) for s in data.load("tlio", recording, split)]
    return jax.device_put(windows.window_source(sequences, config.data, 5))


def test_validation_is_the_plain_mean_over_every_window(recording, finished):
    """With the parameters that evaluation loads."""
    workdir, _ = finished
    run = checkpoint.load_run(workdir, "latest")
    source = windows_of(recording, "val", run.config)
    which = np.arange(source.start.shape[0], dtype=np.int32)
    every = jax.jit(windows.gather, static_argnums=2)(source, which, 50)
    prediction = jax.jit(run.model.apply)(run.variables, every.imu)
    mse = np.mean(
        np.sum(
            (np.asarray(prediction.displacement, np.float64) - np.asarray(every.displacement)) ** 2,
            axis=1,
        )
    )
    row = json.loads((workdir / "metrics.jsonl").read_text().splitlines()[-1])
    assert row["val_mse"] == pytest.approx(mse, rel=1e-4)
    assert len(every.displacement) % 16 != 0  # so that the filled-up last batch is part of the test


def test_a_run_is_not_resumed_with_other_recordings(recording, finished, tmp_path):
    shutil.copytree(finished[0], tmp_path / "run")
    shutil.copytree(recording, tmp_path / "data")
    (tmp_path / "data" / "train_list.txt").write_text("b\na\n")
    config = tiny(recording, tmp_path / "run", data_root=str(tmp_path / "data"))
    before = (tmp_path / "run" / "splits.yaml").read_bytes()
    with pytest.raises(
        InputError,
        match=(
            r"splits\.yaml: .*split 'train' \(0 differ, their order does\); resume with the "
            r"same data"
        ),
    ):
        loop.train(config, resume=True)
    (tmp_path / "data" / "train_list.txt").write_text("b\n")
    with pytest.raises(InputError, match=r"split 'train' \(1 differ, e\.g\. a\)"):
        loop.train(config, resume=True)
    assert (tmp_path / "run" / "splits.yaml").read_bytes() == before
    (tmp_path / "run" / "splits.yaml").write_text("{")
    with pytest.raises(InputError, match=r"splits\.yaml: cannot be read"):
        loop.train(config, resume=True)


@pytest.mark.parametrize("dispatches", [1, 4, 9])
def test_stopping_within_an_epoch_and_resuming_gives_the_same_bits(
    recording, finished, tmp_path, monkeypatch, dispatches
):
    calls = []
    real = task.train_steps

    def stopping(*arguments, **options):
        calls.append(1)
        if len(calls) == dispatches:
            os.kill(os.getpid(), signal.SIGTERM)
        return real(*arguments, **options)

    monkeypatch.setattr(task, "train_steps", stopping)
    monkeypatch.setattr(loop, "DISPATCH_SECONDS", 0.01)
    outcome = loop.train(tiny(recording, tmp_path / "run"))
    assert outcome.stopped_by == signal.SIGTERM
    assert (
        checkpoint.load_run(tmp_path / "run", "latest").step
        < checkpoint.load_run(finished[0], "latest").step
    )
    monkeypatch.setattr(loop, "DISPATCH_SECONDS", 0.5)
    assert loop.train(tiny(recording, tmp_path / "run"), resume=True).stopped_by is None
    for which in ("latest", "best"):
        assert same(parameters(tmp_path / "run", which), parameters(finished[0], which))
    kept = ("epoch", "step", "loss", "mse", "nll", "val_loss", "learning_rate")
    rows = [
        [
            {key: row[key] for key in kept}
            for row in map(json.loads, (folder / "metrics.jsonl").read_text().splitlines())
        ]
        for folder in (tmp_path / "run", finished[0])
    ]
    for ours, theirs in zip(
        *rows, strict=True
    ):  # sums over an epoch are made of fewer or more parts: equal but for rounding
        assert ours == pytest.approx(theirs, rel=1e-6)


def command(recording, workdir):
    return [
        *[sys.executable, "-m", "tests.support.training_process", "never", "0", "0"],
        "--dataset",
        "tlio",
        "--data-root",
        str(recording),
        "--workdir",
        str(workdir),
        "--data.rate",
        "50",
        "--model.name",
        "tiny",
        "--optim.epochs",
        "6",
        "--optim.batch-size",
        "16",
        "--optim.learning-rate",
        "1e-3",
        "--optim.warmup-epochs",
        "1",
    ]


# With as many devices as here, so that programs from the cache fit.
DEVICES = str(len(jax.devices()))
ENVIRONMENT = {**os.environ, "JAX_PLATFORMS": "cpu", "JAX_NUM_CPU_DEVICES": DEVICES}


def test_killed_at_any_moment_and_resumed_gives_the_same_bits(recording, finished, tmp_path):
    """SIGKILL while a checkpoint is being written, or right before or after, against the run left
    alone."""
    run = tmp_path / "killed"
    process = subprocess.Popen(
        command(recording, run),
        cwd=ROOT,
        env=ENVIRONMENT,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    log, deadline = run / "metrics.jsonl", time.time() + 120
    while (
        time.time() < deadline
        and process.poll() is None
        and not (log.exists() and log.read_text().count("\n") >= 2)
    ):
        time.sleep(0.002)
    time.sleep(0.03)  # the log's row comes right before the checkpoints
    process.send_signal(signal.SIGKILL)
    _, errors = process.communicate()
    assert process.returncode == -signal.SIGKILL, errors
    assert loop.train(configuration.load(run / "config.yaml"), resume=True).stopped_by is None
    for which in ("latest", "best"):
        assert same(parameters(run, which), parameters(finished[0], which))
    epochs_logged = [
        json.loads(line)["epoch"] for line in (run / "metrics.jsonl").read_text().splitlines()
    ]
    assert epochs_logged == list(range(6))


def test_a_loss_that_is_not_finite_stops_with_its_step(recording, tmp_path, monkeypatch):
    real, found = window_task.window_source, []

    def spoiled(*arguments):
        source = real(*arguments)
        found.append(source)
        return source._replace(
            displacement=np.where(
                np.arange(len(source.start))[:, None] == 77, np.float32(np.inf), source.displacement
            )
        )

    monkeypatch.setattr(window_task, "window_source", spoiled)
    config = tiny(recording, tmp_path / "run")
    with pytest.raises(
        FloatingPointError, match=r"run: the loss .* is not finite at step \d+ \(epoch 0\)"
    ) as raised:
        loop.train(config)
    order_key = jax.random.split(jax.random.key(config.seed), 3)[1]
    expected = int(np.flatnonzero(np.asarray(order_of(order_key, 0, found[0])) == 77)[0]) // 16
    assert f"at step {expected} " in str(raised.value)


class Stuck(Tiny):
    """A network whose scale has underflowed: what it says of the displacement is 0, whatever its
    head does."""

    def __call__(self, windows, train=False):
        found = super().__call__(windows, train)
        return found._replace(displacement=0 * found.displacement)


def test_a_head_that_no_gradient_reaches_is_told_of(recording, finished, tmp_path, capsys):
    optim = OptimConfig(epochs=1, batch_size=16)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(registry._MODELS, "tiny", Stuck)
        loop.train(tiny(recording, tmp_path / "run", optim=optim))
    warned = [line for line in capsys.readouterr().err.splitlines() if "warning" in line]
    assert warned == [
        "warning: no gradient reached head/bias, head/kernel in this epoch, the network learns no "
        "more; start over with a lower optim.learning_rate, or with optim.clip_norm"
    ]
    rows = (finished[0] / "metrics.jsonl").read_text().splitlines()
    assert not any(epochs.stuck_layers(json.loads(row)) for row in rows)
    # Steps that Adam's ε swallows are none, and a loss that has not begun is no mistake.
    row = json.loads(rows[-1])
    swallowed = {**row, "gradient_norm/head/kernel": 1e-12}
    assert epochs.stuck_layers(swallowed) == ["head/kernel"]
    assert not epochs.stuck_layers({**swallowed, "loss": 0.0})


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

        return spying

    monkeypatch.setattr(task, "train_steps", spy(task.train_steps))
    monkeypatch.setattr(window_task, "validate", spy(window_task.validate))
    loop.train(
        tiny(
            recording,
            tmp_path / "run",
            loss=LossConfig(nll_from_epoch=99.0),
            optim=OptimConfig(epochs=1, batch_size=16),
        )
    )
    key = jax.random.split(jax.random.key(0), 3)[0]
    template = fresh_state(Tiny(), tiny(recording, ""), 1, key)
    trained = parameters(tmp_path / "run")["params"]
    assert same(trained["uncertainty"], jax.tree.map(np.asarray, template.params["uncertainty"]))
    assert not same(trained["head"], jax.tree.map(np.asarray, template.params["head"]))
    assert len(texts) >= 2
    for text in texts:
        assert "xf32>" in text and "f64" not in text
    assert {leaf.dtype for leaf in jax.tree.leaves(trained)} == {np.dtype("float32")}


def test_a_run_is_never_overwritten_nor_continued_with_other_settings(
    recording, finished, tmp_path
):
    workdir, _ = finished
    with pytest.raises(InputError, match="already holds a run; continue it with --resume"):
        loop.train(tiny(recording, workdir))
    with pytest.raises(InputError, match=r"config\.yaml: 'seed' was 0 and is now 5"):
        loop.train(tiny(recording, workdir, seed=5), resume=True)
    with pytest.raises(InputError, match="holds no run to resume"):
        loop.train(tiny(recording, tmp_path / "nothing"), resume=True)
    assert not (tmp_path / "nothing").exists()


def test_a_batch_larger_than_the_data_is_refused_before_anything_is_written(recording, tmp_path):
    with pytest.raises(
        InputError, match=r"optim\.batch_size: is 4096, but there are only 220 windows"
    ):
        loop.train(tiny(recording, tmp_path / "run", optim=OptimConfig(batch_size=4096)))
    assert not (tmp_path / "run").exists()


def test_runs_that_cannot_be_loaded(finished, tmp_path):
    workdir, _ = finished
    with pytest.raises(InputError, match=r"holds no run \(config\.yaml is missing\)"):
        checkpoint.load_run(tmp_path)
    configuration.save(tmp_path / "empty" / "config.yaml", TrainConfig())
    with pytest.raises(InputError, match="holds no checkpoint"):
        checkpoint.load_run(tmp_path / "empty")
    other = tmp_path / "other"
    subprocess.run(["cp", "-r", workdir, other], check=True)
    config = configuration.load(other / "config.yaml")
    configuration.save(
        other / "config.yaml",
        dataclasses.replace(config, model=dataclasses.replace(config.model, width=5)),
    )
    with pytest.raises(
        InputError, match=r"has shape \[.*\] in the checkpoint and \[.*\] in the configured model"
    ):
        checkpoint.load_run(other)
    for damaged in (other / "checkpoints" / "best").glob("*/variables/**/d/*"):
        damaged.write_bytes(damaged.read_bytes()[:10])
    configuration.save(other / "config.yaml", config)
    with pytest.raises(InputError, match="cannot be read"):
        checkpoint.load_run(other)


def test_a_run_of_an_earlier_version_is_evaluated_and_not_resumed(recording, finished, tmp_path):
    """Its weights are read; the optimizer's state was another."""
    run = tmp_path / "run"
    shutil.copytree(finished[0], run)
    for file in run.glob("checkpoints/*/*/meta/metadata"):
        meta = json.loads(file.read_text())
        assert meta.pop("version") == checkpoint.VERSION
        file.write_text(json.dumps(meta))
    assert same(parameters(run, "best"), parameters(finished[0], "best"))
    with pytest.raises(InputError, match=r"is of an earlier version of .*; begin .* --init-from"):
        loop.train(tiny(recording, run), resume=True)


class Cliff(Tiny):
    """A network whose loss is finite everywhere, and whose gradient is not for a batch with a
    window that no one walks."""

    def __call__(self, windows, train=False):
        found = super().__call__(windows, train)
        wild = jnp.any(jnp.abs(windows) > 1e3)
        root = jax.lax.cond(
            wild, lambda d: jnp.sqrt(0 * d), lambda d: 0 * d, found.displacement[:, 0] ** 2
        )
        return found._replace(displacement=found.displacement.at[:, 0].add(root))


def test_a_gradient_that_is_not_finite_leaves_the_last_good_checkpoint(
    recording, tmp_path, monkeypatch
):
    """In the last step of an epoch, whose loss is finite: neither `latest` nor `best` takes the
    parameters that it spoils."""
    real, size, steps = window_task.window_source, 16, 13

    def orders(seed, source):
        key = task.keys_of(seed).order
        return [np.asarray(order_of(key, epoch, source)) for epoch in (0, 1)]

    def spoiled(sequences, *options):
        """A window that epoch 0 does not visit, and epoch 1 visits last, sees rows of its own."""
        source = real(sequences, *options)
        if len(source.start) // size != steps:
            return source  # of validation
        first, second = orders(seed, source)
        late = set(second[(steps - 1) * size : steps * size]) - set(first[: steps * size])
        if not late:
            return source
        found.append(seed)
        rows = np.full((50, 6), 2e3, np.float32)
        start = source.start.copy()
        start[late.pop()] = len(source.imu)
        imu, step = (
            np.concatenate([a, rows[:, :k]]) for a, k in ((source.imu, 6), (source.step, 3))
        )
        return source._replace(imu=imu, step=step, start=start)

    found, seed = [], 0
    with jax.enable_x64(False):
        probe = windows_of(recording, "train", tiny(recording, ""))
        while not set(orders(seed, probe)[1][-28:-12]) - set(orders(seed, probe)[0][:-12]):
            seed += 1
    monkeypatch.setattr(window_task, "window_source", spoiled)
    monkeypatch.setitem(registry._MODELS, "tiny", Cliff)
    config = tiny(recording, tmp_path / "run", seed=seed)
    with pytest.raises(
        FloatingPointError, match=f"gradient is not finite at step {2 * steps - 1} "
    ):
        loop.train(config)
    assert found == [seed]
    for which in ("latest", "best"):
        run = checkpoint.load_run(tmp_path / "run", which)
        assert run.step == steps
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(run.variables))


class Counted:
    """Training of which only the steps count, with figures of validation as they are given."""

    def __init__(self, monkeypatch, figures):
        self.figures, self.factors = iter(figures), []
        monkeypatch.setattr(task, "train_steps", self.train_steps)
        monkeypatch.setattr(window_task, "validate", self.validate)

    def train_steps(self, state, source, order, first, count, factor, *_, **__):
        self.factors.append(float(factor))
        sums = dict.fromkeys(("loss", "mse", "nll"), jnp.float32(0))
        return state._replace(step=state.step + count), task.Progress(sums, jnp.int32(-1))

    def validate(self, *_, **__):
        loss, mse = next(self.figures)
        one = jnp.ones(3, jnp.float32)
        return window_task.Validation(
            Losses(jnp.float32(loss), jnp.float32(mse), jnp.float32(0)), one, one
        )


def test_the_best_checkpoint_begins_anew_where_what_is_trained_changes(
    recording, tmp_path, monkeypatch
):
    """Losses before and after a switch do not compare: the first epoch's would win for ever."""
    for criterion, best, epoch in (("loss", 6.0, 4), ("squared_error", 4.0, 3)):
        # before, with the switch, the first whole epoch, one more
        Counted(monkeypatch, [(-100.0, 1.0), (-50.0, 2.0), (7.0, 4.0), (6.0, 5.0)])
        config = tiny(
            recording, tmp_path / criterion, loss=LossConfig(nll_weight=1.0, nll_from_epoch=1.5)
        )
        config = dataclasses.replace(
            config,
            optim=dataclasses.replace(
                config.optim, epochs=4, best_by=criterion, statistics_windows=0
            ),
        )
        assert loop.train(config).best_loss == best
        assert checkpoint.load_run(tmp_path / criterion).epoch == epoch


def plateau_config(recording, workdir, epochs):
    optim = OptimConfig("plateau", epochs=epochs, batch_size=16, statistics_windows=0)
    return tiny(recording, workdir, optim=optim)


@pytest.mark.parametrize("nan", [float("nan"), float("inf")])
def test_nan_on_validation_is_never_the_best(recording, tmp_path, monkeypatch, nan):
    Counted(monkeypatch, [(nan, nan), (3.0, 3.0), (nan, nan), (2.0, 2.0), (4.0, 4.0)])
    outcome = loop.train(plateau_config(recording, tmp_path / "run", 5))
    assert outcome.best_loss == 2.0
    assert checkpoint.load_run(tmp_path / "run").epoch == 4
    Counted(monkeypatch, [(nan, nan)])
    assert loop.train(plateau_config(recording, tmp_path / "none", 1)).best_loss is None
    with pytest.raises(InputError, match="best: holds no checkpoint"):
        checkpoint.load_run(tmp_path / "none")


def test_a_rate_that_has_fallen_stays_fallen_in_a_resumed_run(recording, tmp_path, monkeypatch):
    """The plateau's factor, best value and idle epochs are kept with the checkpoint."""
    monkeypatch.setattr(optimizer, "PLATEAU_EPOCHS", 1)
    figures = [(1.0, 1.0), *[(2.0, 2.0)] * 5]  # the rate falls after epochs 2 and 4
    alone = Counted(monkeypatch, figures)
    loop.train(plateau_config(recording, tmp_path / "alone", 6))
    by_epoch = sorted(set(alone.factors), reverse=True)
    assert by_epoch == [1.0, pytest.approx(0.1), pytest.approx(0.01)]

    stopped = Counted(monkeypatch, figures[:4])
    validate = stopped.validate

    calls = []

    def last_stops(*given, **options):
        calls.append(1)
        if len(calls) == 4:
            os.kill(os.getpid(), signal.SIGTERM)
        return validate(*given, **options)

    monkeypatch.setattr(window_task, "validate", last_stops)
    config = plateau_config(recording, tmp_path / "resumed", 6)
    assert loop.train(config).stopped_by == signal.SIGTERM
    resumed = Counted(monkeypatch, figures[4:])
    assert loop.train(config, resume=True).stopped_by is None
    assert resumed.factors[0] == pytest.approx(0.1) and resumed.factors[-1] == pytest.approx(0.01)
    rows = [
        [json.loads(line)["learning_rate"] for line in open(tmp_path / name / "metrics.jsonl")]
        for name in ("alone", "resumed")
    ]
    assert rows[0] == rows[1]


def test_a_signal_in_the_last_validation_finds_a_run_that_is_complete(
    recording, tmp_path, monkeypatch
):
    counted = Counted(monkeypatch, [(1.0, 1.0)])
    validate = counted.validate

    def stopped(*given, **options):
        os.kill(os.getpid(), signal.SIGTERM)
        return validate(*given, **options)

    monkeypatch.setattr(window_task, "validate", stopped)
    assert loop.train(plateau_config(recording, tmp_path / "run", 1)).stopped_by is None


def test_a_run_that_ends_before_its_uncertainty_learns_is_warned_of(
    recording, tmp_path, monkeypatch, capsys
):
    """And the line of an epoch shows the parts of its loss."""
    Counted(monkeypatch, [(1.0, 1.0)])
    config = plateau_config(recording, tmp_path / "run", 1)
    loop.train(dataclasses.replace(config, loss=LossConfig(log_std_from_epoch=10.0)))
    lines = capsys.readouterr().err.splitlines()
    assert (
        "warning: the uncertainty learns only from step 130 on, and the run ends at step 13; "
        "raise optim.epochs or lower loss.log_std_from_epoch"
    ) in lines
    (epoch,) = [line for line in lines if line.startswith("epoch")]
    assert "mse 0 nll 0  val mse 1 nll 0" in epoch


def test_a_recording_in_both_splits_is_warned_of(recording, tmp_path, monkeypatch, capsys):
    Counted(monkeypatch, [(1.0, 1.0)] * 2)
    loop.train(plateau_config(recording, tmp_path / "apart", 1))
    assert "warning" not in capsys.readouterr().err
    shutil.copytree(recording, tmp_path / "data")
    (tmp_path / "data" / "val_list.txt").write_text("c\nb\n")
    config = plateau_config(recording, tmp_path / "run", 1)
    loop.train(dataclasses.replace(config, data_root=str(tmp_path / "data")))
    assert "warning: b in train and in val: the best checkpoint" in capsys.readouterr().err


def test_two_trainings_in_one_folder(recording, tmp_path, monkeypatch):
    """The second one is refused when both have passed the door before either has written, also
    where both resume."""
    Counted(monkeypatch, [(1.0, 1.0)] * 3)
    config = plateau_config(recording, tmp_path / "run", 2)
    recordings = Recordings(None, {}, {"train": ["a", "b"], "val": ["c"]})
    with run_folder.opened(config, recordings, {}, resume=False):
        written = (tmp_path / "run" / "config.yaml").read_bytes()
        other = dataclasses.replace(config, seed=1)
        with pytest.raises(InputError, match="run: another process is training in it"):
            with run_folder.opened(other, recordings, {}, resume=False):
                pass
        with pytest.raises(InputError, match="run: another process is training in it"):
            loop.train(config, resume=True)
    with pytest.raises(InputError, match="run: already holds a run"):
        with run_folder.opened(other, recordings, {}, resume=False):
            pass
    assert (tmp_path / "run" / "config.yaml").read_bytes() == written


def test_parameters_that_are_not_finite_are_not_loaded(finished, tmp_path):
    run = checkpoint.load_run(finished[0])
    run.variables["params"]["head"]["bias"] = jnp.full(3, jnp.nan, jnp.float32)
    configuration.save(tmp_path / "config.yaml", run.config)
    checkpoint.write_best(tmp_path, run)
    with pytest.raises(InputError, match="best: holds parameters that are not finite"):
        checkpoint.load_run(tmp_path)
