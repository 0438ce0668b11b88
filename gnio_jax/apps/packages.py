"""The network of an application, by name, package or folder: `networks.load` under its first
name."""

from gnio_jax.networks import load as choose

__all__ = ["choose"]
