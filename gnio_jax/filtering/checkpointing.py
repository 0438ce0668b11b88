"""`lax.scan` with bounds on its backward pass: on its memory, and on how far it reaches."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp


def truncated_scan(
    step: Callable, carry: Any, inputs: Any, checkpoint_every: int, truncate_every: int
) -> tuple[Any, Any]:
    """`checkpointed_scan` that hands the carry on without gradient after every `truncate_every`-th
    step. 0 always hands it on with its gradient."""
    if truncate_every == 0:
        return checkpointed_scan(step, carry, inputs, checkpoint_every)

    def run_block(carry: Any, block: Any) -> tuple[Any, Any]:
        carry, out = checkpointed_scan(step, carry, block, checkpoint_every)
        return jax.lax.stop_gradient(carry), out

    blocks, rest = split_blocks(inputs, min(truncate_every, _length(inputs)))
    carry, out = jax.lax.scan(run_block, carry, blocks)
    if rest is None:
        return carry, join_blocks(out)
    carry, last = run_block(carry, rest)
    return carry, join_blocks(out, last)


def checkpointed_scan(step: Callable, carry: Any, inputs: Any, every: int) -> tuple[Any, Any]:
    """`lax.scan` whose backward pass keeps the carry of every `every`-th step only, and computes
    the steps between them again. 0 keeps every carry."""
    length = _length(inputs)
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
    length = _length(inputs)
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


def _length(inputs: Any) -> int:
    return jax.tree.leaves(inputs)[0].shape[0]
