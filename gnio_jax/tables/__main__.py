"""`python -m gnio_jax.tables`: the same as `gnio tables`."""

from gnio_jax.commands import console
from gnio_jax.commands.tables import main

if __name__ == "__main__":  # processes that read recordings in parallel import this file again
    console.run(main)
