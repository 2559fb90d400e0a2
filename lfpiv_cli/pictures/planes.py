"""The three middle planes of what lives on a grid, side by side at one length per mm.

Axes: arrays [z, y, x], vectors (u, v, w) along (x, y, z) last; in pictures the first axis of a plane points right, the
second up. An even number of cells has no middle one: the next after the middle is shown, and the title says where.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from numpy.typing import NDArray

from lfpiv_cli.grid import Grid
from lfpiv_cli.pictures.style import AXIS_NAMES, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# The width of the three planes together, and the least and largest height of a row of them, in inches.
ROW_WIDTH, LEAST_HEIGHT, LARGEST_HEIGHT = 9.0, 1.9, 4.2
# What titles, labels and scales take beside the planes, in inches.
MARGIN_WIDTH, MARGIN_HEIGHT = 2.2, 0.9


class Plane(NamedTuple):
    """A plane by its axes (0 for x): the one that points right, and the one that points up."""

    right: int
    up: int

    @property
    def normal(self) -> int:
        """The axis that the plane lies across."""
        return 3 - self.right - self.up

    @property
    def name(self) -> str:
        """Its axes' names, for instance x-z."""
        return f"{AXIS_NAMES[self.right]}-{AXIS_NAMES[self.up]}"

    def of(self, values: NDArray[Any]) -> NDArray[Any]:
        """Return the middle plane of an array [z, y, x, ...] as [up, right, ...]."""
        along = 2 - self.normal
        return values.take(values.shape[along] // 2, axis=along)

    def place_mm(self, grid: Grid) -> float:
        """Return where the middle plane lies on its normal."""
        return float(grid.axis_mm(self.normal)[grid.shape_xyz[self.normal] // 2])

    def extent(self, grid: Grid) -> tuple[float, float, float, float]:
        """Return the outer faces: left, right, bottom, top, mm."""
        return (*grid.bounds_mm(self.right), *grid.bounds_mm(self.up))


PLANES = (Plane(0, 1), Plane(0, 2), Plane(1, 2))


def plane_panels(grid: Grid, rows: int = 1) -> tuple[Figure, NDArray[Any]]:
    """Return a figure with rows of three panels, one for each plane, as wide as their parts of the grid."""
    sizes = [high - low for low, high in map(grid.bounds_mm, range(3))]
    widths = [sizes[plane.right] for plane in PLANES]
    tallest = ROW_WIDTH * max(sizes[plane.up] for plane in PLANES) / sum(widths)
    height = MARGIN_HEIGHT + min(max(tallest, LEAST_HEIGHT), LARGEST_HEIGHT)
    figure = new_figure(ROW_WIDTH + MARGIN_WIDTH, rows * height)
    return figure, figure.subplots(rows, 3, squeeze=False, width_ratios=widths)


def label_plane(axes: Axes, grid: Grid, plane: Plane, what: str = "") -> None:
    """Name a panel's axes, and in its title what it shows and where the plane lies."""
    place = f"{plane.name} at {AXIS_NAMES[plane.normal]} = {plane.place_mm(grid):z.2f} mm"
    left, right, bottom, top = plane.extent(grid)
    axes.set(
        xlabel=f"{AXIS_NAMES[plane.right]} (mm)",
        ylabel=f"{AXIS_NAMES[plane.up]} (mm)",
        title=f"{what}\n{place}" if what else place,
        xlim=(left, right),
        ylim=(bottom, top),
        aspect="equal",
    )


def draw_maps(
    row: Sequence[Axes], grid: Grid, maps: Sequence[NDArray[Any]], titles: Sequence[str], **scale: Any
) -> Any:
    """Draw the middle planes of three arrays [z, y, x] (of one, given three times) as maps on one scale.

    Returns the last image, for the scale; unknown values stay blank.
    """
    for axes, plane, values, title in zip(row, PLANES, maps, titles, strict=True):
        image = axes.imshow(
            plane.of(values), origin="lower", extent=plane.extent(grid), interpolation="nearest", **scale
        )
        label_plane(axes, grid, plane, title)
    return image
