"""Runs side by side: what a change has changed, sequence by sequence, and how sure that is."""

from gnio_jax.comparison.comparing import Comparison, compare

__all__ = ["Comparison", "compare"]
