"""`python -m gnio_jax.data`: the same as `gnio data`."""

from gnio_jax.commands import console
from gnio_jax.commands.data import main

if __name__ == "__main__":  # processes that read recordings in parallel import this file again
    console.run(main)
