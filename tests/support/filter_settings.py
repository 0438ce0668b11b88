"""Settings of a filter with other numbers."""

import dataclasses

from gnio_jax.config import FilterSettings


def changed(settings=None, **sections):
    """The settings with the numbers of each section that are given:
    changed(noise={"gyro_density": 0.1})."""
    settings = settings or FilterSettings()
    parts = {
        name: getattr(settings, name)._replace(**numbers) for name, numbers in sections.items()
    }
    return dataclasses.replace(settings, **parts)
