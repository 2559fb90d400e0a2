"""The camera as particles see it: the raw image, every microlens with its own measured centre.

Nothing is resampled. Each lens has the cell of the plain lattice around its own centre. The edges of square cells are
taken as upright: at a rotation of 0.1 degrees that moves 0.1 % of the pitch from one lens to the next.

Axes: image axes (x along the columns, y along the rows, see `optics.camera`), z away from the camera from the nominal
focal point; lengths in mm about the optical axis.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numba import types
from numba.core.typing.typeof import Purpose, typeof_impl
from numpy.typing import NDArray

from lfpiv_cli.arrays import Floats
from lfpiv_cli.calibration.model import Calibration
from lfpiv_cli.errors import ConfigError
from lfpiv_cli.grid import Scale
from lfpiv_cli.kernels import for_types_of
from lfpiv_cli.optics.camera import Camera, KernelCamera, Lattice, nearest_on_grid
from lfpiv_cli.optics.curved_space import CurvedSpace
from lfpiv_cli.optics.line_responses import NO_LINES, LineResponses, line_responses, of_tracers
from lfpiv_cli.optics.media import Layers, Media
from lfpiv_cli.optics.surfaces import Faces
from lfpiv_cli.optics.tracing import ObjectSpace, refraction_error_mm
from lfpiv_cli.particles.cells import NO_SHARES, cell_radius, cell_shares, smallest_ball_mm
from lfpiv_cli.particles.pencil import lines_of
from lfpiv_cli.threads import in_threads
from lfpiv_cli.weights.scene import NO_FACES

# Particles that are smaller are taken as this large, so that profiles have slopes: a thousandth of a lens.
SMALLEST_RADIUS_LENSES = 1e-3
# Depths between two others at which footprints are asked for; behind curved faces also places along each image axis.
SAMPLED_DEPTHS, SAMPLED_PLACES = 101, 11
# Rays that Snell's law moves by more than this share of the pitch at the rim are no small change to profiles.
BENT_FAR = 0.05
# Tables of cells' shares serve balls that differ from theirs by this factor: only their blur's variance is changed.
SAME_TABLE = 1.6


class View(NamedTuple):
    """What the kernels need of the camera, the media and the particles.

    Attributes
    ----------
    camera : with the plain lattice of the raw image
    scale : its lengths in the scene
    depth_ratio : n_a/n_w (Eq. 9)
    layers : from the lens to the focal point, of plane faces that bend rays by Snell's law; one where rays are straight
    faces : curved ones; none where all are plane
    half_x_mm, half_y_mm : how far a square cell's sides are from its lens along x and along y; half the rectangle that
        holds a hexagonal one
    lean_x, lean_y : how much further along x the sides of a square cell are further along y, and along y along x
    corner_mm : how far a cell's corners are from its lens
    cell_reach : how far a cell reaches at most from its lens, in steps of the lattice
    cell_table, cell_side2_mm2, cell_step_mm, cell_ball_mm : of cells that are no rectangles, or rays bent far, see
        `cells.CellShares`
    particle_radius_mm : of the balls
    centres_mm : (nj, ni, 2) lens centres on the array; entry [j, i] is lens (first_i + i, first_j + j)
    inverse_basis : (2, 2) of the plain lattice, to find lenses
    lines : of light as waves, by which all light goes then; empty: light goes by rays
    points, diffusion_px : the same of points of light before charge diffuses, and how far it does
    passed : (pixels,) share of the middle's light that reaches each pixel; empty: all of it
    """

    camera: KernelCamera
    scale: Scale
    depth_ratio: float
    layers: Layers
    faces: Faces
    half_x_mm: float
    half_y_mm: float
    lean_x: float
    lean_y: float
    corner_mm: float
    cell_reach: float
    cell_table: Floats
    cell_side2_mm2: Floats
    cell_step_mm: float
    cell_ball_mm: float
    particle_radius_mm: float
    centres_mm: Floats
    first_i: int
    first_j: int
    inverse_basis: Floats
    lines: LineResponses
    points: LineResponses
    diffusion_px: float
    passed: NDArray[np.float32]


def type_by_form(value: tuple[Any, ...], purpose: Purpose) -> types.Type:
    """Return numba's type of a named tuple; it would look at all that is in one each time a kernel is called.

    Views and what holds them are taken apart to their arrays' forms alone: 20 us of 400.
    """
    form = type(value), _form(value)
    if form not in _types:
        _types[form] = typeof_impl.dispatch(tuple)(value, purpose)
    return _types[form]


_types: dict[object, types.Type] = {}


def _form(value: object) -> object:
    """Return what a type follows from: of arrays what they hold, their dimensions and their layout."""
    if isinstance(value, tuple):
        return tuple([_form(each) for each in value])
    return (value.dtype.char, value.ndim, value.flags.num) if isinstance(value, np.ndarray) else type(value)


typeof_impl.register(View)(type_by_form)


@dataclass(frozen=True)
class Light:
    """Light as waves, as particles are fitted with it.

    Attributes
    ----------
    wavelength_mm : in air
    diffusion_px : standard deviation of the sensor's charge diffusion
    depths_mm : between which particles lie
    """

    wavelength_mm: float
    diffusion_px: float
    depths_mm: tuple[float, float]


def ensure_square_cells(camera: Camera, space: ObjectSpace | CurvedSpace | None) -> None:
    """Refuse hexagonal cells behind curved faces: their tables are of balls that are round and equally sharp all ways.

    Raises
    ------
    ConfigError
    """
    if isinstance(space, CurvedSpace) and camera.lattice.layout != "square":
        raise ConfigError("through a scene particles are fitted behind square microlenses alone; these are hexagonal")


def raw_view(
    camera: Camera,
    media: Media,
    particle_radius_mm: float,
    calibration: Calibration | None = None,
    space: ObjectSpace | CurvedSpace | None = None,
    light: Light | None = None,
    passed: NDArray[np.float32] | None = None,
) -> View:
    """Return the view of a camera on the raw image.

    Parameters
    ----------
    camera : as the weights have it; its lattice is used where there is no calibration
    calibration : gives the measured centres of the lens images
    space : what bends rays; None: they are straight from the equivalent points
    light : as waves; None: it goes by rays
    passed : (rows, columns) share of the middle's light that reaches each pixel; None: all of it

    Raises
    ------
    ConfigError : faces are curved and the array is hexagonal, or either and light is waves
    """
    ensure_square_cells(camera, space)
    if light is not None and (isinstance(space, CurvedSpace) or camera.lattice.layout != "square"):
        raise ConfigError(
            "reconstruction.wavelength_nm: by waves particles are fitted behind plane faces and square lenses alone; "
            "leave it out"
        )
    plane = ObjectSpace(media, refraction="paraxial") if space is None or isinstance(space, CurvedSpace) else space
    lattice_px = camera.micro_image_lattice_px() if calibration is None else calibration.fit.lattice_px
    # One lens more than the sensor's corners: micro-images reach over its edge.
    corners = [(c, r) for c in (0, camera.columns - 1) for r in (0, camera.rows - 1)]
    span = lattice_px.nearest(corners)
    (low_i, low_j), (high_i, high_j) = span.min(axis=0) - 1, span.max(axis=0) + 1
    indices = np.stack(np.meshgrid(np.arange(low_i, high_i + 1), np.arange(low_j, high_j + 1)), axis=-1)
    centres_px = lattice_px.points(indices) if calibration is None else calibration.fit.centres(indices)
    camera = camera.with_micro_images(lattice_px)
    lattice = camera.lattice
    scale = camera.scale(media)
    radius = max(particle_radius_mm, SMALLEST_RADIUS_LENSES * scale.lens_mm)
    half_x = half_y = cell_radius(lattice)
    lean_x = lean_y = 0.0
    if lattice.layout == "square":
        one, other = lattice.basis
        half_x, half_y = 0.5 * (one @ one) / one[0], 0.5 * (other @ other) / other[1]
        lean_x, lean_y = one[1] / one[0], other[0] / other[1]
    bent_mm = 0.0 if plane.straight else refraction_error_mm(camera, media, plane.window, np.zeros(1))
    shares = NO_SHARES
    if lattice.layout != "square" or (light is None and bent_mm > BENT_FAR * lattice.pitch.min()):
        shares = cell_shares(lattice, radius * camera.image_distance_mm / camera.focus_distance_mm)
    view = View(
        camera=camera.for_kernels(),
        scale=scale,
        depth_ratio=media.depth_ratio,
        layers=plane.layers(camera),
        faces=space.for_kernels(camera) if isinstance(space, CurvedSpace) else NO_FACES,
        half_x_mm=float(half_x),
        half_y_mm=float(half_y),
        lean_x=float(lean_x),
        lean_y=float(lean_y),
        corner_mm=cell_radius(lattice),
        cell_reach=0.5 if lattice.layout == "square" else 2.0 / 3.0,
        cell_table=shares.table,
        cell_side2_mm2=shares.side2_mm2,
        cell_step_mm=shares.step_mm,
        cell_ball_mm=shares.radius_mm,
        particle_radius_mm=radius,
        centres_mm=np.ascontiguousarray(camera.px_to_mm(centres_px) / camera.micro_image_scale),
        first_i=int(low_i),
        first_j=int(low_j),
        inverse_basis=np.ascontiguousarray(np.linalg.inv(lattice.basis)),
        lines=NO_LINES,
        points=NO_LINES,
        diffusion_px=0.0,
        passed=np.zeros(0, np.float32) if passed is None else np.ascontiguousarray(passed.ravel()),
    )
    if light is None:
        return view
    # What the light of a point depends on of a camera.
    numbers = (
        camera.magnification,
        camera.focal_length_mm,
        camera.aperture_mm,
        camera.microlens_focal_length_mm,
        camera.microlens_distance_mm,
        float(camera.lattice.pitch.mean()),
        camera.pixel_mm,
    )
    points = _points(numbers, plane, light.wavelength_mm, light.depths_mm)
    return with_diffusion(view._replace(points=points), light.diffusion_px)


@lru_cache(maxsize=2)
def _points(
    numbers: tuple[float, ...], space: ObjectSpace, wavelength_mm: float, depths_mm: tuple[float, float]
) -> LineResponses:
    """Return the line responses of points, before charge diffuses."""
    magnification, focal_length, aperture, of_lens, distance, pitch, pixel = numbers
    lattice = Lattice(np.zeros(2), pitch * np.eye(2), "square")
    camera = Camera(magnification, focal_length, aperture, of_lens, distance, lattice, pixel, 1, 1)
    return line_responses(camera, space, wavelength_mm, depths_mm)


def with_radius(view: View, particle_radius_mm: float) -> View:
    """Return the view of balls of another size."""
    view = view._replace(particle_radius_mm=max(particle_radius_mm, SMALLEST_RADIUS_LENSES * view.scale.lens_mm))
    if by_waves(view):
        return with_diffusion(view, view.diffusion_px)
    if view.cell_table.shape[0] == 0:
        return view
    basis = np.asarray(np.linalg.inv(view.inverse_basis), np.float64)
    across = abs(basis[0] @ basis[1]) > 0.25 * np.sum(basis[0] ** 2)
    lattice = Lattice(view.camera.origin_mm, basis, "hexagonal" if across else "square")
    radius = view.particle_radius_mm * view.camera.image_distance_mm / view.camera.focus_distance_mm
    smallest = smallest_ball_mm(lattice)
    if max(radius, smallest) / SAME_TABLE <= view.cell_ball_mm <= max(radius, smallest) * SAME_TABLE:
        return view
    shares = cell_shares(lattice, radius)
    return view._replace(
        cell_table=shares.table,
        cell_side2_mm2=shares.side2_mm2,
        cell_step_mm=shares.step_mm,
        cell_ball_mm=shares.radius_mm,
    )


def with_diffusion(view: View, diffusion_px: float) -> View:
    """Return the view by waves with charge that diffuses by another Gaussian."""
    camera = view.camera
    radius = view.particle_radius_mm * camera.image_distance_mm / camera.focus_distance_mm
    lines = of_tracers(view.points, radius, diffusion_px)
    return view._replace(lines=lines, diffusion_px=float(diffusion_px))


def by_waves(view: View) -> bool:
    """Return whether light goes by waves, not by rays."""
    return view.points.table.shape[0] > 0


def on_array_mm(view: View, points: Floats) -> Floats:
    """Return where the main lens's middle shows points (n, 3 or more) on the array (n, 2), without its distortion.

    Of points that the lens does not see behind curved faces, where it would through planes.
    """
    places = -points[:, :2] * _image_scale(view, points[:, 2])[:, np.newaxis]
    if view.faces.ratios.size == 0:
        return places
    lines, *_ = lines_of(view.faces, view.camera.aperture_radius_mm, points)
    with np.errstate(divide="ignore", invalid="ignore"):
        shown = -view.camera.image_distance_mm * lines[:, :, 0] / lines[:, :, 1]
    return np.where(lines[:, :, 1] > 0.0, shown, places)


def lens_pixels(view: View) -> float:
    """Return the pixels of a lens's cell.

    However many lenses a particle's light reaches, together they show the aperture once: about as many pixels are lit.
    """
    return 4.0 * view.half_x_mm * view.half_y_mm / view.camera.pixel_mm**2


def lens_numbers(view: View) -> NDArray[np.int32]:
    """Return the number of the lens whose image a pixel is in (rows, columns), by the plain lattice."""
    camera = view.camera
    per_px = camera.pixel_mm / (1.0 + camera.microlens_distance_mm / camera.image_distance_mm)
    x, y = ((np.arange(n) - 0.5 * (n - 1)) * per_px for n in (camera.columns, camera.rows))
    i, j = nearest_on_grid(x, y, camera.origin_mm, np.linalg.inv(view.inverse_basis))
    i -= i.min()
    j -= j.min()
    return np.asarray(j * (i.max() + 1) + i, np.int32)


def footprint_radius_mm(view: View, points: Floats) -> Floats:
    """Return how far (n,) on the array the light of particles (n, 3 or more) spreads from their centres."""
    return np.asarray(_spreads_mm(view, points).max(axis=1))


def _spreads_mm(view: View, points: Floats) -> Floats:
    """Return `footprint_radius_mm` along both image axes (n, 2)."""
    camera, radius = view.camera, view.camera.aperture_radius_mm
    beta = np.repeat(_image_scale(view, points[:, 2])[:, np.newaxis], 2, axis=1)
    ball, bent = np.full_like(beta, view.particle_radius_mm), np.zeros_like(beta)
    if view.faces.ratios.size > 0:
        lines, moves, bent = lines_of(view.faces, radius, points)
        seen = lines[:, :, 1] > 0.0
        beta[seen] = camera.image_distance_mm / lines[seen, 1]
        ball[seen] *= np.linalg.norm(moves[:, :, 0], axis=-1)[seen]
    alpha = 1.0 + beta - camera.image_distance_mm / camera.focal_length_mm
    return np.asarray(np.abs(alpha) * radius + beta * ball + camera.image_distance_mm * bent + view.lines.margin_mm)


def _between(view: View, z_low_mm: float, z_high_mm: float) -> Floats:
    """Return points (n, 3) that stand for all between two depths: plane faces show them alike wherever they are."""
    if view.faces.ratios.size == 0:
        depths = np.linspace(z_low_mm, z_high_mm, SAMPLED_DEPTHS)
        return np.column_stack([np.zeros((depths.size, 2)), depths])
    camera = view.camera
    half = 0.5 * camera.pixel_mm * np.array([camera.columns, camera.rows]) * camera.focus_distance_mm
    x, y = (np.linspace(-reach, reach, SAMPLED_PLACES) for reach in half / camera.image_distance_mm)
    depths = np.linspace(z_low_mm, z_high_mm, SAMPLED_PLACES)
    return np.stack(np.meshgrid(x, y, depths), axis=-1).reshape(-1, 3)


def _image_scale(view: View, z_mm: Floats) -> Floats:
    """Return s_i/s_o at depths z, without the sign of the inversion."""
    return view.camera.image_distance_mm / (view.camera.focus_distance_mm + view.depth_ratio * z_mm)


def entry_capacity(view: View, z_low_mm: float, z_high_mm: float) -> int:
    """Return how many (lens, pixel) entries a particle between two depths can have at most."""
    camera, per_axis = view.camera, 0.0
    whole = view.lines.table.shape[0] > 0
    patch = camera.pixel_mm * camera.image_distance_mm / camera.microlens_distance_mm
    spreads = _spreads_mm(view, _between(view, z_low_mm, z_high_mm))
    for half in (view.half_x_mm, view.half_y_mm):
        lenses = np.ceil(spreads / half) + 2.0
        # A lens sees the part of the aperture whose light falls into its cell.
        lit = np.minimum(2.0 * camera.aperture_radius_mm, 3.0 * half * 2.0 * camera.aperture_radius_mm / spreads)
        # Waves light whole cells.
        pixels = 2.0 * half / camera.pixel_mm + 3.0 if whole else lit / patch + 3.0
        per_axis = max(per_axis, float(np.max(lenses * pixels)))
    return int(per_axis**2) + 1


# Particles by tiles of the image, so that threads work on them at once and their number does not matter.
#
# The image is cut into square tiles at least as wide as two footprints. Tiles whose numbers are even along both axes
# form one group, and so on: four groups. Particles of tiles that do not touch, as those of one group, light no common
# pixel and can be worked on at once; tiles that touch follow each other as their groups do, and particles of a tile.


# How far a particle may be moved within one sweep, in microlenses: footprints must not grow into other tiles.
LARGEST_MOVE_LENSES = 1.5


def over_tiles(
    kernel: Callable[..., None],
    view: View,
    points: Floats,
    depths_mm: tuple[float, float],
    *arguments: object,
    chosen: NDArray[np.bool_] | None = None,
) -> None:
    """Call kernel(numbers, *arguments) with the particles of each tile, in their order, on all threads.

    Parameters
    ----------
    points : (n, 3 or more), image axes
    depths_mm : between which particles stay
    chosen : (n,) which of them are worked on; None: all
    """
    tiles, after = tiles_of(view, points, depths_mm)
    if chosen is not None:
        tiles = [numbers[chosen[numbers]] for numbers in tiles]
    if tiles:
        call = for_types_of(kernel, tiles[0], *arguments)
        in_threads(lambda numbers: call(numbers, *arguments), tiles, after)


def tiles_of(
    view: View, points: Floats, depths_mm: tuple[float, float]
) -> tuple[list[NDArray[np.int64]], list[set[int]]]:
    """Return the numbers of the particles of each tile, and of each the tiles that must be done before it.

    Tiles of one of four groups never touch; of those that do the one of the earlier group is the first.
    """
    tile = np.floor(on_array_mm(view, points) / tile_side_mm(view, *depths_mm)).astype(np.int64)
    placed = np.column_stack([tile[:, 0] % 2 + 2 * (tile[:, 1] % 2), tile[:, ::-1]])
    order = np.lexsort(placed.T[::-1])
    begins = np.flatnonzero(np.any(np.diff(placed[order], axis=0, prepend=-1) != 0, axis=1))
    at = placed[order[begins], 1:]
    touching = np.abs(at[:, np.newaxis] - at).max(axis=-1) <= 1
    return np.split(order, begins)[1:], [set(np.flatnonzero(row[:n])) for n, row in enumerate(touching)]


def tile_side_mm(view: View, z_low_mm: float, z_high_mm: float) -> float:
    """Return the side of a tile, on the array: two footprints of particles that move in one sweep."""
    points, stretch = _between(view, z_low_mm, z_high_mm), 1.0
    if view.faces.ratios.size > 0:
        # How far curved faces show particles to move, over how far they do sideways.
        _, moves, _ = lines_of(view.faces, view.camera.aperture_radius_mm, points)
        stretch = max(float(np.linalg.norm(moves[:, :, 0], axis=-1).max()), 1.0)
    widest = float(_spreads_mm(view, points).max())
    lens_on_array_mm = view.scale.lens_mm * view.camera.image_distance_mm / view.camera.focus_distance_mm
    # Light that touches a lens's cell lands within its micro-image: two cells to each side.
    move = LARGEST_MOVE_LENSES * lens_on_array_mm * stretch
    return 2.0 * (widest + 4.0 * max(view.half_x_mm, view.half_y_mm) + move)


def footprint_px(view: View, z_low_mm: float, z_high_mm: float) -> int:
    """Return the side of a square of pixels that holds any particle's footprint."""
    return int(np.ceil(tile_side_mm(view, z_low_mm, z_high_mm) / view.camera.pixel_mm))
