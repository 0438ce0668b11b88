"""The page of an evaluation or a track: one file, which a browser opens without a network."""

from __future__ import annotations

from importlib import resources
from pathlib import Path
from typing import NamedTuple

import numpy as np
from bokeh.document import Document
from bokeh.embed import components
from bokeh.models import ColumnDataSource, CustomJS
from bokeh.resources import Resources
from jaxtyping import Float
from jinja2 import Environment

from gnio_jax.evaluation.estimators.result import Estimate
from gnio_jax.evaluation.html import figures
from gnio_jax.evaluation.html.curves import curves
from gnio_jax.evaluation.html.entry import Entry, Figures, cell, shown
from gnio_jax.evaluation.table import COLUMNS
from gnio_jax.evaluation.trajectory import Trajectory
from gnio_jax.files import write_text

ROWS, FEWEST_ROWS = 9000, 150
"""Rows that a page holds, over all runs and sequences, and those that a sequence has at least.
Fifteen minutes at ten rows a second are whole; what is longer is thinned."""


DETAILS = {"nis", *(f"{name}_x" for name in figures.PER_AXIS)}
"""Columns that network or filter make."""


class Row(NamedTuple):
    """One line of the table of measures."""

    place: int | None
    """Of its sequence among the page's; None in lines about all of them."""
    name: str
    run: str
    colour: str
    cells: list[str]


def write_report(path: Path, title: str, entries: list[Entry]) -> None:
    """Write the page of some runs of the same recordings, whole or not at all.

    The first run gives the sequences. A run that lacks one of them has no curve there. At most
    `len(figures.RUNS)` runs are shown.
    """
    write_text(path, render(title, entries[: len(figures.RUNS)]))


def render(title: str, entries: list[Entry]) -> str:
    """The page as text. It loads nothing, and its policy forbids it to."""
    sequences = [estimate.name for estimate in entries[0].estimates]
    runs = [entry.name for entry in entries]
    held = _columns(entries, sequences)
    names = {name for of_run in held for one in of_run for name in one}
    with_reference = any(np.isfinite(one["reference_x"]).any() for one in held[0])
    sources = figures.sources(runs, names)
    drawn = figures.draw(runs, sources, names, with_reference)
    document = _document(drawn, sources, held, names)
    script, (plan, distance, strips) = components(document.roots)
    first = entries[0].about
    page = Environment(autoescape=True).from_string(_file("page.html"))
    return page.render(
        title=title,
        subtitle="; ".join(f"{name}: {text}" for name, text in first.items() if name != "command"),
        command=first.get("command"),
        sequences=sequences,
        runs=[
            {**entry._asdict(), "colour": colour}
            for entry, colour in zip(entries, figures.RUNS, strict=False)
        ],
        detailed=_detailed(held),
        headings=[COLUMNS[metric] for metric in shown(entries)],
        measures=_measures(entries, sequences),
        map=plan,
        distance=distance,
        strips=strips,
        library=Resources(mode="inline", components=["bokeh"]).render_js(),
        script=script,
    )


def _columns(
    entries: list[Entry], sequences: list[str]
) -> list[list[dict[str, Float[np.ndarray, "k"]]]]:
    """Of every run, the columns of every sequence; a single empty row where it has none."""
    rows = max(FEWEST_ROWS, ROWS // (len(entries) * len(sequences)))
    nowhere = Trajectory(np.zeros(1), np.full((1, 3), np.nan), np.full((1, 4), np.nan))
    missing = Estimate("", nowhere, nowhere)
    found = []
    for entry in entries:
        of_name = {estimate.name: estimate for estimate in entry.estimates}
        of_run = [of_name.get(name, missing) for name in sequences]
        found.append([figures.columns(curves(one, entry.alignment, rows)) for one in of_run])
    return found


def _detailed(held: list[list[dict[str, np.ndarray]]]) -> list[int]:
    """Places of the runs that have curves of network or filter; the first where none has."""
    places = [k for k, of_run in enumerate(held) if any(DETAILS & one.keys() for one in of_run)]
    return places or [0]


def _document(drawn: figures.Figures, shown: figures.Sources, held: list, names: set) -> Document:
    """Bokeh's document: the figures, and the script that fills them when they are drawn."""
    document = Document()
    for root in (drawn.map, drawn.distance, drawn.strips):
        document.add_root(root)
    arguments = {
        **shown._asdict(),
        "columns": [[ColumnDataSource(one) for one in of_run] for of_run in held],
        "names": sorted(names),
        "plan": drawn.map,
        "times": drawn.times,
        "distances": drawn.distance.x_range,
    }
    start = CustomJS(args=arguments, code=_file("follow.js"))
    document.js_on_event("document_ready", start)
    return document


# The table
# --------------------------------------------------------------------------------------------------


def _measures(entries: list[Entry], sequences: list[str]) -> list[Row]:
    """A line for each sequence and run, then those about all sequences."""
    metrics, colours = (
        shown(entries),
        dict(zip([e.name for e in entries], figures.RUNS, strict=False)),
    )

    def line(place: int | None, name: str, run: str, values: Figures) -> Row:
        cells = [cell(values.get(metric), COLUMNS[metric].digits) for metric in metrics]
        return Row(place, name, run, colours[run], cells)

    rows = [
        line(place, name, entry.name, entry.figures[name])
        for place, name in enumerate(sequences)
        for entry in entries
        if name in entry.figures
    ]
    below = dict.fromkeys(name for entry in entries for name in entry.summary)
    rows += [
        line(None, name, entry.name, entry.summary[name])
        for name in below
        for entry in entries
        if name in entry.summary
    ]
    return rows


def _file(name: str) -> str:
    """A file of this folder."""
    return resources.files(__package__).joinpath(name).read_text(encoding="utf-8")
