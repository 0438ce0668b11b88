"""A batch that devices and processes share: the same numbers as on one device of one process. Runs
in several processes on localhost are stopped and killed, and go on in another number of them."""

import contextlib
import dataclasses
import functools
import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import PartitionSpec

from gnio_jax import parallel
from gnio_jax.config import ThroughFilter, TrainConfig
from gnio_jax.errors import InputError
from gnio_jax.reporting import Silence
from gnio_jax.training import loop, run_folder
from gnio_jax.training.recordings import TrainingData, set_up
from gnio_jax.training.window_task import WindowTask
from tests.support import tiny_run
from tests.support.drawn_state import drawn_state
from tests.support.tlio_files import write_splits

ROOT = Path(__file__).parents[1]
OPTIONS = (
    "--dataset tlio --data.rate 50 --model.name tiny --optim.epochs 2 --optim.batch-size 32 "
    "--optim.learning-rate 1e-3 --optim.warmup-epochs 1 --optim.statistics-windows 64"
).split()
STEPS = 6
"""Of an epoch."""
LIMIT = 300
"""Seconds after which a test gives up; the machine may be busy."""


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    return write_splits(tmp_path_factory.mktemp("tlio"))


def started(*arguments):
    """A process that trains; all share what they compile."""
    environment = {**os.environ, "JAX_PLATFORMS": "cpu"}
    command = [sys.executable, "-m", "tests.support.training_process", *arguments]
    pipes = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen(command, cwd=ROOT, env=environment, **pipes)


def free_address():
    """A port of this machine at which nothing listens."""
    with socket.socket() as free:
        free.bind(("localhost", 0))
        return f"localhost:{free.getsockname()[1]}"


def ends_of(processes):
    """(status, lines on stderr) of each, once it has ended."""
    try:
        outputs = [process.communicate(timeout=LIMIT)[1] for process in processes]
    finally:
        for process in processes:
            process.kill()
    pairs = zip(processes, outputs, strict=True)
    return [(process.returncode, lines.splitlines()) for process, lines in pairs]


@pytest.fixture(scope="module")
def run(recording, tmp_path_factory):
    """A function that trains in several processes together: (status, lines on stderr) of each."""
    with pytest.MonkeyPatch.context() as patch:
        cache = tmp_path_factory.mktemp("cache")
        patch.setenv("GNIO_CACHE", str(cache / "recordings"))
        if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
            patch.setenv("JAX_COMPILATION_CACHE_DIR", str(cache / "programs"))
        yield functools.partial(trained_together, recording)


def trained_together(
    recording, workdir, processes, devices, *more, send=(), options_of=(), every=False
):
    """What process k does otherwise: send={k: (signal, step)}, options_of={k: options}; `every`: a
    checkpoint after every step."""
    coordinator, running = free_address(), []
    for k in range(processes):
        name, step = dict(send).get(k, ("never", 0))
        command = [name, str(step), str(int(every)), *OPTIONS, *more]
        command += ["--data-root", str(recording), "--workdir", str(workdir)]
        if processes > 1:
            command += ["--distributed", f"{coordinator},{processes},{k}"]
        command += ["--devices", str(devices), *dict(options_of).get(k, ())]
        running.append(started(*command))
    return ends_of(running)


def assert_same_run(workdir, other):
    ours, theirs = tiny_run.rows(workdir), tiny_run.rows(other)
    assert [row["step"] for row in ours] == [row["step"] for row in theirs]
    for name in ("loss", "val_loss", "val_mse", "val_nll"):
        pair = ([row[name] for row in table] for table in (ours, theirs))
        np.testing.assert_allclose(*pair, rtol=1e-4)


@pytest.fixture(scope="module")
def alone(run, tmp_path_factory):
    workdir = tmp_path_factory.mktemp("alone") / "run"
    (end,) = run(workdir, 1, 1)
    assert end[0] == 0, end
    return workdir


@pytest.mark.slow
@pytest.mark.parametrize("processes, devices", [(1, 8), (2, 4)])
def test_processes_and_devices_change_nothing_but_rounding(
    run, alone, tmp_path, processes, devices
):
    ends = run(tmp_path / "run", processes, devices)
    assert [status for status, _ in ends] == [0] * processes, ends
    printed_lines = [line for _, lines in ends[1:] for line in lines if "[Gloo]" not in line]
    assert not printed_lines, "the first process alone writes lines"
    assert_same_run(tmp_path / "run", alone)


@pytest.mark.slow
def test_processes_that_do_not_belong_together_are_refused(run, tmp_path):
    ends = run(tmp_path / "run", 2, 1, options_of={1: ("--optim.epochs", "3")})
    assert [status for status, _ in ends] == [2, 2], ends
    for _, lines in ends:
        assert "--distributed: the processes have different settings; start all" in lines[-1]


@pytest.mark.slow
def test_a_run_goes_on_in_other_numbers_of_processes_and_devices(run, alone, tmp_path):
    """4 × 2 until one of them is sent SIGTERM, 2 × 1 until one of them is killed, then 1 × 1."""
    workdir = tmp_path / "run"
    stopped = run(workdir, 4, 2, send={2: ("SIGTERM", STEPS + 2)})
    assert [status for status, _ in stopped] == [128 + signal.SIGTERM] * 4, stopped
    first = latest(workdir)
    assert first == STEPS + 2

    lost = {1: ("SIGKILL", first + 2)}
    survivor, killed = run(workdir, 2, 1, "--resume", send=lost, every=True)
    assert killed[0] == -signal.SIGKILL
    assert survivor[0] != 0, survivor
    second = latest(workdir)
    assert first < second < 2 * STEPS  # saved after every step

    # What a process leaves that is killed while it saves.
    (workdir / "checkpoints" / "latest" / f"{second + 1}.orbax-checkpoint-tmp").mkdir()
    (end,) = run(workdir, 1, 1, "--resume")
    assert end[0] == 0, end
    assert f"resuming at step {second}" in end[1]
    assert_same_run(workdir, alone)


def latest(workdir):
    (step,) = (workdir / "checkpoints" / "latest").glob("[0-9]*")
    return int(step.name)


@pytest.fixture(scope="module")
def small(recording):
    with tiny_run.registry_entry():
        yield tiny_run.config(recording, "")


@jax.enable_x64(False)
def trained(config):
    """Losses and gradient norms of each of five steps, figures of validation, parameters."""
    task, (source, held_out, _) = set_up(WindowTask, config, Silence())
    key, drawn = jax.random.key(0), drawn_state(task.model, config, task.steps_per_epoch)
    state, order, sums = parallel.copy_to_devices(drawn), task.order(key, 0, source), []
    for first in range(5):
        numbers = jnp.int32(first), jnp.int32(1), jnp.float32(1)
        state, progress = task.take_steps(state, source, order, *numbers, key)
        sums.append(progress.sums)
    state = task.with_statistics(state, source, key)
    state, row = task.validate(state, held_out, key)
    return jax.device_get((sums, row, state.variables["batch_stats"])), state


@pytest.fixture(scope="module")
def on_two(small):
    with parallel.sharing(2):
        return trained(small)


def test_two_devices_learn_what_one_learns(small, on_two):
    """Statistics of batch normalisation are those of the whole batch, or nothing would agree."""
    alone, _ = trained(small)
    # Adam turns the rounding of float32 into 4e-4 of a parameter in these steps.
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, 2e-3, 1e-5), on_two[0], alone)


def test_each_device_has_the_state_and_its_part_of_the_batch(small, on_two):
    _, state = on_two
    for leaf in jax.tree.leaves(state):
        assert leaf.sharding.is_fully_replicated and len(leaf.devices()) == 2
    with parallel.sharing(2):
        task, (source, *_) = set_up(WindowTask, small, Silence())
        which = parallel.copy_to_devices(np.arange(16, dtype=np.int32))
        key = jax.random.key(0)
        draw = jax.jit(lambda: task.draw(key, source, which))
        windows, _ = draw()
    assert windows.imu.sharding.spec[0] == "batch"
    assert [shard.data.shape[0] for shard in windows.imu.addressable_shards] == [8, 8]


def test_devices_that_cannot_share_the_work_are_refused(small):
    for limit, expected in ((3, "--devices: is 3, but process 0 has 2"), (0, "--devices: must be")):
        with pytest.raises(InputError, match=expected), parallel.sharing(limit):
            pass
    optim = dataclasses.replace(small.optim, batch_size=15)
    changed = dataclasses.replace(small, optim=optim, data_root="nowhere")
    with parallel.sharing(2), pytest.raises(InputError, match="2 devices cannot"):
        set_up(WindowTask, changed, Silence())  # before it reads anything
    config = TrainConfig(through_filter=ThroughFilter(("head",)))
    with pytest.raises(InputError, match="--devices: is for training on windows; leave it out"):
        loop.train(config, devices=2)


def test_processes_with_other_samples_or_weights_are_refused(monkeypatch):
    """As if another process had sent the numbers of the first call."""
    monkeypatch.setattr(jax, "process_count", lambda: 2)
    monkeypatch.setattr(parallel, "on_host", lambda tree: tree)
    sent, samples = [], np.arange(12.0).reshape(4, 3)

    def compare(samples, weight, largest):
        monkeypatch.setattr(parallel, "largest", largest)
        recordings = TrainingData({"imu": samples, "start": np.arange(3)}, {}, {"train": ["a"]})
        run_folder.compare_processes(TrainConfig(), recordings, {"scale": jnp.float32(weight)})

    compare(samples, 1, lambda *values: sent.append(values) or values)
    assert len(sent) == 3
    for other, weight, what in (
        (samples, 1, None),
        (samples[:3], 1, "recordings"),
        (samples + 1e-9, 1, "recordings"),
        (samples, 2, "weights to begin with"),
    ):
        first, words = iter(sent), f"the processes have different {what}; (give|start) all"
        with pytest.raises(InputError, match=words) if what else contextlib.nullcontext():
            compare(other, weight, lambda *values, first=first: (*map(max, values, next(first)),))


def test_a_wrong_text_is_one_line():
    form = "must be HOST:PORT,PROCESSES,ID"
    for text, expected in (
        ("localhost:1,2", f"{form}, found 'localhost:1,2'; such as 10"),
        (":4321,2,0", form),
        ("localhost:port,2,0", form),
        ("localhost:4321,2,-1", form),
        ("localhost:4321,2,2", "gives this process the number 2 of 2; count the processes from 0"),
        ("localhost:99999,2,0", form),
        ("localhost:4321,1234567890123456789012,0", form),
        ("localhost:٤٣٢١,2,0", form),
    ):
        with pytest.raises(InputError, match=f"--distributed: {expected}") as refusal:
            parallel.initialise(text)
        assert "\n" not in str(refusal.value)


def test_one_process_meets_nobody(monkeypatch):
    monkeypatch.setattr(jax.distributed, "initialize", lambda *_, **__: pytest.fail("it meets"))
    for count in ("", "1"):
        monkeypatch.setenv("SLURM_STEP_NUM_TASKS", count)
        parallel.initialise()
    parallel.initialise("localhost:4321,1,0")
    monkeypatch.setattr(jax.config, "update", lambda *_: None)
    calls = []
    monkeypatch.setattr(jax.distributed, "initialize", lambda *args, **_: calls.append(args))
    monkeypatch.setenv("SLURM_STEP_NUM_TASKS", "2")
    parallel.initialise()
    parallel.initialise("localhost:4321,2,1")
    assert calls == [(), ("localhost:4321", 2, 1)]


def test_with_one_device_nothing_is_placed_nor_constrained():
    rows = jnp.arange(6)
    for limit in (1, None):  # a CPU is one device unless asked for more
        with parallel.sharing(limit):
            assert parallel.count() == 1 and parallel.describe() == "cpu"
            assert parallel.split(rows) is rows and parallel.replicate(rows) is rows
            assert parallel.copy_to_devices(np.arange(6)).sharding == rows.sharding
    with parallel.sharing(2):
        assert parallel.count() == 2 and parallel.describe() == "2 × cpu"
        assert parallel.copy_to_devices(np.arange(6)).sharding.spec == PartitionSpec()
