"""What each kind of result does in Python: how it is written, drawn, converted and described, in one table."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lfpiv_cli.errors import UsageError
from lfpiv_cli.files import particle_file
from lfpiv_cli.files.export_formats import Content, columns_of, content_of
from lfpiv_cli.files.pages import ensure_drawing, package
from lfpiv_cli.files.particle_file import PARTICLES_FORMAT, POSITION, TRACKS_FORMAT, TRAJECTORIES_FORMAT, Points
from lfpiv_cli.files.vtkhdf import VECTORS_FORMAT, VOLUME_FORMAT, Volume, write_vectors, write_volume
from lfpiv_cli.flow.field import VectorField
from lfpiv_cli.grid import Grid, Reference
from lfpiv_cli.notice import written
from lfpiv_cli.results import Result

# For signatures: to describe a field must not load what calibrates, weighs and draws.
if TYPE_CHECKING:
    from lfpiv_cli.calibration.model import Calibration
    from lfpiv_cli.files.weights_file import WeightsFile
    from lfpiv_cli.flow.combining import Combined
    from lfpiv_cli.verbs.fields import Extra, FittedField
    from lfpiv_cli.verbs.moments import FlowStatistics
    from lfpiv_cli.verbs.tracks import Tracked

# What a result has many of, by its format.
NOUNS = {
    VOLUME_FORMAT: "voxels",
    VECTORS_FORMAT: "vectors",
    PARTICLES_FORMAT: "particles",
    TRACKS_FORMAT: "tracks",
    TRAJECTORIES_FORMAT: "places of tracks",
}
# Arrays whose medians say most of a result; of those that it has, the first few.
MEDIANS_OF, MOST_MEDIANS = ("velocity", "velocity_rms", "velocity_sigma", "intensity", "uncertainty_voxel", "chi2"), 3


@dataclass(frozen=True)
class Kind:
    """What a kind of result does.

    Attributes
    ----------
    write : into a file, and whether one that is there is replaced
    figures : the function of `verbs.plot` that gives the figures of its file, and what this is given
    content : its arrays, None where it is not one of arrays
    describe : in words; of arrays, None: their extent and medians
    """

    write: Callable[[Any, Path, bool], None]
    figures: Callable[[Any], tuple[str, tuple[Any, ...]]]
    content: Callable[[Any], Content] | None = None
    describe: Callable[[Any], str] | None = None


@dataclass(frozen=True, eq=False)
class Vectors:
    """A field with what the file of a kind of vectors holds besides."""

    field: VectorField
    extra: Extra
    tables: Mapping[str, Extra]
    attributes: Mapping[str, Any]

    @classmethod
    def of(cls, result: VectorField | FittedField | Combined | FlowStatistics) -> Vectors:
        """Return what the file of a result holds."""
        found: Any = result
        kind = type(result).__name__
        if kind == "FlowStatistics":
            return cls(found.mean, found.arrays(), found.tables(), found.attributes())
        if kind == "Combined":
            return cls(found.field, found.arrays(), {}, {})
        return cls(found.vectors() if kind == "FittedField" else found, {}, {}, {})

    def write(self, path: Path, overwrite: bool) -> None:
        """Write the file."""
        write_vectors(
            path,
            self.field,
            self.field.reference,
            provenance=self.field.provenance,
            overwrite=overwrite,
            extra=self.extra,
            attributes=self.attributes,
            tables=self.tables,
        )

    def figures(self) -> tuple[Any, ...]:
        """Return what the figures of the file are of."""
        tables = {name: _without_units(table) for name, table in self.tables.items()}
        return self.field, _without_units(self.extra), tables, self.attributes

    def content(self) -> Content:
        """Return all arrays."""
        return content_of(self.field, self.extra, self.attributes)


def _without_units(arrays: Extra) -> dict[str, NDArray[Any]]:
    return {name: array for name, (array, _) in arrays.items()}


def _write_volume(volume: Volume, path: Path, overwrite: bool) -> None:
    arrays = volume.array, volume.grid, volume.reference
    write_volume(path, *arrays, provenance=volume.provenance, attributes=volume.attributes, overwrite=overwrite)


def _points_of(result: Points | Tracked) -> Points:
    return result if isinstance(result, Points) else result.points


# The functions of `verbs.plot` for points.
OF_POINTS = {PARTICLES_FORMAT: "of_particles", TRACKS_FORMAT: "of_tracks", TRAJECTORIES_FORMAT: "of_trajectories"}


def _reach(bounds_mm: ArrayLike, reference: Reference) -> str:
    """Return the bounds (3, 2) along x, y, z in words."""
    sides = zip("xyz", np.asarray(bounds_mm), strict=True)
    reach = ", ".join(f"{axis} {written(low)} to {written(high)}" for axis, (low, high) in sides)
    return f"{reach} mm, from the {reference.name.replace('_', ' ')}"


def _in_mm(grid: Grid, noun: str, reference: Reference) -> str:
    """Return how many cells of what size a grid has, and how far it reaches."""
    counts, sizes = " x ".join(map(str, grid.shape_xyz)), " x ".join(map(written, grid.spacing_mm))
    return f"{counts} {noun}, {sizes} mm each (x, y, z); {_reach([grid.bounds_mm(k) for k in range(3)], reference)}"


def _described_calibration(found: Calibration) -> str:
    figures = found.summary()
    rows, columns = found.image_shape
    pose, pitch = found.pose, ", ".join(written(each, 5) for each in figures["pitch_px"])
    board = "no board"
    if pose is not None:
        board = f"board at {written(pose.z0_mm)} mm, magnification {written(pose.magnification, 5)}"
    return (
        f"{figures['lenses']} microlenses, {figures['layout']}, on {rows} x {columns} pixels (rows, columns)\n"
        f"  pitch {pitch} px, turned by {written(figures['rotation_deg'])}°; {board}"
    )


def _described_weights(content: WeightsFile) -> str:
    grid = content.reference.grid_from_focal_point(content.weights.grid)
    rows, columns = content.image_shape
    extent = _in_mm(grid, "voxels", content.reference)
    return f"{extent}\n  seen by {rows} x {columns} pixels (rows, columns), {content.frame}"


def _write_calibration(found: Calibration, path: Path, overwrite: bool) -> None:
    from lfpiv_cli.files.calibration_file import write_calibration

    write_calibration(path, found, found.provenance, overwrite)


def _write_weights(content: WeightsFile, path: Path, overwrite: bool) -> None:
    from lfpiv_cli.files.weights_file import write_weights

    write_weights(path, content, overwrite)


def _write_points(result: Points | Tracked, path: Path, overwrite: bool) -> None:
    points = _points_of(result)
    particle_file.write_points(path, points.format_name, points, overwrite=overwrite)


# By the names of classes, most of which are loaded by who uses them alone.
KINDS = {
    "Calibration": Kind(
        _write_calibration, lambda found: ("of_calibration", (found,)), describe=_described_calibration
    ),
    "WeightsFile": Kind(_write_weights, lambda content: ("of_weights", (content,)), describe=_described_weights),
    "Volume": Kind(_write_volume, lambda volume: ("of_volume", (volume,)), content_of),
    **dict.fromkeys(
        ("VectorField", "FittedField", "Combined", "FlowStatistics"),
        Kind(
            lambda result, path, overwrite: Vectors.of(result).write(path, overwrite),
            lambda result: ("of_vectors", Vectors.of(result).figures()),
            lambda result: Vectors.of(result).content(),
        ),
    ),
    **dict.fromkeys(
        ("Points", "Tracked"),
        Kind(
            _write_points,
            lambda result: (OF_POINTS[_points_of(result).format_name], (_points_of(result),)),
            lambda result: content_of(_points_of(result)),
        ),
    ),
}


def _kind_of(result: Result) -> Kind:
    return next(KINDS[each.__name__] for each in type(result).__mro__ if each.__name__ in KINDS)


def described(result: Result) -> str:
    """Return what a result is in two lines."""
    name, describe = type(result).__name__, _kind_of(result).describe
    if describe is not None:
        return f"{name}: {describe(result)}"
    content = _content_of(result)
    reference, noun = Reference.from_attributes(content.attributes), NOUNS[content.format_name]
    if content.grid is not None:
        extent = _in_mm(content.grid, noun, reference)
    else:
        places = content.arrays[POSITION]
        extent = f"{len(places)} {noun}"
        if len(places):
            extent += f"; {_reach(np.stack([places.min(axis=0), places.max(axis=0)], axis=1), reference)}"
    medians = []
    for named in [each for each in MEDIANS_OF if each in content.arrays][:MOST_MEDIANS]:
        array, unit = content.arrays[named], content.units[named]
        columns = array.reshape(-1, array.shape[-1]) if content.components(named) else array.reshape(-1, 1)
        known = columns[np.isfinite(columns).all(axis=1)]
        if len(known):
            middle = ", ".join(map(written, np.median(known, axis=0)))
            medians.append(f"{named} {middle}{'' if unit == '1' else f' {unit}'}")
    return f"{name}: {extent}" + (f"\n  medians: {'; '.join(medians)}" if medians else "")


def save(result: Result, path: Path | str, overwrite: bool) -> None:
    """Write the file that the command writes of a result."""
    _kind_of(result).write(result, Path(path), overwrite)


def draw(result: Result, name: str | None) -> Any:
    """Return a figure of a result, the first where no name is given."""
    ensure_drawing()
    from lfpiv_cli.verbs import plot

    function, of = _kind_of(result).figures(result)
    figures = plot.with_captions(getattr(plot, function)(*of))
    chosen = next(iter(figures)) if name is None else name
    if chosen not in figures:
        raise UsageError(f"plot({chosen!r}): {type(result).__name__} has the figures {', '.join(figures)}")
    return figures[chosen].draw()


def _content_of(result: Result) -> Content:
    of_arrays = _kind_of(result).content
    if of_arrays is None:
        raise TypeError(f"{type(result).__name__} is no result of arrays")
    return of_arrays(result)


def as_dataset(result: Result) -> Any:
    """Return the arrays of a result as an `xarray.Dataset`, named and described."""
    xarray, content = package("xarray", "arrays"), _content_of(result)
    places = ("point",) if content.grid is None else ("z", "y", "x")
    coordinates: dict[str, Any] = {}
    if content.grid is not None:
        coordinates = {axis: (axis, content.grid.axis_mm(k), {"units": "mm"}) for k, axis in enumerate("xyz")}
    variables = {}
    for name, array in content.arrays.items():
        names, dimensions = content.components(name), places
        if names:
            dimensions = (*places, "component" if len(names) == 3 else f"component_{len(names)}")
            coordinates[dimensions[-1]] = list(names)
        said = {"units": content.units[name], "long_name": content.descriptions()[name]}
        variables[name] = (dimensions, array, said)
    return xarray.Dataset(variables, coordinates, content.reported())


def as_table(result: Result) -> Any:
    """Return the arrays of a result as a `pandas.DataFrame`, its columns described."""
    pandas, content = package("pandas", "arrays"), _content_of(result)
    columns, units = columns_of(content)
    table = pandas.DataFrame(columns)
    table.attrs = content.reported() | {"units": units, "long_name": content.descriptions()}
    return table
