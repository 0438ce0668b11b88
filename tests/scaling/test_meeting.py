"""Options of a meeting that do not fit, and a coordinator that is not there."""

import socket
import threading
import time

import pytest

from gnio_jax.errors import InputError
from gnio_jax.scaling.gathering import gather
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


NESTED = b'{"":' * 1000 + b"\n"
"""JSON deeper than Python follows."""


def free_address():
    with socket.socket() as free:
        free.bind(("localhost", 0))
        return f"localhost:{free.getsockname()[1]}"


def gathered(*told, patience=20):
    """What becomes of processes that are told (run, processes, process id), in this order; None for
    those that met."""
    coordinator, ends = free_address(), [None] * len(told)

    def come(number, run, processes, process_id):
        try:
            gather(Meeting(coordinator, processes, process_id, patience), run)
        except InputError as error:
            ends[number] = str(error)

    threads = [threading.Thread(target=come, args=(k, *each)) for k, each in enumerate(told)]
    for thread in threads:
        thread.start()
        time.sleep(0.2)
    for thread in threads:
        thread.join(60)
    return ends


def test_the_processes_of_a_run_meet_whichever_comes_first():
    assert gathered(("a", 3, 2), ("a", 3, 0), ("a", 3, 1)) == [None] * 3


def test_a_process_of_another_run_is_told_and_does_no_harm():
    ends = gathered(("a", 2, 0), ("b", 2, 1), ("a", 2, 1))
    assert ends[::2] == [None, None]
    assert "process 0 there has other settings; choose another port" in ends[1]


def test_other_numbers_of_processes_are_told_to_both():
    """JAX would train with the smaller one."""
    first, other = gathered(("a", 2, 0), ("a", 3, 1))
    assert "process 0 was told --processes 2, process 1 was told 3; give all" in first
    assert "process 0 was told --processes 2, this one 3; give all of them the same" in other


def test_a_number_that_is_taken_is_told():
    ends = gathered(("a", 3, 0), ("a", 3, 1), ("a", 3, 1), ("a", 3, 2))
    assert ends[:2] == [None, None] and ends[3] is None
    assert "process 1 is there already; give each its own --process-id" in ends[2]


def test_nonsense_at_the_door_keeps_nobody_out():
    """A program that is no process of a run comes first."""
    address, ends = free_address(), [None, None]

    def come(process_id):
        try:
            gather(Meeting(address, 2, process_id, 20), "a")
        except Exception as error:
            ends[process_id] = error

    host, port = address.split(":")
    first = threading.Thread(target=come, args=(0,))
    first.start()
    wait_for(address, 10)
    with socket.create_connection((host, int(port))) as stranger:
        stranger.sendall(NESTED)
        other = threading.Thread(target=come, args=(1,))
        other.start()
        for thread in (first, other):
            thread.join()
    assert ends == [None, None]


def test_a_process_that_was_ended_may_come_once_more():
    """Nobody is met who has gone, and its number is free."""
    address, ends = free_address(), {}

    def come(process_id):
        try:
            gather(Meeting(address, 3, process_id, 20), "a")
            ends[process_id] = None
        except InputError as error:
            ends[process_id] = str(error)

    threads = [threading.Thread(target=come, args=(number,)) for number in range(3)]
    threads[0].start()
    wait_for(address, 10)
    host, port = address.split(":")
    with socket.create_connection((host, int(port))) as ended:
        ended.sendall(b'{"run": "a", "processes": 3, "process_id": 1}\n')
        time.sleep(0.3)
    for thread in threads[:0:-1]:
        thread.start()
        time.sleep(0.2)
    for thread in threads:
        thread.join(60)
    assert ends == {0: None, 1: None, 2: None}


def test_those_that_wait_in_vain_are_told():
    ends = gathered(("a", 3, 0), ("a", 3, 1), patience=2)
    assert all("did not all meet within 2 s; every one needs the same" in end for end in ends)


@pytest.mark.parametrize("answer", [b"\x00\x00\x06\x04\x00", b"", b"{}\n", b"{" * 5000, NESTED])
def test_a_run_that_has_begun_is_not_joined(answer):
    """Its coordinator, which is JAX's, listens there."""
    with socket.create_server(("localhost", 0)) as other:

        def serve():
            connection, _ = other.accept()
            connection.recv(4096)
            connection.sendall(answer)
            connection.close()

        threading.Thread(target=serve).start()
        meeting = Meeting(f"localhost:{other.getsockname()[1]}", 2, 1, 20)
        with pytest.raises(InputError, match=r"answers, but not as process 0 .* another port"):
            gather(meeting, "a")


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
