"""A trajectory from one's own recording: what `gnio track` does.

`run` walks from the recording to the folder of results: start, filter with the network in its loop,
files. `summary` says how far to trust the track.
"""

from gnio_jax.tracking.run import Tracked, track
from gnio_jax.tracking.summary import Summary

__all__ = ["Summary", "Tracked", "track"]
