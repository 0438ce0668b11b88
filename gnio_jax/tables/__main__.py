"""`python -m gnio_jax.tables TABLE`: complexity, comparison, components and the others that
`--help` lists."""

import os

os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")

from gnio_jax.commands import console as cli
from gnio_jax.commands.tables import main

if __name__ == "__main__":
    cli.run(main)
