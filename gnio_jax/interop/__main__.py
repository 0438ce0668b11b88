"""`python -m gnio_jax.interop`: the same as `gnio interop`."""

from gnio_jax.commands import console
from gnio_jax.commands.interop import main

if __name__ == "__main__":  # processes that read recordings in parallel import this file again
    console.run(main)
