"""Odometry while the samples come: where they come from, the filter that follows, the screen."""

from gnio_jax.live.following import (
    Follower,
    create_tracker,
    follow,
    longest_untold,
    write_trajectory,
)
from gnio_jax.live.samples import Sample, Scale, parse_line
from gnio_jax.live.screen import drawing, line, shown
from gnio_jax.live.sources import Source, datagrams, from_recording, lines_of
from gnio_jax.live.units import checked_units, scale_of

__all__ = [
    "Follower",
    "Sample",
    "Scale",
    "Source",
    "checked_units",
    "create_tracker",
    "datagrams",
    "drawing",
    "follow",
    "from_recording",
    "line",
    "lines_of",
    "longest_untold",
    "parse_line",
    "scale_of",
    "shown",
    "write_trajectory",
]
