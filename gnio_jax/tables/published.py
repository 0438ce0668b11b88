"""Published errors of a trajectory, what each of them is, and the same as `ate`.

Five errors are called ATE in this field. Three of them are an `ate` of the same trajectory with
another divisor; the others cannot be converted without the trajectory.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Literal, NamedTuple

from gnio_jax.evaluation import tabulate
from gnio_jax.files import write_text
from gnio_jax.tables.experiments import PUBLISHED

Definition = Literal["distance", "coordinate", "of_length", "aligned", "window_frames", "unknown"]
NAMES = {"oxiod": "OxIOD", "ridi": "RIDI", "ronin": "RoNIN", "idol": "IDOL"}
"""Datasets of the paper's table II, as they are written."""
MEANINGS: dict[Definition, str] = {
    "distance": "RMSE of the distance",
    "coordinate": "RMSE of a coordinate",
    "of_length": "RMSE of the distance in % of the path",
    "aligned": "after a fit of the whole path",
    "window_frames": "sum of windows in their own frames",
    "unknown": "not known",
}
"""What is called ATE."""


class PublishedError(NamedTuple):
    """A figure of a publication."""

    dataset: str
    system: str
    figure: float
    """As printed: m, or for `of_length` %."""
    definition: Definition
    dimensions: Literal[2, 3]
    source: str


ERRORS = (
    PublishedError("TLIO", "TLIO, in EqNIO's paper", 1.722, "distance", 3, "ICLR 2025"),
    PublishedError("TLIO", "EqNIO, O(2) around TLIO", 1.433, "distance", 3, "ICLR 2025"),
    PublishedError("TLIO", "TLIO without filter, there", 3.079, "window_frames", 3, "ICLR 2025"),
    PublishedError("TLIO", "EqNIO without filter", 2.382, "window_frames", 3, "ICLR 2025"),
    PublishedError("TLIO", "TLIO, in Lie Events' paper", 1.410, "distance", 3, "NIO Lie Events"),
    PublishedError("TLIO", "Lie Events around TLIO", 1.282, "distance", 3, "NIO Lie Events"),
    PublishedError("TLIO", "SSIO, true attitude", 1.89, "distance", 3, "arXiv 2610.25988"),
    PublishedError("TLIO", "PedestrianDiffusion", 1.21, "coordinate", 3, "arXiv 2607.03349"),
    PublishedError("TLIO", "IONext, random split", 0.86, "of_length", 2, "arXiv 2507.17089"),
    PublishedError("TLIO", "TLIO, in GNIO's paper", 2.40, "unknown", 3, "GNIO"),
    PublishedError("TLIO", "GNIO", 1.66, "unknown", 3, "GNIO"),
    PublishedError("RoNIN unseen", "RIO's RoNIN", 5.57, "unknown", 2, "CVPR 2022"),
    PublishedError("RoNIN unseen", "RIO, joint", 5.02, "unknown", 2, "CVPR 2022"),
    PublishedError("RoNIN unseen", "EqNIO, O(2) around RoNIN", 4.42, "coordinate", 2, "ICLR 2025"),
    PublishedError("RoNIN unseen", "MambaIO", 4.48, "coordinate", 2, "arXiv 2511.15645"),
    PublishedError(
        "RoNIN unseen", "PedestrianDiffusion", 4.79, "coordinate", 2, "arXiv 2607.03349"
    ),
    PublishedError("RoNIN seen", "EqNIO, O(2) around RoNIN", 3.32, "coordinate", 2, "ICLR 2025"),
    PublishedError("RoNIN seen", "PedestrianDiffusion", 3.15, "coordinate", 2, "arXiv 2607.03349"),
    PublishedError("RoNIN", "IONext, random split", 1.03, "of_length", 2, "arXiv 2507.17089"),
    PublishedError("RIDI", "RIO with adaptation", 1.03, "aligned", 2, "CVPR 2022"),
    PublishedError("RIDI", "EqNIO, O(2) around RoNIN", 0.70, "coordinate", 2, "ICLR 2025"),
    PublishedError("RIDI", "MambaIO", 1.75, "coordinate", 2, "arXiv 2511.15645"),
    PublishedError("RIDI", "IONext, random split", 1.41, "of_length", 2, "arXiv 2507.17089"),
    PublishedError("OxIOD", "RIO with adaptation", 2.92, "aligned", 2, "CVPR 2022"),
    PublishedError("OxIOD", "EqNIO, O(2) around RoNIN", 1.28, "coordinate", 2, "ICLR 2025"),
    PublishedError("OxIOD", "MambaIO", 1.568, "coordinate", 2, "arXiv 2511.15645"),
    PublishedError("OxIOD", "IONext, random split", 0.49, "of_length", 2, "arXiv 2507.17089"),
    PublishedError("OxIOD seen", "IONet, in RoNIN's paper", 1.79, "unknown", 2, "RoNIN"),
    PublishedError("OxIOD unseen", "IONet, in RoNIN's paper", 2.63, "unknown", 2, "RoNIN"),
    PublishedError("IDOL", "TartanIMU", 4.32, "distance", 3, "CVPR 2025"),
    PublishedError("IDOL", "TLIO, in TartanIMU's paper", 6.96, "distance", 3, "CVPR 2025"),
    PublishedError("Blackbird seen", "AirIO and filter", 0.403, "distance", 3, "arXiv 2501.15659"),
    PublishedError(
        "Blackbird unseen", "AirIO and filter", 1.309, "distance", 3, "arXiv 2501.15659"
    ),
    PublishedError("EuRoC", "AirIO and filter", 3.177, "distance", 3, "arXiv 2501.15659"),
)
"""Figures of systems that the paper or `docs/compared.md` names. The split of one dataset is not
the same in all publications."""


def to_distance(
    figure: float,
    definition: Definition,
    dimensions: int,
    path_length: float | None = None,
) -> float | None:
    """The root mean square of the distance, m (`ate`, or in two dimensions `ate_2d`), of the
    trajectory that has this figure. None if it cannot be known: no path length, m, for a figure in
    % of it, or a definition that needs the trajectory itself."""
    match definition:
        case "distance":
            return figure
        case "coordinate":
            return math.sqrt(dimensions) * figure
        case "of_length" if path_length is not None:
            return 0.01 * figure * path_length
        case _:
            return None


def papers_errors() -> list[PublishedError]:
    """The figures of GNIO's paper (table II)."""
    return [
        PublishedError(f"{NAMES[dataset]} {split}", network, figure, "unknown", 3, "GNIO")
        for (dataset, split), figures in PUBLISHED.items()
        for network, figure in figures.items()
    ]


def render() -> str:
    """All figures as Markdown, by dataset."""
    rows = []
    for error in sorted([*ERRORS, *papers_errors()], key=lambda error: error.dataset.split()[0]):
        ours = to_distance(error.figure, error.definition, error.dimensions)
        unit = "%" if error.definition == "of_length" else "m"
        meaning = MEANINGS[error.definition]
        meaning += f", {error.dimensions}-D" if error.definition != "unknown" else ""
        printed = f"{error.figure:g} {unit}"
        rows.append([error.dataset, error.system, printed, meaning, tabulate.number(ours, 2)])
        rows[-1].append(error.source)
    header = ["dataset", "system", "printed", "what it is", "as ate or ate_2d (m)", "source"]
    return tabulate.markdown(header, rows)


def make_published(out: Path) -> str:
    """Write the table, and return the text to show."""
    text = (
        "## Published errors\n\nAs printed, and converted to the root mean square of the distance "
        "where that is possible. Splits, training data and attitudes differ: only a run of both "
        "on one machine compares two systems (gnio tables comparison). A figure after a fit of "
        "the whole path is smaller than without; windows in their own frames are no trajectory; "
        "GNIO's paper does not define its ATE.\n\n" + render()
    )
    path = out / "published.md"
    write_text(path, text)
    return f"{text}\nresults: {path}"
