"""Five sequences through `over_sequences` in one of several processes; the result goes into a file.

python -m tests.support.sequences_process HOST:PORT,PROCESSES,ID FILE
"""

import sys

import numpy as np

from gnio_jax import parallel


def main(distributed, file):
    parallel.initialise(distributed, devices=2)
    import jax
    import jax.numpy as jnp

    from gnio_jax.filtering import over_sequences

    def walk(scale, steps):
        return scale * jnp.cumsum(steps, axis=0), jnp.max(steps)

    steps = np.random.default_rng(0).normal(size=(5, 7, 3)).astype(np.float32)
    many = jax.jit(over_sequences(walk, shared=1))
    path, largest = parallel.on_host(many(np.float32(2), steps))
    one, _ = parallel.on_host(many(np.float32(2), steps[:1]))
    np.savez(file, path=path, largest=largest, one=one)


if __name__ == "__main__":
    main(*sys.argv[1:])
