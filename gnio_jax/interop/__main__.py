"""`python -m gnio_jax.interop CHECKPOINT WORKDIR`: a run of TLIO's published weights."""

from gnio_jax.commands import console as cli
from gnio_jax.commands.interop import main

if __name__ == "__main__":
    cli.run(main)
