"""The command `gnio evaluate`, for those who cloned the repository."""

import os

os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")

from gnio_jax.commands import console as cli
from gnio_jax.commands.evaluate import main

if __name__ == "__main__":
    cli.run(main)
