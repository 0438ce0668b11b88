"""One page for one evaluation or track: map, strips over time, a slider, the table of measures.

`entry` is what the page is told of a run, `folders` reads it back from results, `curves` is what
the page shows of a sequence, `figures` draws it with Bokeh, `page` writes the file. Bokeh is
imported here, so import this folder only where a page is written.
"""

from gnio_jax.evaluation.html.entry import Entry, of_evaluation, windows_in_words
from gnio_jax.evaluation.html.folders import beside, read_entry
from gnio_jax.evaluation.html.page import render, write_report

__all__ = [
    "Entry",
    "beside",
    "of_evaluation",
    "read_entry",
    "render",
    "windows_in_words",
    "write_report",
]
