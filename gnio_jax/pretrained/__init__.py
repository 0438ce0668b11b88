"""Trained networks that are passed on: a package is made of a run, and loaded as one.

The way out: `publishing` takes a run, `card` describes it, `arrays` turns the weights into bytes,
`package` writes the files with their manifest. The way in: `finding` turns a name into a place,
`package` reads and checks it, `loading` makes a `Run`, `unpacking` the folder of one.
docs/weights.md has the format.
"""

from gnio_jax.pretrained.finding import default, find, packages
from gnio_jax.pretrained.loading import card_of, load_pretrained
from gnio_jax.pretrained.package import About, about
from gnio_jax.pretrained.publishing import Description, publish
from gnio_jax.pretrained.unpacking import write_run

__all__ = [
    "About",
    "Description",
    "about",
    "card_of",
    "default",
    "find",
    "load_pretrained",
    "packages",
    "publish",
    "write_run",
]
