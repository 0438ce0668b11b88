"""Other people's checkpoints."""

from gnio_jax.interop.tlio import load_tlio_state_dict, write_run

__all__ = ["load_tlio_state_dict", "write_run"]
