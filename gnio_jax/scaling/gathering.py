"""How the processes of a run find out that they belong together, before JAX connects them.

JAX's coordinator takes whoever comes to its port. A process of another run would take the place of
one of its own, and processes that were told different numbers would train with the smaller one. So
process 0 first listens at that port itself. Every other process says what it was told and waits.
Once all have come, process 0 stops listening, tells them to go on, and JAX takes the port over.

A message is one line of JSON. Does not import JAX.
"""

from __future__ import annotations

import contextlib
import json
import socket
import time
from typing import Any, NamedTuple

from gnio_jax.errors import InputError
from gnio_jax.scaling.meeting import Meeting, connected, listening

ANSWER_SECONDS = 10.0
"""Longest time that process 0 waits for what a connection says: others that come meanwhile wait."""
LONGEST = 4096
"""Bytes of a message."""


class Said(NamedTuple):
    """What a process says when it comes."""

    run: str
    """What it runs: the same for all processes of a run."""
    processes: int
    process_id: int


def gather(meeting: Meeting, run: str) -> None:
    """Return once every process of the run `run` has met.

    Raises `InputError` where another program listens at the port of process 0, where not all come
    within the meeting's patience, and in a process that was told another number of processes, has
    the number of one that is there already, or is of another run.
    """
    assert meeting.coordinator and meeting.processes and meeting.process_id is not None
    own = Said(run, meeting.processes, meeting.process_id)
    until = time.monotonic() + meeting.patience
    if own.process_id == 0:
        _wait_for_all(meeting, own, until)
    else:
        _come(meeting, own, until)


# Process 0
# ------------------------------------------------------------------------------------------------


def _wait_for_all(meeting: Meeting, own: Said, until: float) -> None:
    with contextlib.ExitStack() as opened:
        port = opened.enter_context(listening(meeting.coordinator or ""))
        come: dict[int, socket.socket] = {}
        while len(come) < own.processes - 1:
            port.settimeout(max(0.01, until - time.monotonic()))
            try:
                connection, _ = port.accept()
            except OSError:
                for connection in come.values():
                    _send(connection, {"refused": "; ".join(_in_vain(meeting))})
                raise InputError(f"{meeting.coordinator}", *_in_vain(meeting)) from None
            opened.enter_context(connection)
            said = _heard(connection)
            # One that was ended meanwhile has left its number to the one that is started in its
            # place, and is not met.
            come = {number: other for number, other in come.items() if not _gone(other)}
            if said is None:
                continue
            problem = _problem(said, own, come)
            if problem is None:
                come[said.process_id] = connection
                continue
            _send(connection, {"refused": problem})
            if said.run == own.run and said.processes != own.processes:
                where = f"--coordinator {meeting.coordinator}"
                problem = f"process {said.process_id} was told {said.processes}"
                problem = f"process 0 was told --processes {own.processes}, {problem}"
                raise InputError(where, problem, "give all of them the same number")
        port.close()  # before they look for JAX's coordinator there
        for connection in come.values():
            _send(connection, {"refused": None})


def _heard(connection: socket.socket) -> Said | None:
    """What a connection says; None for nothing that makes sense, e.g. of a port scanner."""
    try:
        found = _received(connection, ANSWER_SECONDS)
        processes, process_id = (int(str(found[name])) for name in ("processes", "process_id"))
        return Said(str(found["run"]), processes, process_id)
    except (OSError, ValueError, KeyError):
        return None


def _gone(connection: socket.socket) -> bool:
    """Whether the other side has closed it: it says nothing more while it waits."""
    connection.settimeout(0.0)
    try:
        return not connection.recv(1, socket.MSG_PEEK)
    except BlockingIOError:
        return False
    except OSError:
        return True
    finally:
        connection.settimeout(ANSWER_SECONDS)


def _problem(said: Said, own: Said, come: dict[int, socket.socket]) -> str | None:
    """Why a process that says this cannot take part."""
    if said.run != own.run:
        return (
            "process 0 there has other settings; "
            "choose another port for another run, or give all processes the same options"
        )
    if said.processes != own.processes:
        return (
            f"process 0 was told --processes {own.processes}, this one {said.processes}; "
            "give all of them the same number"
        )
    if said.process_id in come or not 0 < said.process_id < own.processes:
        return (
            f"process {said.process_id} is there already; "
            "give each its own --process-id, and another run another port"
        )
    return None


# The others
# ------------------------------------------------------------------------------------------------


def _come(meeting: Meeting, own: Said, until: float) -> None:
    where = f"--coordinator {meeting.coordinator}"
    with connected(meeting.coordinator or "", meeting.patience) as connection:
        try:
            _send(connection, own._asdict())
            refused = _received(connection, max(1.0, until - time.monotonic()))["refused"]
        except TimeoutError:
            raise InputError(where, *_in_vain(meeting)) from None
        except (OSError, ValueError, KeyError):
            problem = "answers, but not as process 0 of a run that gathers"
            remedy = "choose another port if another run uses it; else see what process 0 says"
            raise InputError(where, problem, remedy) from None
    if refused:
        raise InputError(where, *str(refused).split("; ", 1))


def _in_vain(meeting: Meeting) -> tuple[str, str]:
    """What is said where not all come in time."""
    problem = f"did not all meet within {meeting.patience} s"
    return (
        problem,
        "every one needs the same --coordinator and --processes, and a --process-id of its own",
    )


# Messages
# ------------------------------------------------------------------------------------------------


def _send(connection: socket.socket, message: dict[str, Any]) -> None:
    """Where the other side has gone, nothing: it has said why."""
    with contextlib.suppress(OSError):
        connection.sendall(json.dumps(message).encode() + b"\n")


def _received(connection: socket.socket, patience: float) -> dict[str, Any]:
    """Raises `ValueError` for what is no message, and `TimeoutError`."""
    until, found = time.monotonic() + patience, b""
    while not found.endswith(b"\n"):
        connection.settimeout(max(0.01, until - time.monotonic()))
        more = connection.recv(LONGEST)
        found += more
        if not more or len(found) > LONGEST or not found.startswith(b"{"):
            raise ValueError("no message")
    try:
        return json.loads(found)
    except RecursionError:
        raise ValueError("no message") from None
