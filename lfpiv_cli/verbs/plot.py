"""`plot`: the figures of any file of ours, as PDF or PNG."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.calibration.model import Calibration
from lfpiv_cli.console import CONSOLE, Console
from lfpiv_cli.errors import ConfigError, InputError, UsageError
from lfpiv_cli.files import atomic, calibration_file, hdf5, images, inputs, pages, particle_file, vtkhdf, weights_file
from lfpiv_cli.files.config import carried_config
from lfpiv_cli.files.particle_file import PARTICLES_FORMAT, TRACKS_FORMAT, TRAJECTORIES_FORMAT, Points
from lfpiv_cli.files.weights_file import FORMAT, WeightsFile, open_weights
from lfpiv_cli.flow.field import VectorField
from lfpiv_cli.notice import written
from lfpiv_cli.pictures import calibration as pictures
from lfpiv_cli.pictures import points as of_points
from lfpiv_cli.pictures import vectors
from lfpiv_cli.pictures.style import caption_of
from lfpiv_cli.verbs.contents import describe, is_recording
from lfpiv_cli.verbs.frames import residual_path

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# The figures that each kind of file has, by its format.


# Of the light by depth: so many depths show its course, each costs three columns.
DEPTHS = 41
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


# A reader's figures: what draws each, whose first paragraph is the caption, or more where this depends on the file.
Figures = dict[str, "Drawn | Callable[[], Figure]"]


def of_vectors(
    field: VectorField,
    arrays: Mapping[str, NDArray[Any]] = MappingProxyType({}),
    tables: Mapping[str, Mapping[str, NDArray[Any]]] = MappingProxyType({}),
    said: Mapping[str, Any] = MappingProxyType({}),
) -> Figures:
    """Return the figures of vectors; with arrays and tables besides, and what a file says of itself, of these, too."""
    figures: Figures = {
        "planes": partial(vectors.planes_figure, field),
        "components": partial(vectors.components_figure, field),
        "profiles": partial(vectors.profiles_figure, field),
    }
    if field.uncertainty_voxel is not None and np.isfinite(field.uncertainty_voxel).any():
        figures["sigma"] = partial(vectors.sigma_figure, field)
    figures["flags"] = partial(vectors.flags_figure, field)
    # Not what is alike everywhere.
    known = {QUALITIES[name]: arrays[name] if name in arrays else getattr(field, name, None) for name in QUALITIES}
    qualities = {
        words: each for words, each in known.items() if each is not None and np.unique(each[np.isfinite(each)]).size > 1
    }
    if qualities:
        caption = f"What else tells how good vectors are: {', '.join(qualities)}."
        figures["quality"] = Drawn(caption, partial(vectors.quality_figure, field, qualities))
    figures["displacements"] = partial(vectors.displacements_figure, field, _lens_mm(field.provenance))
    if field.dt_s is not None:
        figures["gradients"] = partial(vectors.gradients_figure, field)
    if "convergence" in tables:  # of many pairs, whose mean these are
        figures["moments"] = partial(of_points.moments_figure, field.grid, field.velocity, arrays)
        figures["stresses"] = partial(of_points.stresses_figure, field.grid, arrays)
        if "profile" in tables:
            names = said["profile_components"].split(", ")
            figures["profile"] = partial(of_points.profile_figure, said["profile"], names, tables["profile"])
        spreads = [tables["convergence"][f"{name}_spread"] for name in ("velocity", "reynolds_stress")]
        if all((spread > 0.0).any() for spread in spreads):  # one pair tells none
            pairs = tables["convergence"]["pairs"]
            figures["convergence"] = partial(of_points.convergence_figure, pairs, *spreads)
    return figures


def _lens_mm(provenance: Mapping[str, Any]) -> float | None:
    """Return the width of a microlens in the scene; None where the record does not say with what camera it was taken.

    Nor does one whose config is that of another version, which must not keep its figures from being drawn.
    """
    try:
        config = carried_config(provenance, "vectors")
        return config.camera_model().scale(config.media_model()).lens_mm
    except (InputError, ConfigError):
        return None


def _of_particles_in(path: Path, raw: Path | None) -> Figures:
    points, left = particle_file.read_points(path, PARTICLES_FORMAT), residual_path(path)
    figures = of_particles(points)
    on_images: Figures = {}
    if raw is not None:
        config = carried_config(points.provenance, path)
        focal_point = points.reference.points_to_focal_point(points.position_mm)
        places = of_points.places_px(focal_point, config.camera_model(), config.media_model(), config.scene_space())
        image, z_mm = images.read_single(raw, config.image_shape()).astype(np.float64), points.position_mm[:, 2]
        on_images["image"] = partial(of_points.image_figure, image, places, z_mm)
    if left.is_file():
        on_images["residual"] = partial(of_points.residual_figure, images.read_single(left).astype(np.float64))
    return {"places": figures.pop("places")} | on_images | figures


def of_particles(points: Points) -> Figures:
    """Return the figures of particles."""
    arrays, z_mm = points.arrays, points.position_mm[:, 2]
    figures: Figures = {"places": partial(of_points.places_figure, points.position_mm, arrays["intensity"])}
    if len(z_mm):
        spread = arrays["covariance_mm2"]
        figures["depths"] = partial(of_points.depths_figure, z_mm, arrays["intensity"], spread)
        figures["chi2"] = partial(of_points.chi2_figure, arrays["chi2"])
    return figures


def of_tracks(tracks: Points) -> Figures:
    """Return the figures of tracks of two frames."""
    arrays = tracks.arrays
    lines, stretch = of_points.displacement_lines(tracks.position_mm, arrays["displacement_mm"])
    longer = f"drawn {written(stretch)} times as long"
    caption = f"The displacements in space, coloured by speed; they are {longer} as they are."
    speeds = np.linalg.norm(arrays["velocity"], axis=1)
    space = partial(of_points.space_figure, lines, speeds, f"{len(lines)} displacements, {longer}")
    return {"space": Drawn(caption, space)} | _of_all_tracks(tracks)


def of_trajectories(tracks: Points) -> Figures:
    """Return the figures of tracks through a sequence."""
    track = tracks.arrays["track"]
    lines = of_points.trajectory_lines(tracks.position_mm, track)
    speeds = of_points.trajectory_lines(np.linalg.norm(tracks.arrays["velocity"], axis=1), track)
    means = np.array([float(each.mean()) for each in speeds])
    figures: Figures = {
        "space": Drawn(
            "The trajectories in space, coloured by mean speed.",
            partial(of_points.space_figure, lines, means, f"{len(lines)} trajectories"),
        ),
        "lengths": partial(of_points.lengths_figure, track),
    }
    return figures | _of_all_tracks(tracks)


def _of_all_tracks(tracks: Points) -> Figures:
    """Return the figures that tracks of two frames and of a sequence have in common."""
    arrays = tracks.arrays
    figures: Figures = {"velocities": partial(of_points.velocities_figure, arrays["velocity"])}
    if np.isfinite(arrays["link_probability"]).any():
        figures["links"] = partial(of_points.links_figure, arrays["link_probability"])
    if len(tracks.position_mm):
        figures["sigma"] = partial(of_points.sigma_figure, tracks.position_mm[:, 2], arrays["velocity_sigma"])
    return figures


def of_volume(volume: vtkhdf.Volume) -> Figures:
    """Return the figures of a volume."""
    return {
        "projections": partial(vectors.projections_figure, volume.array, volume.grid),
        "depths": partial(vectors.depths_figure, volume.array, volume.grid),
    }


def of_calibration(calibration: Calibration, white: Path | None = None) -> Figures:
    """Return the figures of a calibration, and of a white image if it is given."""
    figures: Figures = {"summary": partial(pictures.summary_figure, calibration)}
    if white is not None:
        image = images.read_single(white, calibration.image_shape)
        figures["lattice"] = partial(pictures.calibration_figure, calibration, image)
    return figures


def of_weights(content: WeightsFile) -> Figures:
    """Return the figures of weights."""
    nx, ny, nz = content.weights.grid.shape_xyz
    middle = partial(column_of, content, (nx // 2, ny // 2, nz // 2))
    column = Drawn("The pixels that the middle voxel lights: its point-spread function.", middle)
    return {"column": column, "light": partial(_light_of, content)}


def column_of(content: WeightsFile, voxel: tuple[int, int, int]) -> Figure:
    """Return the figure of the pixels that a voxel (ix, iy, iz) lights (InputError: it lights none)."""
    ix, iy, iz = voxel
    rows, columns, shares = content.weights.column(iz, iy, ix)
    if not shares.size:
        raise InputError(f"voxel {ix} {iy} {iz} lights no pixel")
    grid = content.reference.grid_from_focal_point(content.weights.grid)
    place = ", ".join(written(axis, 4) for axis in grid.voxel_to_mm(np.array(voxel, dtype=np.float64)))
    title = f"voxel {ix}, {iy}, {iz} at ({place}) mm: {shares.size} pixels, sum {shares.sum():.4f}"
    return vectors.column_figure((rows, columns), shares, content.camera.pixel_mm, title)


def _light_of(content: WeightsFile) -> Figure:
    """How much of a voxel's light meets the sensor, by depth: on the axis, half-way out, and in a corner."""
    grid = content.reference.grid_from_focal_point(content.weights.grid)
    nx, ny, nz = grid.shape_xyz
    planes = np.unique(np.linspace(0, nz - 1, min(nz, DEPTHS)).astype(int))
    places = {"middle": (nx // 2, ny // 2), "half-way out": (nx // 4, ny // 4), "corner": (0, 0)}
    sums = {
        name: np.array([float(content.weights.column(int(iz), iy, ix)[2].sum()) for iz in planes])
        for name, (ix, iy) in places.items()
    }
    return vectors.light_figure(grid.axis_mm(2)[planes], sums)


READERS: dict[str, Callable[[Path], Figures]] = {
    vtkhdf.VECTORS_FORMAT: lambda path: of_vectors(
        vtkhdf.open_vectors(path), *vtkhdf.read_extra(path), vtkhdf.read_header(path).attributes
    ),
    vtkhdf.VOLUME_FORMAT: lambda path: of_volume(vtkhdf.open_volume(path)),
    TRACKS_FORMAT: lambda path: of_tracks(particle_file.open_tracks(path)),
    TRAJECTORIES_FORMAT: lambda path: of_trajectories(particle_file.open_tracks(path)),
    weights_file.FORMAT: lambda path: of_weights(open_weights(path)),
}
ON_IMAGES: dict[str, Callable[[Path, Path | None], Figures]] = {
    PARTICLES_FORMAT: _of_particles_in,
    calibration_file.FORMAT: lambda path, white: of_calibration(calibration_file.open_calibration(path), white),
}

SUFFIXES = (".png", ".pdf")


@dataclass(frozen=True, kw_only=True)
class PlotOptions:
    """What `plot` draws: names of figures, none for all; and the raw image that the file was made from, to draw on."""

    only: tuple[str, ...] = ()
    raw: Path | None = None


def figures_of(path: Path, raw: Path | None = None) -> dict[str, Drawn]:
    """Return the figures of a file of ours, by name in the order of display; nothing is drawn yet.

    Parameters
    ----------
    raw : image to draw on: for particles the one they were found in, for a calibration its white image

    Raises
    ------
    InputError : the file is missing, broken or of no format that has figures, or the image does not fit it
    UsageError : there is no figure on an image in it
    """
    of_format = hdf5.format_of(path)
    if of_format not in READERS and of_format not in ON_IMAGES:
        raise InputError(f"{path}: {of_format} has no figures, only {', '.join(sorted({*READERS, *ON_IMAGES}))}")
    if raw is not None and of_format not in ON_IMAGES:
        raise UsageError(f"--raw: figures of {of_format} show no image, only {' and '.join(ON_IMAGES)} do")
    found = ON_IMAGES[of_format](path, raw) if of_format in ON_IMAGES else READERS[of_format](path)
    return with_captions(found)


def with_captions(figures: Figures) -> dict[str, Drawn]:
    """Return figures with what they show, where this is said by what draws them."""
    return {name: each if isinstance(each, Drawn) else Drawn(caption_of(each), each) for name, each in figures.items()}


def plot(
    file: Path,
    output: Path,
    options: PlotOptions = PlotOptions(),
    *,
    overwrite: bool = False,
    console: Console = CONSOLE,
) -> dict[str, Any]:
    """Draw the figures of a file: as pages of one PDF, or as PNG, one for each.

    Raises
    ------
    UsageError : the output is neither, or a name is not one of the file's figures
    """
    if output.suffix not in SUFFIXES:
        raise UsageError(f"{output}: pictures are written as {' or '.join(SUFFIXES)}")
    pages.ensure_drawing()
    figures = figures_of(file, options.raw)
    unknown = [name for name in options.only if name not in figures]
    if unknown:
        raise UsageError(f"--only {unknown[0]}: {file} has the figures {', '.join(figures)}")
    chosen = {name: drawn for name, drawn in figures.items() if not options.only or name in options.only}
    # A PDF holds all, a PNG one; of several each has its name at the end.
    targets = dict.fromkeys(chosen, output)
    if output.suffix != ".pdf" and len(chosen) > 1:
        targets = {name: output.with_name(f"{output.stem}_{name}{output.suffix}") for name in chosen}
    for target in targets.values():
        atomic.ensure_writable(target, overwrite, inputs.given(file=file, raw=options.raw).values())
    with console.progress(len(chosen), "figures") as advance:
        drawn = _drawn(chosen, advance)
        if output.suffix == ".pdf":
            pages.write_pdf(output, drawn, overwrite)
        else:
            for target, figure in zip(targets.values(), drawn, strict=True):
                pages.write_picture(target, figure, overwrite)
    return {"figures": list(chosen), "files": [str(target) for target in dict.fromkeys(targets.values())]}


def _drawn(figures: Mapping[str, Drawn], advance: Callable[[int], None]) -> Iterator[Figure]:
    """Draw one figure after the other, so that few are in memory."""
    for each in figures.values():
        yield each.draw()
        advance(1)


# `info`: what is in a file, and the pixels that one voxel of the weights lights.


@dataclass(frozen=True, kw_only=True)
class InfoOptions:
    """What `info` draws of weights: a picture to write, and which voxel (ix, iy, iz), by default the middle one."""

    picture: Path | None = None
    voxel: tuple[int, int, int] | None = None


def info(
    file: Path, options: InfoOptions = InfoOptions(), *, overwrite: bool = False, console: Console = CONSOLE
) -> dict[str, Any]:
    """Tell what is in a file of ours or of frames, its figures last; of weights, draw the column of one voxel."""
    picture, voxel = options.picture, options.voxel
    if picture is None:
        if voxel is not None:
            raise UsageError("--voxel needs --picture")
        return describe(file)
    atomic.ensure_writable(picture, overwrite, [file])
    pages.ensure_drawing()
    found = describe(file)
    if found["format"] != FORMAT:
        others = "" if is_recording(file) else f"; for the figures of {found['format']}: lfpiv plot {file}"
        raise UsageError(f"--picture draws a voxel of weights{others}")
    content = open_weights(file)
    nx, ny, nz = content.weights.grid.shape_xyz
    ix, iy, iz = voxel or (nx // 2, ny // 2, nz // 2)
    if not (0 <= ix < nx and 0 <= iy < ny and 0 <= iz < nz):
        raise UsageError(f"--voxel {ix} {iy} {iz}: there are {nx} x {ny} x {nz} voxels, counted from 0")
    pages.write_picture(picture, column_of(content, (ix, iy, iz)), overwrite)
    return found
