"""Five sequences through `over_sequences` in one of several processes; the result goes into a file.

python -m tests.support.sequences_process COORDINATOR PROCESSES PROCESS_ID FILE
"""

import sys

import numpy as np

from gnio_jax.scaling.devices import cpu_devices
from gnio_jax.scaling.meeting import Meeting
from gnio_jax.scaling.processes import meet, on_host, running


def main(coordinator, processes, process_id, file):
    cpu_devices(2)
    meet(Meeting(coordinator, int(processes), int(process_id)))
    import jax
    import jax.numpy as jnp

    from gnio_jax.filtering import over_sequences

    def walk(scale, steps):
        return scale * jnp.cumsum(steps, axis=0), jnp.max(steps)

    steps = np.random.default_rng(0).normal(size=(5, 7, 3)).astype(np.float32)
    with running():
        many = jax.jit(over_sequences(walk, shared=1))
        path, largest = on_host(many(np.float32(2), steps))
        one, _ = on_host(many(np.float32(2), steps[:1]))
    np.savez(file, path=path, largest=largest, one=one)


if __name__ == "__main__":
    main(*sys.argv[1:])
