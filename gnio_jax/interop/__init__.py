"""Other people's checkpoints."""

from gnio_jax.interop.layouts import load_state_dict
from gnio_jax.interop.run import write_run
from gnio_jax.interop.tlio import load_tlio_state_dict

__all__ = ["load_state_dict", "load_tlio_state_dict", "write_run"]
