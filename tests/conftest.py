"""Shared set-up: float64 available, rank promotion forbidden, shapes and types checked at run time."""

import os

os.environ.setdefault("JAX_PLATFORMS", "cpu")

from jaxtyping import install_import_hook

install_import_hook(
    "gnio_jax", "beartype.beartype"
)  # every annotated shape and type is checked, in the tests alone

import jax  # noqa: E402
import pytest  # noqa: E402

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update(
    "jax_num_cpu_devices", 2
)  # what is shared out among devices is so on every machine


@pytest.fixture(scope="session")
def recordings():
    """The folder of real recordings, $GNIO_DATA/<name>; tests that ask for it are skipped, and say
    so, without it."""
    from pathlib import Path

    root = os.environ.get("GNIO_DATA")
    if not root or not Path(root).is_dir():
        pytest.skip(
            "real recordings: set GNIO_DATA to a folder that holds oxiod/, tlio_layout/, ..."
        )
    return Path(root)
