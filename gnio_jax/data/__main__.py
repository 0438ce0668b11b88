"""`python -m gnio_jax.data list | check | convert | import`: what there is, whether it is sound,
and how it comes into one form."""

from gnio_jax.commands import console as cli
from gnio_jax.commands.data import main

if __name__ == "__main__":  # the processes that `convert` starts import this file again
    cli.run(main)
