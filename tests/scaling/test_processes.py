"""Runs in several processes on localhost: they compute what one process computes, they are stopped
and killed, and go on in another number of processes and devices."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from tests.support.tlio_files import write_splits

ROOT = Path(__file__).parents[2]
OPTIONS = (
    "--dataset tlio --data.rate 50 --model.name tiny --optim.epochs 2 --optim.batch-size 32 "
    "--optim.learning-rate 1e-3 --optim.warmup-epochs 1 --optim.statistics-windows 64"
).split()
STEPS = 6
"""Of an epoch."""
PATIENCE = 60
"""Seconds after which a process is given up."""
BRIEF = ("--patience", "5")
LIMIT = 300
"""Seconds after which a test gives up; the machine may be busy."""


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """A TLIO folder of three short walks."""
    return write_splits(tmp_path_factory.mktemp("tlio"))


class Server:
    """What starts the processes; all share what they compile."""

    def __init__(self, folder):
        environment = {**os.environ, "JAX_PLATFORMS": "cpu"}
        environment["GNIO_CACHE"] = str(folder / "recordings")
        environment.setdefault("JAX_COMPILATION_CACHE_DIR", str(folder / "cache"))
        self.folder, self.started = folder, 0
        self.process = subprocess.Popen(
            [sys.executable, "-m", "tests.support.training_server"],
            cwd=ROOT,
            env=environment,
            stdin=subprocess.PIPE,
            text=True,
            start_new_session=True,  # so that it ends with all that it has started
        )

    def start(self, module, *arguments):
        """Begin a process; returns the place of what it writes."""
        self.started += 1
        files = self.folder / str(self.started)
        asked = {"module": module, "arguments": list(arguments), "files": str(files)}
        self.process.stdin.write(json.dumps(asked) + "\n")
        self.process.stdin.flush()
        return files


def end_of(files):
    """(status, lines on stderr) of a process, once it has ended."""
    until = time.monotonic() + LIMIT
    while not files.with_suffix(".status").exists():
        assert time.monotonic() < until, files.with_suffix(".err").read_text()
        time.sleep(0.05)
    status = int(files.with_suffix(".status").read_text())
    return status, files.with_suffix(".err").read_text().splitlines()


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    found = Server(tmp_path_factory.mktemp("server"))
    yield found
    os.killpg(found.process.pid, signal.SIGKILL)
    found.process.wait()


class Group:
    """Processes that train together."""

    def __init__(self, recording, server, workdir, processes, devices, *more, **special):
        """special: what process k does otherwise, as `send={k: (signal, step)}`; `started`: how
        many of them begin at once, the others by `start_next`; `more_of={k: options}`."""
        self.began = time.monotonic()
        with socket.socket() as free:
            free.bind(("localhost", 0))
            port = free.getsockname()[1]
        self.coordinator = f"localhost:{port}"
        meeting = ["--coordinator", self.coordinator, "--processes", str(processes)]
        meeting += ["--patience", str(PATIENCE)]
        self.processes = []

        def start(k):
            name, step = special.get("send", {}).get(k, ("never", 0))
            command = [name, str(step), *OPTIONS]
            command += ["--data-root", str(recording), "--workdir", str(workdir)]
            command += [*meeting, "--process-id", str(k)] if processes > 1 else []
            command += ["--devices", str(devices), *more, *special.get("more_of", {}).get(k, ())]
            self.processes.append(server.start("training", *command))

        self.start_next = lambda: start(len(self.processes))
        for _ in range(special.get("started", processes)):
            self.start_next()

    def end(self):
        """(status, lines on stderr) of each process."""
        return [end_of(process) for process in self.processes]


@pytest.fixture(scope="module")
def run(recording, server):
    def start(*arguments, **special):
        return Group(recording, server, *arguments, **special)

    return start


def rows(workdir):
    return [json.loads(line) for line in (workdir / "metrics.jsonl").read_text().splitlines()]


def assert_same_run(workdir, other):
    """The losses of both, and what they have learnt."""
    ours, theirs = rows(workdir), rows(other)
    assert [row["step"] for row in ours] == [row["step"] for row in theirs]
    for name in ("loss", "val_loss", "val_mse", "val_nll"):
        np.testing.assert_allclose(
            [row[name] for row in ours], [row[name] for row in theirs], rtol=1e-4
        )


@pytest.fixture(scope="module")
def alone(run, tmp_path_factory):
    """One process with one device, uninterrupted."""
    workdir = tmp_path_factory.mktemp("alone") / "run"
    (end,) = run(workdir, 1, 1).end()
    assert end[0] == 0, end
    return workdir


@pytest.fixture(scope="module")
def incomplete(run, tmp_path_factory):
    """The first of two processes. It waits while other tests run."""
    workdir = tmp_path_factory.mktemp("incomplete") / "run"
    return workdir, run(workdir, 2, 4, "--patience", str(LIMIT), started=1)


def test_devices_change_nothing_but_rounding(run, incomplete, alone, tmp_path):
    (end,) = run(tmp_path / "run", 1, 8).end()
    assert end[0] == 0, end
    assert_same_run(tmp_path / "run", alone)


@pytest.mark.parametrize("processes, devices", [(1, 2), (2, 1)])
def test_recordings_on_the_disk_change_nothing_but_rounding(
    run, alone, tmp_path, processes, devices
):
    ends = run(tmp_path / "run", processes, devices, "--data.residency", "host").end()
    assert [status for status, _ in ends] == [0] * processes, ends
    assert_same_run(tmp_path / "run", alone)


def test_processes_that_do_not_belong_together_are_told(run, incomplete, tmp_path):
    """One of another run, and one that was told another number. Neither trains, nor do they harm
    the run that gathers at this port."""
    _, group = incomplete
    port = ("--coordinator", group.coordinator, "--processes", "2", "--process-id", "1")
    ((status, lines),) = run(tmp_path / "run", 1, 1, *port, "--optim.epochs", "3").end()
    assert status == 2 and len(lines) == 1, lines
    assert "process 0 there has other settings; choose another port" in lines[0]
    more = ("--processes", "3")
    told = run(tmp_path / "run", 2, 1, more_of={1: more}).end()
    assert [status for status, _ in told] == [2, 2], told
    assert "process 0 was told --processes 2, process 1 was told 3" in told[0][1][-1]
    assert "process 0 was told --processes 2, this one 3" in told[1][1][-1]
    assert not (tmp_path / "run").exists()


def test_processes_change_nothing_but_rounding(incomplete, alone):
    """Also where one starts 20 s late."""
    workdir, group = incomplete
    time.sleep(max(0, 20 - (time.monotonic() - group.began)))
    group.start_next()
    ends = group.end()
    assert [status for status, _ in ends] == [0, 0], ends
    assert not ends[1][1], "the first process alone speaks"
    assert_same_run(workdir, alone)


def test_a_run_goes_on_in_other_numbers_of_processes_and_devices(run, alone, tmp_path):
    """4 × 2 until one of them is sent SIGTERM, 2 × 1 until one of them is killed, then 1 × 1."""
    workdir = tmp_path / "run"
    every = ("--checkpoint-every-seconds", "0")
    stopped = run(workdir, 4, 2, send={2: ("SIGTERM", STEPS + 2)}).end()
    assert [status for status, _ in stopped] == [128 + signal.SIGTERM] * 4, stopped
    first = latest(workdir)
    assert first == STEPS + 2

    group = run(workdir, 2, 1, *every, *BRIEF, "--resume", send={1: ("SIGKILL", first + 2)})
    survivor, killed = group.end()
    assert killed[0] == -signal.SIGKILL
    assert survivor[0] == 1 and "start all of them again with --resume" in survivor[1][-1], survivor
    assert not any("Check failure" in line or "Traceback" in line for line in survivor[1])
    second = latest(workdir)
    assert first < second < 2 * STEPS  # saved after every step

    # What a process leaves that is killed while it saves.
    (workdir / "checkpoints" / "latest" / f"{second + 1}.orbax-checkpoint-tmp").mkdir()
    (end,) = run(workdir, 1, 1, *every, "--resume").end()
    assert end[0] == 0, end
    assert f"resuming at step {second}" in end[1]
    assert_same_run(workdir, alone)


def latest(workdir):
    (step,) = (workdir / "checkpoints" / "latest").glob("[0-9]*")
    return int(step.name)


def test_a_folder_that_cannot_be_written_ends_all(run, tmp_path):
    """Also those that write nothing."""
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "checkpoints").write_text("in the way")
    ends = run(tmp_path / "run", 2, 1).end()
    assert [status for status, _ in ends] == [2, 2], ends
    assert ends[1][1] == ["process 0: could not go on; its own line says why"]


def test_a_process_that_never_comes_is_given_up(run, tmp_path):
    """One that waits for another is told so in one line."""
    group = run(tmp_path / "run", 2, 1, *BRIEF, started=1)
    ((status, lines),) = group.end()
    assert status == 2
    assert len(lines) == 1 and "did not all meet within 5 s" in lines[0], lines
    assert time.monotonic() - group.began < LIMIT
    assert not (tmp_path / "run").exists()


def test_processes_share_sequences_and_each_has_all_results(server, tmp_path):
    """Four devices in two processes, and five sequences: in order, and the same ones."""
    with socket.socket() as free:
        free.bind(("localhost", 0))
        coordinator = f"localhost:{free.getsockname()[1]}"
    each = [
        server.start("sequences", coordinator, "2", str(k), str(tmp_path / f"{k}.npz"))
        for k in range(2)
    ]
    assert [end_of(files)[0] for files in each] == [0, 0]
    steps = np.random.default_rng(0).normal(size=(5, 7, 3)).astype(np.float32)
    for k in range(2):
        found = np.load(tmp_path / f"{k}.npz")
        np.testing.assert_allclose(found["path"], 2 * np.cumsum(steps, axis=1), rtol=1e-5)
        np.testing.assert_array_equal(found["largest"], steps.max(axis=(1, 2)))
        np.testing.assert_array_equal(found["one"], found["path"][:1])
