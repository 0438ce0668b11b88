"""Options of a meeting that do not fit, and a coordinator that is not there."""

import socket
import time

import pytest

from gnio_jax.errors import InputError
from gnio_jax.scaling.meeting import Meeting, check, launched, require_free, wait_for


@pytest.mark.parametrize(
    "meeting, expected",
    [
        (Meeting("here:1"), "--coordinator: is given without --processes and --process-id"),
        (Meeting(None, 2, 0), "--processes: is given without --coordinator"),
        (Meeting("here:1", 2, 2), "--process-id: is 2, but there are 2 processes"),
        (Meeting("here:1", 2, -1), "--process-id: is -1"),
        (Meeting("here:1", 0, 0), "--processes: must be at least 1, found 0"),
        (Meeting("here", 2, 0), "--coordinator: must be HOST:PORT, found 'here'"),
        (Meeting("here:65536", 2, 0), "--coordinator: must be HOST:PORT, found 'here:65536'"),
        (Meeting("here:0", 2, 0), "--coordinator: must be HOST:PORT, found 'here:0'"),
        (Meeting(":80", 2, 0), "--coordinator: must be HOST:PORT, found ':80'"),
        (Meeting(patience=0), "--patience: must be at least 1, found 0"),
    ],
)
def test_what_does_not_fit_is_told(meeting, expected):
    with pytest.raises(InputError) as told:
        check(meeting)
    assert str(told.value).startswith(expected)


@pytest.mark.parametrize("meeting", [Meeting(), Meeting("here:1", 2, 1), Meeting("::1:80", 1, 0)])
def test_what_fits_is_taken(meeting):
    check(meeting)


def test_a_coordinator_that_is_not_there_is_told_in_time():
    with socket.socket() as unused:
        unused.bind(("localhost", 0))
        address = f"localhost:{unused.getsockname()[1]}"
    began = time.monotonic()
    with pytest.raises(InputError, match=r"does not answer after 1 s.*start process 0 there"):
        wait_for(address, 1)
    assert time.monotonic() - began < 30


def test_a_coordinator_that_listens_is_found():
    with socket.create_server(("localhost", 0)) as listening:
        wait_for(f"localhost:{listening.getsockname()[1]}", 1)


def test_a_port_that_another_run_listens_at_is_told():
    """JAX would share it, and end that run."""
    with socket.socket(socket.AF_INET6) as other:
        other.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
        other.bind(("::", 0))
        other.listen()
        address = f"localhost:{other.getsockname()[1]}"
        with pytest.raises(InputError, match=r"process 0 cannot listen there .* another port"):
            require_free(address)
    require_free(address)


@pytest.mark.parametrize(
    "environment, expected",
    [
        ({}, False),
        ({"SLURM_JOB_ID": "7", "SLURM_NTASKS": "4"}, False),  # a shell within an allocation
        ({"SLURM_STEP_NUM_TASKS": "1"}, False),
        ({"SLURM_STEP_NUM_TASKS": "4"}, True),
        ({"OMPI_COMM_WORLD_SIZE": "2"}, True),
        ({"JOB_COMPLETION_INDEX": "0"}, True),
    ],
)
def test_a_launcher_of_several_processes_is_known(monkeypatch, environment, expected):
    for name in ("SLURM_STEP_NUM_TASKS", "OMPI_COMM_WORLD_SIZE", "JOB_COMPLETION_INDEX"):
        monkeypatch.delenv(name, raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    assert launched() is expected
