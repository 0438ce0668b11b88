"""Other people's checkpoints."""

from gnio_jax.interop.tlio import ImportOptions, load_tlio_state_dict, write_run

__all__ = ["ImportOptions", "load_tlio_state_dict", "write_run"]
