"""`python -m gnio_jax`: the same as `gnio`."""

from gnio_jax.commands.app import main

if __name__ == "__main__":  # processes that read recordings in parallel import this file again
    main()
