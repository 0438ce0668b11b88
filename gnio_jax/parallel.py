"""Devices and processes that share a batch (docs/scaling.md).

Within `sharing` every device of every process holds the parameters and the recordings, and works on
its share of a batch. The compiler inserts the sums over devices for the gradient and for the
statistics of batch normalisation, which are those of the whole batch. With one device and one
process the functions here return their arguments.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import AxisType, NamedSharding, PartitionSpec

from gnio_jax.errors import InputError

Tree = TypeVar("Tree")

BATCH = "batch"
"""Name of the mesh's axis along which devices share a batch."""


def initialise(distributed: str | None = None, devices: int | None = None) -> None:
    """Connect this process with the others of its run, before JAX's first computation.

    distributed: "HOST:PORT,PROCESSES,ID": the address of process 0, the number of processes, and
    the number of this one. Slurm, Open MPI and Kubernetes provide this themselves; without either,
    the process runs alone. devices: the number of devices as which a CPU appears. Raises
    `InputError` for a text of another form, for less than one device, and for an address that
    cannot be used. If the others do not come within five minutes, JAX ends the process with a
    report of its own.
    """
    if devices is not None:
        _check_devices(devices)
        cpu_devices(devices)
    rendezvous: tuple[str, int, int] | None = None
    if distributed is not None:
        host_port, *numbers = distributed.split(",")
        host, _, port = host_port.rpartition(":")
        numeric = all(re.fullmatch("[0-9]{1,5}", number) for number in (port, *numbers))
        if not (host and len(numbers) == 2 and numeric and 0 < int(port) < 2**16):
            problem = f"must be HOST:PORT,PROCESSES,ID, found '{distributed}'"
            raise InputError("--distributed", problem, "such as 10.0.0.1:4321,2,0")
        rendezvous = host_port, int(numbers[0]), int(numbers[1])
        if not rendezvous[2] < rendezvous[1]:
            problem = f"gives this process the number {rendezvous[2]} of {rendezvous[1]}"
            raise InputError("--distributed", problem, "count the processes from 0")
    tasks = {os.environ.get(name) for name in ("SLURM_STEP_NUM_TASKS", "OMPI_COMM_WORLD_SIZE")}
    launched = "JOB_COMPLETION_INDEX" in os.environ or bool(tasks - {None, "", "1"})
    alone = rendezvous[1] == 1 if rendezvous else not launched
    if alone or jax.distributed.is_initialized():
        return
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    try:
        # A process that has failed must not wait five minutes for the others.
        jax.distributed.initialize(*rendezvous or (), shutdown_timeout_seconds=15)
    except (RuntimeError, ValueError) as error:
        problem = f"the processes did not meet ({' '.join(str(error).split())[:150]})"
        remedy = "give all of them the same HOST:PORT,PROCESSES and each an ID of its own"
        raise InputError("--distributed", problem, remedy) from None


def cpu_devices(count: int) -> None:
    """Let JAX see `count` devices on a CPU, unless a number is set already.

    Raises RuntimeError after JAX's first computation, when the number can no longer change.
    """
    # JAX makes its settings when it is imported, so its types do not know this one.
    current = jax.config.jax_num_cpu_devices  # pyright: ignore[reportAttributeAccessIssue]
    if current >= 0 or "xla_force_host_platform_device_count" in os.environ.get("XLA_FLAGS", ""):
        return
    jax.config.update("jax_num_cpu_devices", count)


# Processes
# ------------------------------------------------------------------------------------------------


def is_first() -> bool:
    """Whether this process is the one that writes files and prints lines."""
    return jax.process_index() == 0


def largest(*numbers: int) -> tuple[int, ...]:
    """The largest value over all processes, number by number. Numbers have 31 bits.

    So all processes get a value that only one of them had, such as its clock or a signal.
    """
    if jax.process_count() == 1:
        return numbers
    gathered: Any = multihost_utils.process_allgather(np.array(numbers, np.int32))
    return tuple(int(value) for value in gathered.max(axis=0))


def on_host(tree: Tree) -> Tree:
    """The whole results of a compiled program over all devices, in the memory of every process."""
    if jax.process_count() == 1:
        return jax.device_get(tree)
    return multihost_utils.process_allgather(tree, tiled=True)


# Devices
# ------------------------------------------------------------------------------------------------


def _check_devices(number: int) -> None:
    if number < 1:
        raise InputError("--devices", f"must be at least 1, found {number}")


@contextmanager
def sharing(limit: int | None = None) -> Iterator[None]:
    """Share batches among `limit` devices of each process, or among all of them.

    Without a limit a CPU is one device, which uses all cores. Raises `InputError` if a process has
    fewer devices than `limit`, and for a limit below 1.
    """
    if limit is None and jax.default_backend() == "cpu":
        limit = 1
    if limit is not None:
        _check_devices(limit)
    shared = []
    for process in range(jax.process_count()):
        local = jax.local_devices(process)
        if limit is not None and limit > len(local):
            problem = f"is {limit}, but process {process} has {len(local)}"
            raise InputError("--devices", problem, "lower it")
        shared += local[:limit]
    if len(shared) == 1:
        yield
        return
    mesh = jax.make_mesh((len(shared),), (BATCH,), (AxisType.Auto,), devices=shared)
    with jax.set_mesh(mesh):
        yield


def count() -> int:
    """The number of devices that share a batch. It is known while a program is compiled."""
    return jax.sharding.get_abstract_mesh().shape.get(BATCH, 1)


def describe() -> str:
    """The devices in words: "cpu", "8 × gpu", "16 × gpu in 2 processes"."""
    platform, processes = jax.devices()[0].platform, jax.process_count()
    number = f"{count()} × " if count() > 1 else ""
    return f"{number}{platform}" + (f" in {processes} processes" if processes > 1 else "")


def copy_to_devices(tree: Tree) -> Tree:
    """Copy host arrays to each of the devices.

    Every process must give the same arrays. They must not be written to afterwards: on a CPU the
    memory may be shared.
    """
    mesh = jax.sharding.get_mesh()

    def place_leaf(leaf: Any) -> jax.Array:
        if mesh.empty:
            return fresh_copy(leaf)
        host = np.asarray(leaf)
        sharding = NamedSharding(mesh, PartitionSpec())
        return jax.make_array_from_process_local_data(sharding, host, host.shape)

    return jax.tree.map(place_leaf, tree)


def fresh_copy(leaf: Any) -> jax.Array:
    """A copy of an array that is bound to no device, so that any compiled step takes it.

    `jnp.array` compiles a program for each shape, so the many shapes of a network's state go
    through the host. Parts of recordings do not, because JAX is late to free memory that it shares
    with NumPy.
    """
    return jax.device_put(np.array(leaf)) if isinstance(leaf, jax.Array) else jax.numpy.array(leaf)


def split(tree: Tree) -> Tree:
    """In a compiled program: share the rows of these arrays among the devices."""
    return _constrain(tree, PartitionSpec(BATCH))


def replicate(tree: Tree) -> Tree:
    """In a compiled program: give each device the whole of these arrays."""
    return _constrain(tree, PartitionSpec())


def _constrain(tree: Tree, spec: PartitionSpec) -> Tree:
    if count() == 1:
        return tree
    return jax.tree.map(lambda leaf: jax.lax.with_sharding_constraint(leaf, spec), tree)
