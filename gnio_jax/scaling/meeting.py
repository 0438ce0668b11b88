"""Where the processes of a run meet, and what the options of a meeting must fulfil.

Does not import JAX, so that mistakes are told at once.
"""

from __future__ import annotations

import os
import socket
import time
from typing import NamedTuple

from gnio_jax.errors import InputError


class Meeting(NamedTuple):
    """Where the processes of a run meet, and how long they wait for each other."""

    coordinator: str | None = None
    """HOST:PORT at which process 0 listens; None: what Slurm, Open MPI or Kubernetes say."""
    processes: int | None = None
    process_id: int | None = None
    patience: int = 120
    """Seconds after which a process that does not come, or gives no sign of life, is given up."""


def launched() -> bool:
    """Whether Slurm, Open MPI or Kubernetes has started this process as one of several."""
    several = ("SLURM_STEP_NUM_TASKS", "OMPI_COMM_WORLD_SIZE")
    return "JOB_COMPLETION_INDEX" in os.environ or any(
        int(os.environ.get(name, 1)) > 1 for name in several
    )


def check(meeting: Meeting) -> None:
    """Raise `InputError` unless the options of a meeting are given together and fit."""
    named = {
        "--coordinator": meeting.coordinator,
        "--processes": meeting.processes,
        "--process-id": meeting.process_id,
    }
    missing = [name for name, value in named.items() if value is None]
    if meeting.patience < 1:
        raise InputError("--patience", f"must be at least 1, found {meeting.patience}")
    if len(missing) == 3:
        return
    if missing:
        given = next(name for name in named if name not in missing)
        raise InputError(given, f"is given without {' and '.join(missing)}", "give all three")
    assert meeting.coordinator and meeting.processes is not None
    assert meeting.process_id is not None
    if meeting.processes < 1:
        raise InputError("--processes", f"must be at least 1, found {meeting.processes}")
    if not 0 <= meeting.process_id < meeting.processes:
        problem = f"is {meeting.process_id}, but there are {meeting.processes} processes"
        raise InputError("--process-id", problem, "count them from 0")
    host, _, port = meeting.coordinator.rpartition(":")
    if not (host and port.isdecimal() and 0 < int(port) < 2**16):
        raise InputError("--coordinator", f"must be HOST:PORT, found '{meeting.coordinator}'")


def require_free(coordinator: str) -> None:
    """Raise `InputError` where another program listens at the port of process 0, e.g. another run.

    JAX would listen there too, take that run's processes away from it, and so end it.
    """
    listening(coordinator).close()


def listening(coordinator: str) -> socket.socket:
    """What listens at the port of process 0. Raises `InputError` where another program does."""
    address = ("", int(coordinator.rpartition(":")[2]))
    try:
        if socket.has_dualstack_ipv6():
            return socket.create_server(address, family=socket.AF_INET6, dualstack_ipv6=True)
        return socket.create_server(address)
    except OSError as error:
        problem = f"process 0 cannot listen there ({error.strerror})"
        remedy = "choose another port, for every process of this run"
        raise InputError(f"--coordinator {coordinator}", problem, remedy) from None


def wait_for(coordinator: str, patience: int) -> None:
    """Return once something listens there. Raises `InputError` when nothing does in time."""
    connected(coordinator, patience).close()


def connected(coordinator: str, patience: int) -> socket.socket:
    """A connection to what listens there. Raises `InputError` when nothing does in time."""
    host, _, port = coordinator.rpartition(":")
    until = time.monotonic() + patience
    while True:
        try:
            return socket.create_connection((host.strip("[]"), int(port)), timeout=5)
        except OSError as error:
            if time.monotonic() > until:
                problem = f"does not answer after {patience} s ({error.strerror or error})"
                remedy = "start process 0 there, or mend the address"
                raise InputError(f"--coordinator {coordinator}", problem, remedy) from None
            time.sleep(0.5)
