"""Trained networks: their folder on the disk (`folder`), and where they are found (`find`)."""

from gnio_jax.networks.find import (
    digest_corrector,
    find_network,
    list_networks,
    load,
    load_corrector,
    newest_run,
    with_corrector,
)
from gnio_jax.networks.folder import Card, TrainedNetwork, read_network, write_network

__all__ = [
    "Card",
    "TrainedNetwork",
    "digest_corrector",
    "find_network",
    "list_networks",
    "load",
    "load_corrector",
    "newest_run",
    "read_network",
    "with_corrector",
    "write_network",
]
