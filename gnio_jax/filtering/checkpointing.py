"""`lax.scan` with a bound on the memory of its backward pass: time for memory."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp


def checkpointed_scan(step: Callable, carry: Any, inputs: Any, every: int) -> tuple[Any, Any]:
    """`lax.scan` whose backward pass keeps the carry of every `every`-th step only, and computes
    the steps between them again. 0 keeps every carry."""
    length = jax.tree.leaves(inputs)[0].shape[0]
    if every == 0 or every >= length:
        return jax.lax.scan(step, carry, inputs)
    blocks, rest = split_blocks(inputs, every)
    run_block = jax.checkpoint(
        lambda carry, block: jax.lax.scan(step, carry, block), prevent_cse=False
    )
    carry, out = jax.lax.scan(run_block, carry, blocks)
    if rest is None:
        return carry, join_blocks(out)
    carry, last = jax.lax.scan(step, carry, rest)
    return carry, join_blocks(out, last)


def split_blocks(inputs: Any, every: int) -> tuple[Any, Any]:
    """Leaves (K, …) as whole blocks (K // every, every, …), and the rows left over or None."""
    length = jax.tree.leaves(inputs)[0].shape[0]
    count = length // every
    whole = count * every
    blocks = jax.tree.map(lambda x: x[:whole].reshape(count, every, *x.shape[1:]), inputs)
    return blocks, jax.tree.map(lambda x: x[whole:], inputs) if length > whole else None


def join_blocks(blocks: Any, rest: Any = None) -> Any:
    """The rows of all blocks in order, and the rows left over behind them."""
    joined = jax.tree.map(lambda x: x.reshape(x.shape[0] * x.shape[1], *x.shape[2:]), blocks)
    if rest is None:
        return joined
    return jax.tree.map(lambda x, y: jnp.concatenate([x, y]), joined, rest)
