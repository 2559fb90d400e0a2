"""The stage of `plot`: the figures of any file of ours, by its format."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.files import vtkhdf
from lfpiv_cli.files.hdf5 import format_of, member, open_h5
from lfpiv_cli.flow.field import VectorField
from lfpiv_cli.pictures import vectors as of_vectors

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# What tells how good vectors are: arrays of the file that are drawn where they are known, by the figure's words.
QUALITIES = {
    "correlation": "correlation at the peak",
    "peak_ratio": "highest over second peak",
    "disagreement": "disagreement of the two fields (σ)",
    "valid_fraction": "share of the window in view",
}


@dataclass(frozen=True, eq=False)
class Drawn:
    """A figure that can be drawn: what it shows, in a sentence or two, and the function that draws it."""

    caption: str
    draw: Callable[[], Figure]


def figures_of(path: Path) -> dict[str, Drawn]:
    """Return the figures of a file of ours, by name in the order of display; nothing is drawn yet.

    Raises
    ------
    InputError : the file is missing, broken or of no format that has figures
    """
    return READERS[format_of(path)](path)


def _of_vectors(path: Path) -> dict[str, Drawn]:
    field = vtkhdf.open_vectors(path)
    figures = {
        "planes": Drawn(
            "Vectors in the three middle planes. Arrows show the components in the plane, colour the one across it; "
            "both have one scale in all three. Crosses are vectors that are missing.",
            partial(of_vectors.planes_figure, field),
        ),
        "components": Drawn(
            "Each velocity component in the three middle planes, a row and a scale for each.",
            partial(of_vectors.components_figure, field),
        ),
        "profiles": Drawn(
            "Means of each component over the planes across each axis. The band is the stated standard deviation of "
            "one vector to both sides.",
            partial(of_vectors.profiles_figure, field),
        ),
    }
    if field.uncertainty_voxel is not None and np.isfinite(field.uncertainty_voxel).any():
        figures["sigma"] = Drawn(
            "Stated standard deviation of each component in the three middle planes, all on one logarithmic scale.",
            partial(of_vectors.sigma_figure, field),
        )
    figures["flags"] = Drawn(
        "Where vectors are valid, taken from a second peak, replaced by their neighbours, rejected or masked.",
        partial(of_vectors.flags_figure, field),
    )
    qualities = _qualities(path, field)
    if qualities:
        figures["quality"] = Drawn(
            f"What else tells how good vectors are: {', '.join(qualities)}.",
            partial(of_vectors.quality_figure, field, qualities),
        )
    figures["displacements"] = Drawn(
        "Displacements of the valid vectors, and what they are beyond whole voxels: evenly spread unless they lock.",
        partial(of_vectors.displacements_figure, field),
    )
    if field.dt_s is not None:
        figures["gradients"] = Drawn(
            "Vorticity across the three middle planes, and the divergence, which is zero in a liquid: what it shows "
            "is the noise of gradients. One scale for both.",
            partial(of_vectors.gradients_figure, field),
        )
    return figures


def _qualities(path: Path, field: VectorField) -> dict[str, NDArray[np.float64]]:
    """Return what the file knows of the vectors' quality, by the words for it; not what is alike everywhere."""
    with open_h5(path) as file:
        found: dict[str, NDArray[Any]] = {
            words: np.asarray(member(file, name)).reshape(field.flag.shape)
            for name, words in QUALITIES.items()
            if name in file
        }
    return {words: values for words, values in found.items() if np.unique(values[np.isfinite(values)]).size > 1}


READERS: dict[str, Callable[[Path], dict[str, Drawn]]] = {
    vtkhdf.VECTORS_FORMAT: _of_vectors,
}
