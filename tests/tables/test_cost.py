"""What a table's networks cost, measured once."""

import dataclasses
import json
import os

import pytest

from gnio_jax import cores
from gnio_jax.config import TablesConfig, TrainConfig
from gnio_jax.evaluation import speed
from gnio_jax.networks import read_network
from gnio_jax.reporting import Lines
from gnio_jax.tables import cost, experiments, make
from tests.support import tiny_run
from tests.support.networks import count


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run of the smallest network at 50 Hz."""
    with tiny_run.registry_entry():
        config = dataclasses.replace(tiny_run.CONFIGURED, data=tiny_run.config(None, "x").data)
        yield tiny_run.save(tmp_path_factory.mktemp("cost") / "tiny_s0", config)


@pytest.mark.skipif(not cores.can_choose_cores(), reason="the system does not let one choose")
def test_an_interval_has_the_median_of_the_runs_over_a_walk(run, monkeypatch):
    """On one core, which the process leaves afterwards."""
    trained, calls = read_network(run), []
    real = speed.estimate

    def estimate(recordings, *arguments):
        affinity = {os.sched_getaffinity(int(name)) == {min(usable)} for name in threads()}
        calls.append((recordings[0].strides, affinity))
        assert arguments[-1].considered is None  # which is computed after the filter
        return real(recordings, *arguments)

    def threads():
        return os.listdir("/proc/self/task")

    usable = os.sched_getaffinity(0)
    clock = iter([0.0, 1.0, 1.0, 1.2, 1.2, 1.5, 1.5, 1.9, 1.9, 4.9])
    monkeypatch.setattr(speed.time, "perf_counter", lambda: next(clock))
    monkeypatch.setattr(speed, "estimate", estimate)
    seconds = speed.interval_seconds(trained)
    strides = calls[0][0]
    assert strides == pytest.approx(300, abs=1)
    assert seconds == pytest.approx(0.4 / strides)
    assert len(calls) == 6 and all(pinned == {True} for _, pinned in calls[1:])
    assert {frozenset(os.sched_getaffinity(int(name))) for name in threads()} == {frozenset(usable)}


def refuse_cores(*_):
    raise PermissionError(1, "Operation not permitted")


@pytest.mark.parametrize("lacking", ["the call", "the permission", "the list of threads"])
def test_where_cores_cannot_be_chosen_all_are_used_and_no_note_says_one(
    lacking, monkeypatch, tmp_path
):
    """As on macOS, or in a container."""
    for name in ("sched_setaffinity", "sched_getaffinity"):
        if lacking == "the call":
            monkeypatch.delattr(os, name, raising=False)
    if lacking == "the permission":
        monkeypatch.setattr(os, "sched_setaffinity", refuse_cores, raising=False)
    if lacking == "the list of threads":
        monkeypatch.setattr(cores, "THREADS", tmp_path / "task")
    assert not cores.can_choose_cores() and cores.usable_cores() >= 1
    with cores.one_core():
        pass
    base = TrainConfig(dataset="tlio")
    options = TablesConfig("comparison")
    text = make.notes(base, options, experiments.comparison(base, "tlio", "test", ()))
    assert "ms / interval" in text and "on one core" not in text


def test_a_cost_is_measured_once_for_a_device(run, monkeypatch, capsys):
    times = iter([0.002, 0.003, 0.004, 0.005])
    monkeypatch.setattr(cost, "interval_seconds", lambda trained: next(times))
    first = cost.load_or_measure(run, Lines())
    assert first.interval_ms == pytest.approx(2.0)
    assert first.parameters == count(read_network(run).variables["params"])
    assert cost.load_or_measure(run, Lines()) == first
    assert capsys.readouterr().err == "timing tiny_s0 with the filter\n"
    file = run / cost.FILE
    file.write_text(json.dumps(first._replace(device="TPU")._asdict()))
    assert cost.load_or_measure(run, Lines()).interval_ms == pytest.approx(3.0)
    monkeypatch.setattr(cost, "processor_name", lambda: "another CPU")
    assert cost.load_or_measure(run, Lines()).interval_ms == pytest.approx(4.0)
    file.write_text('{"parameters": 3}')
    assert cost.load_or_measure(run, Lines()).interval_ms == pytest.approx(5.0)


def test_a_processor_has_its_name_where_the_system_has_one(tmp_path, monkeypatch):
    monkeypatch.setattr(cores, "CPU_INFO", tmp_path / "cpuinfo")
    monkeypatch.setattr(cores.platform, "processor", lambda: "")
    monkeypatch.setattr(cores.platform, "machine", lambda: "aarch64")
    assert cores.processor_name() == "aarch64"  # there is no such file
    (tmp_path / "cpuinfo").write_text("processor\t: 0\nBogoMIPS\t: 38.4\nmodel name\t:\n")
    assert cores.processor_name() == "aarch64"
    (tmp_path / "cpuinfo").write_text("processor\t: 0\nmodel name\t: Xeon: 2.1 GHz\n")
    assert cores.processor_name() == "Xeon: 2.1 GHz"
