"""The command `gnio train`, for those who cloned the repository."""

import sys

from gnio_jax.commands import console, options


def main() -> None:
    options.run("train:train", options.Call("python train.py", sys.argv[1:]))


if __name__ == "__main__":  # processes that read recordings in parallel import this file again
    console.run(main)
