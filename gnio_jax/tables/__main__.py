"""`python -m gnio_jax.tables complexity | comparison | components | gates | bank-size | uncertainty | trajectories | standing`."""

import os

os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")

from gnio_jax import cli
from gnio_jax.tables.commands import main

if __name__ == "__main__":
    cli.run(main)
