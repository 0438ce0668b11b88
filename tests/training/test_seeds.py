"""Seeds that are trained in turn: runs with the numbers that each has alone."""

import dataclasses
import json
import signal
from pathlib import Path

import jax
import numpy as np
import pytest

from gnio_jax import config as configuration
from gnio_jax.commands.options import Call, read
from gnio_jax.commands.train import experiment, train
from gnio_jax.config import DataConfig, ModelConfig, OptimConfig, TrainConfig
from gnio_jax.errors import InputError
from gnio_jax.reporting import Silence
from gnio_jax.training import checkpoint, loop, task, window_task
from tests.support import tiny_run
from tests.support.command_lines import run as gnio
from tests.support.tlio_files import write_splits

SEEDS = (3, 0, 7)
STEPS = 13
"""Of an epoch."""


class Told(Silence):
    """What a run says."""

    def __init__(self):
        self.lines = []

    def line(self, text):
        self.lines.append(text)


@pytest.fixture(scope="module", autouse=True)
def registered():
    with tiny_run.known():
        yield


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    """Two epochs of a network whose uncertainty is calibrated, and a rate of its own for each
    seed's plateau."""
    folder = tmp_path_factory.mktemp("seeds")
    return TrainConfig(
        "tlio",
        str(write_splits(folder / "tlio")),
        str(folder / "run"),
        data=DataConfig(rate=50.0),
        model=ModelConfig("tiny", uncertainty="calibrated"),
        optim=OptimConfig(epochs=2, batch_size=16, learning_rate=1e-3, statistics_windows=64),
    )


@pytest.fixture(scope="module")
def alone(config, tmp_path_factory):
    """The work folders of the seeds, trained one by one."""
    config = at(config, tmp_path_factory.mktemp("alone") / "run")
    return [loop.train(each).workdir for each in configuration.with_seeds(config, SEEDS)]


def at(config, workdir):
    return dataclasses.replace(config, workdir=str(workdir))


def rows(workdir):
    found = [json.loads(line) for line in (workdir / "metrics.jsonl").read_text().splitlines()]
    return [
        {name: row[name] for name in row if name not in ("seconds", "windows_per_second")}
        for row in found
    ]


def variables(workdir, which):
    return jax.device_get(checkpoint.load_run(workdir, which).variables)


def assert_same_runs(workdirs, others, rtol):
    for workdir, other in zip(workdirs, others, strict=True):
        ours, theirs = rows(workdir), rows(other)
        assert [row["step"] for row in ours] == [STEPS, 2 * STEPS]
        for mine, expected in zip(ours, theirs, strict=True):
            assert mine == pytest.approx(expected, rel=rtol, abs=0)
        for which in ("latest", "best"):
            both = variables(workdir, which), variables(other, which)
            jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, 10 * rtol, 1e-6), *both)


def test_every_seed_is_an_ordinary_run(config, alone, tmp_path):
    """Its folder, its settings, its parameters to the bit; recordings are read and steps compiled
    once."""
    jitted = task.train_steps, window_task.validate
    told, programs = Told(), [each._cache_size() for each in jitted]
    configs = configuration.with_seeds(at(config, tmp_path / "run"), SEEDS)
    outcomes = loop.train_all(configs, reporter=told)
    assert [each._cache_size() for each in jitted] == programs
    assert [outcome.workdir.name for outcome in outcomes] == ["run_s3", "run_s0", "run_s7"]
    for seed, outcome in zip(SEEDS, outcomes, strict=True):
        kept = configuration.load(outcome.workdir / "config.yaml")
        assert kept == dataclasses.replace(config, seed=seed, workdir=str(outcome.workdir))
        assert outcome.best_loss == min(row["val_loss"] for row in rows(outcome.workdir))
    assert_same_runs([outcome.workdir for outcome in outcomes], alone, rtol=1e-6)
    for outcome, other in zip(outcomes, alone, strict=True):
        both = variables(outcome.workdir, "latest"), variables(other, "latest")
        jax.tree.map(np.testing.assert_array_equal, *both)
    losses = [rows(workdir)[-1]["val_loss"] for workdir in alone]
    assert len(set(losses)) == 3
    assert len([line for line in told.lines if line.startswith("reading")]) == 1
    assert len([line for line in told.lines if line.startswith("epoch")]) == 6


def test_a_signal_saves_the_run_and_the_seeds_go_on(config, alone, tmp_path, monkeypatch):
    """Stopped within an epoch of the second seed, and once more at the end of it."""
    real = task.train_steps

    def stopping(state, *given, **options):
        state, progress = real(state, *given, **options)
        if run_of["seed"] == 0 and int(state.step) in run_of["steps"]:
            signal.raise_signal(signal.SIGTERM)
        return state, progress

    run_of = {"seed": None, "steps": [STEPS + 2]}
    opened = loop.run_folder.opened

    def noted(config, *given):
        run_of["seed"] = config.seed
        return opened(config, *given)

    configs = configuration.with_seeds(at(config, tmp_path / "run"), SEEDS)
    workdirs = [Path(each.workdir) for each in configs]
    with monkeypatch.context() as patch:
        patch.setattr(loop, "DISPATCH_SECONDS", 0)
        patch.setattr(task, "train_steps", stopping)
        patch.setattr(loop.run_folder, "opened", noted)
        outcomes = loop.train_all(configs)
        assert [outcome.stopped_by for outcome in outcomes] == [None, signal.SIGTERM]
        latest = [checkpoint.load_run(workdir, "latest").step for workdir in workdirs[:2]]
        assert latest == [2 * STEPS, STEPS + 2] and not workdirs[2].exists()
        run_of["steps"] = [2 * STEPS]
        outcomes = loop.train_all(configs, resume=True)
        # The second run is complete, and a seed is missing.
        assert [outcome.stopped_by for outcome in outcomes] == [None, signal.SIGTERM]
        assert checkpoint.load_run(workdirs[1], "latest").step == 2 * STEPS
        assert not workdirs[2].exists()
    told = Told()
    outcomes = loop.train_all(configs, resume=True, reporter=told)
    assert [outcome.stopped_by for outcome in outcomes] == [None] * 3
    assert told.lines.count(f"resuming at step {2 * STEPS}") == 2
    assert_same_runs(workdirs, alone, rtol=1e-6)


def test_no_begun_run_is_nothing_to_resume(config, tmp_path):
    with pytest.raises(InputError, match="run_s3: holds no run to resume"):
        configs = configuration.with_seeds(at(config, tmp_path / "run"), SEEDS)
        loop.train_all(configs, resume=True)


@pytest.mark.parametrize(
    "seeds, expected",
    [
        ((), "--seeds: names no seed"),
        ((1, 2, 1), "--seeds: names 1 twice"),
        ((0, 1), "run_s0: already holds a run; continue it with --resume"),
    ],
)
def test_mistakes(config, tmp_path, seeds, expected):
    configuration.save(tmp_path / "run_s0" / "config.yaml", config)
    with pytest.raises(InputError, match=expected):
        loop.train_all(configuration.with_seeds(at(config, tmp_path / "run"), seeds))
    assert [path.name for path in tmp_path.iterdir()] == ["run_s0"]


def test_the_command_names_each_run_and_how_to_go_on(config, tmp_path, monkeypatch, capsys):
    """And a resumed command takes the settings of the first seed's run."""
    given = []

    def train_all(configs, resume, *_):
        given.append((configs, resume))
        stopped_by = signal.SIGTERM if resume else None
        return [loop.Outcome(Path(each.workdir), 0.5, stopped_by) for each in configs]

    monkeypatch.setattr(loop, "train_all", train_all)
    run = str(tmp_path / "run")
    gnio("train", "--workdir", run, "--seeds", "1", "2", "--optim.epochs", "5")
    out = capsys.readouterr().out.splitlines()
    assert [line.split()[-1] for line in out] == [f"{run}_s1", f"{run}_s2"]
    configuration.save(Path(f"{run}_s1") / "config.yaml", given[0][0][0])
    with pytest.raises(SystemExit):
        gnio("train", "--workdir", run, "--seeds", "1", "2", "--resume")
    assert f"--workdir {run} --seeds 1 2 --resume" in capsys.readouterr().err
    assert [[each.seed for each in configs] for configs, _ in given] == [[1, 2]] * 2
    assert given[1][1] and given[1][0][0].optim.epochs == 5
    monkeypatch.chdir(tmp_path)
    configuration.save(Path("runs/synthetic_gnio_s1/config.yaml"), given[0][0][0])
    call = Call("gnio train", ["--seeds", "1", "2", "--resume"])
    found = experiment(read(train, call), call)
    assert found.optim.epochs == 5 and found.workdir is None
