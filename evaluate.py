"""The command `gnio evaluate`, for those who cloned the repository."""

import sys

from gnio_jax.commands import console, options


def main() -> None:
    options.run("evaluate:evaluate", options.Call("python evaluate.py", sys.argv[1:]))


if __name__ == "__main__":  # processes that read recordings in parallel import this file again
    console.run(main)
