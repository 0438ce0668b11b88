"""Devices that share a batch: which ones, and how arrays lie on them.

Within `sharing` every device of every process holds the parameters and the recordings, and works on
its share of a batch. The compiler inserts the sums over devices: of the gradient, and of the
statistics of batch normalisation, which are those of the whole batch. With one device nothing
changes: the functions here then give back what they are given.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

from gnio_jax.errors import InputError

Tree = TypeVar("Tree")

BATCH, SEEDS = "batch", "seeds"
"""What devices share: the axis of the mesh."""
EVERYWHERE, ROWS = PartitionSpec(), PartitionSpec(BATCH)


def cpu_devices(count: int) -> None:
    """Let JAX see `count` devices on a CPU, unless a number is set already.

    Raises RuntimeError after JAX's first computation, when the devices are settled.
    """
    # JAX makes its settings when it is imported, so its types do not know this one.
    given = jax.config.jax_num_cpu_devices  # pyright: ignore[reportAttributeAccessIssue]
    if given >= 0 or "xla_force_host_platform_device_count" in os.environ.get("XLA_FLAGS", ""):
        return
    jax.config.update("jax_num_cpu_devices", count)


def chosen(limit: int | None = None) -> list[Any]:
    """The devices (`jax.Device`) of all processes that share a batch: `limit` of each, or all.

    Without a limit a CPU is one device, which uses all cores. Raises `InputError` where a process
    has fewer devices than `limit`, and for one below 1.
    """
    if limit is None and jax.default_backend() == "cpu":
        limit = 1
    if limit is not None and limit < 1:
        raise InputError("--devices", f"must be at least 1, found {limit}")
    found = []
    for process in range(jax.process_count()):
        own = jax.local_devices(process)
        if limit is not None and limit > len(own):
            problem = f"is {limit}, but process {process} has {len(own)}"
            raise InputError("--devices", problem, "lower it")
        found += own[:limit]
    return found


@contextmanager
def sharing(devices: Sequence[Any], what: str = BATCH) -> Iterator[None]:
    """Share batches, or the seeds of an experiment, out among `devices` while the context lasts."""
    if len(devices) == 1:
        yield
        return
    mesh = jax.make_mesh((len(devices),), (what,), (AxisType.Auto,), devices=devices)
    with jax.set_mesh(mesh):
        yield


def count(what: str = BATCH) -> int:
    """Devices that share a batch, or the seeds. Known while a program is compiled."""
    return jax.sharding.get_abstract_mesh().shape.get(what, 1)


def described() -> str:
    """The devices in words: "cpu", "8 × gpu", "16 × gpu in 2 processes"."""
    platform, processes = jax.devices()[0].platform, jax.process_count()
    number = f"{max(count(), count(SEEDS))} × " if max(count(), count(SEEDS)) > 1 else ""
    return f"{number}{platform}" + (f" in {processes} processes" if processes > 1 else "")


def check_batch(size: int, parts: int) -> None:
    """Raise `InputError` unless the devices can share each of the parts of a batch of `size`
    evenly."""
    if size // parts % count():
        whole = f"is {size}" + (f" in {parts} parts" if parts > 1 else "")
        problem = f"{whole}, which {count()} devices cannot share evenly"
        remedy = f"make it a multiple of {count() * parts}, or use fewer --devices"
        raise InputError("optim.batch_size", problem, remedy)


def fresh_copy(leaf: Any) -> jax.Array:
    """A copy of an array of the device or of the host.

    `jnp.array` compiles a program for each shape, so the many shapes of a network's state go by way
    of the host. Parts of recordings do not: JAX frees late what it shares with NumPy.
    """
    return jax.device_put(np.array(leaf)) if isinstance(leaf, jax.Array) else jnp.array(leaf)


def everywhere(tree: Tree) -> Tree:
    """Host arrays on each of the devices; every process must give the same ones, and nobody may
    write to them afterwards: on a CPU their memory may be shared."""
    mesh = jax.sharding.get_mesh()
    if mesh.empty:
        return jax.tree.map(fresh_copy, tree)
    return jax.tree.map(lambda leaf: _copied(leaf, mesh), tree)


def _copied(leaf: Any, mesh: Mesh) -> jax.Array:
    host = np.asarray(leaf)
    return jax.make_array_from_process_local_data(NamedSharding(mesh, EVERYWHERE), host, host.shape)


def one_each(tree: Tree) -> Tree:
    """Host arrays whose rows, one for each seed, are shared out among the devices. Nobody may write
    to them afterwards, as with `everywhere`."""
    mesh = jax.sharding.get_mesh()
    if mesh.empty:
        return jax.tree.map(fresh_copy, tree)
    return jax.device_put(tree, NamedSharding(mesh, PartitionSpec(SEEDS)))


def shared_out(tree: Tree) -> Tree:
    """In a compiled program: the rows of these arrays are shared out among the devices."""
    return _constrained(tree, ROWS)


def kept_everywhere(tree: Tree) -> Tree:
    """In a compiled program: each device has the whole of these arrays."""
    return _constrained(tree, EVERYWHERE)


def _constrained(tree: Tree, spec: PartitionSpec) -> Tree:
    if count() == 1:
        return tree
    return jax.tree.map(lambda leaf: jax.lax.with_sharding_constraint(leaf, spec), tree)
