"""The command `gnio train`, for those who cloned the repository."""

from gnio_jax.commands import console
from gnio_jax.commands.train import main

if __name__ == "__main__":  # processes that read recordings in parallel import this file again
    console.run(main)
