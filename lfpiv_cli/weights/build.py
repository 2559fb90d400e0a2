"""From the camera and a grid in the flow to the factorised weights (Eqs. 6, 9, 10, 13).

Every voxel is moved to its equivalent point in air, so neither the walls nor their distances enter. Axes: the grid is
in the frame that the array is aligned with (`rectified`), x and y lateral, z away from the camera from the focal point.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lfpiv_cli.arrays import Floats
from lfpiv_cli.errors import ConfigError
from lfpiv_cli.grid import Grid
from lfpiv_cli.notice import written
from lfpiv_cli.optics.camera import Camera, Lattice
from lfpiv_cli.optics.curved_space import CurvedSpace
from lfpiv_cli.optics.media import Media, equivalent_object_distance
from lfpiv_cli.optics.tracing import ObjectSpace, PolynomialRays, disc_points
from lfpiv_cli.weights.axis import Bending, axis_weights, depth_nodes
from lfpiv_cli.weights.lens_cells import Optics, aligned, aperture_mask, axis_optics
from lfpiv_cli.weights.operators import BrickOperator, FactorisedOperator
from lfpiv_cli.weights.scene import Source
from lfpiv_cli.weights.strip_blocks import strips_of

# Straight pieces of the bent ray's place on the array over X, a cubic: with eight they are off by 0.2 % of a lens pitch
# in the paper's simulation.
STRIPS = 8
# Fitted rays separate when what each axis knows of the other only on average moves them by less than this share of a
# lens pitch, rms over so many rays: columns are then off by less than the factors' own 0.01 to 0.02 in L1.
LARGEST_COUPLING = 0.02
COUPLING_RAYS = 4000


def factorise(camera: Camera, media: Media, grid: Grid) -> FactorisedOperator:
    """Return the weights of all voxels of a grid by equivalent ray tracing, in factorised form.

    Raises
    ------
    ConfigError : the array is hexagonal or turned against the sensor, so that its two axes do not separate.
    """
    return factorise_through(camera, ObjectSpace(media, None, "paraxial"), grid)


def factorise_through(
    camera: Camera, source: ObjectSpace | PolynomialRays, grid: Grid, optics: Optics | None = None
) -> FactorisedOperator:
    """Return the weights of all voxels of a grid seen along traced or fitted rays, in factorised form.

    Exact refraction, and fitted rays, couple the axes; each axis takes the other's mean. The camera's two axes may be
    given.

    Raises
    ------
    ConfigError : the array's axes do not separate, or a voxel lies where it cannot be.
    """
    columns, rows = optics or axis_optics(camera)
    x, y = (0, 1) if camera.column_axis == "x" else (1, 0)
    if isinstance(source, PolynomialRays):
        bent = [fitted_bending(source, camera, grid, axis) for axis in (0, 1)]
    else:
        depths = depth_nodes(grid.axis_mm(2), grid.spacing_mm[2])
        if equivalent_object_distance(depths.min(), camera.focus_distance_mm, source.media) <= 0.0:
            raise ConfigError(
                f"volume: its nearest point lies {written(grid.bounds_mm(2)[0], 4)} mm from the focal point, behind "
                "the main lens"
            )
        reach = camera.aperture_radius_mm + float(np.hypot(*(np.abs(grid.bounds_mm(axis)).max() for axis in (0, 1))))
        nodes, factors = (
            table.reshape(*depths.shape, -1) for table in source.slope_polynomials(camera, depths.ravel(), reach)
        )
        beside = [float(np.mean(grid.axis_mm(other) ** 2)) for other in (y, x)]
        bent = [Bending.traced(nodes, factors, each, 1 if source.straight else STRIPS) for each in beside]
    along_columns = axis_weights(columns, grid.axis_mm(x), grid.spacing_mm[x], bent[0])
    along_rows = axis_weights(rows, grid.axis_mm(y), grid.spacing_mm[y], bent[1])
    mask = aperture_mask(along_columns.cells, along_rows.cells, camera.aperture_radius_mm)
    return FactorisedOperator(along_columns, along_rows, mask)


def factorise_bricks(camera: Camera, media: Media, grid: Grid) -> BrickOperator:
    """Return the weights of a hexagonal array whose cells are taken for bricks, in factorised form.

    A brick is as wide as the lenses' pitch and as high as their rows are apart. One ray in twelve is given to the lens
    next to its own: good enough to look for particles, which then are fitted behind true hexagons.

    Raises
    ------
    ConfigError : the array's rows are not those of the sensor
    """
    lattice = camera.lattice
    (pitch, slant), (side, height) = lattice.basis
    if lattice.layout != "hexagonal" or not np.allclose([slant, side], [0.0, 0.5 * pitch], atol=1e-4 * pitch):
        raise ConfigError(
            f"camera.microlenses: a {lattice.layout} array turned by {np.degrees(lattice.rotation_rad):z.4f} degrees; "
            "a hexagonal one with rows along the sensor's is needed (a calibration aligns it)"
        )
    space = ObjectSpace(media, None, "paraxial")
    rows = [
        Lattice(lattice.origin + row * lattice.basis[1], np.diag([pitch, 2.0 * height]), "square") for row in (0, 1)
    ]
    even, odd = (
        factorise_through(camera, space, grid, axis_optics(replace(camera, lattice=each), (pitch, height)))
        for each in rows
    )
    return BrickOperator(even, odd)


def fitted_bending(rays: PolynomialRays, camera: Camera, grid: Grid, axis: int) -> Bending:
    """Return the polynomials along the columns (axis 0) or rows (1), the other axis taken at its mean.

    Of the other axis the powers of y enter by their mean over the voxels; of Y the odd ones vanish and the square is
    that of the disc's chord at X, on average (R^2 - X^2)/3.
    """
    own, other = (0, 3), (1, 4)
    if axis == 1:
        own, other = other, own
    world = grid.axis_mm(other[0] if camera.column_axis == "x" else 1 - other[0])
    depths = depth_nodes(grid.axis_mm(2), grid.spacing_mm[2])
    table = np.zeros((*depths.shape, rays.degree + 1, rays.degree + 1))
    chord = np.array([camera.aperture_radius_mm**2, -(rays.scale_mm[own[1]] ** 2)]) / 3.0 / rays.scale_mm[other[1]] ** 2
    for powers, coefficient in zip(rays.exponents, rays.coefficients_mm[:, axis], strict=True):
        x, crossing, beyond = powers[own[0]], powers[own[1]], powers[other[1]]
        if beyond % 2:
            continue
        beside = np.mean((world / rays.scale_mm[other[0]]) ** powers[other[0]])
        part = coefficient * beside * (depths / rays.scale_mm[2]) ** powers[2]
        if beyond == 0:
            table[..., x, crossing] += part
        else:
            table[..., x, crossing] += chord[0] * part
            table[..., x, crossing + 2] += chord[1] * part
    return Bending.fitted(table, rays.scale_mm[list(own)], STRIPS)


def separates(camera: Camera, source: Source, grid: Grid) -> bool:
    """Return whether array and rays separate into two axes, so that weights factorise."""
    if not aligned(camera):
        return False
    if isinstance(source, PolynomialRays):
        # How far on the array, rms over voxels and aperture, fitted rays are from those that separate.
        rng = np.random.default_rng(0)
        bounds = np.array([grid.bounds_mm(axis) for axis in range(3)])
        planes = rng.integers(0, grid.shape_xyz[2], COUPLING_RAYS)
        points = rng.uniform(bounds[:, 0], bounds[:, 1], (COUPLING_RAYS, 3))
        points[:, 2] = depth_nodes(grid.axis_mm(2), grid.spacing_mm[2])[planes, 0]
        points = camera.to_image_axes(points)
        crossings = disc_points(COUPLING_RAYS, camera.aperture_radius_mm, rng)
        off = source.on_array(points, crossings)
        for axis in (0, 1):
            bent = fitted_bending(source, camera, grid, axis)
            own = np.stack([points[:, axis], crossings[:, axis]]) / bent.scale_mm[:, np.newaxis]
            x, crossing = own[..., np.newaxis] ** np.arange(source.degree + 1)
            off[:, axis] -= np.einsum("na,nab,nb->n", x, bent.coefficients_mm[planes, 0], crossing)
        return float(np.sqrt(np.mean(off**2))) < LARGEST_COUPLING * float(camera.lattice.pitch.min())
    return not isinstance(source, CurvedSpace) or strips_of(camera, source, grid) is not None


def scene_distortion(camera: Camera, media: Media, grid: Grid) -> Floats | None:
    """Return the main lens's distortion as it bends the planes (nz,) of a grid, 1/mm^2; None where there is none.

    A point at p lights the array at r = p s_i/s_o, moved to r (1 + k1 r^2), as one at p (1 + k1 (s_i/s_o)^2 p^2) would.
    """
    if camera.distortion_per_mm2 == 0.0:
        return None
    distance = equivalent_object_distance(grid.axis_mm(2), camera.focus_distance_mm, media)
    return np.asarray(camera.distortion_per_mm2 * (camera.image_distance_mm / distance) ** 2, dtype=np.float64)


def blur_radius_mm(camera: Camera, media: Media, grid: Grid) -> float:
    """Return how far from its own line of sight a point of the grid can share pixels with others, in mm in the flow.

    A point outside the volume lights pixels of voxels within this distance: alpha R on the array and half a lens, taken
    back to the flow, at the depth where it is largest.
    """
    distance = equivalent_object_distance(grid.bounds_mm(2), camera.focus_distance_mm, media)
    on_array = np.abs(camera.defocus(distance)) * camera.aperture_radius_mm + 0.5 * camera.lattice.pitch.max()
    return float(np.max(on_array * distance / camera.image_distance_mm))


def default_padding(camera: Camera, media: Media, grid: Grid) -> tuple[int, int, int]:
    """Return how many voxels to solve for beyond each side of the grid: the blur radius laterally, none in depth."""
    radius = blur_radius_mm(camera, media, grid)
    return int(np.ceil(radius / grid.spacing_mm[0])), int(np.ceil(radius / grid.spacing_mm[1])), 0
