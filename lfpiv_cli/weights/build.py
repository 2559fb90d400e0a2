"""From the camera and a grid in the flow to the factorised weights (Eqs. 6, 9, 10, 13).

Every voxel is moved to its equivalent point in air, so neither the walls nor their distances enter. Axes: the grid is
in the frame that the array is aligned with (`rectified`), x and y lateral, z away from the camera from the focal point.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.errors import ConfigError
from lfpiv_cli.grid import Grid
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.media import Media, equivalent_object_distance
from lfpiv_cli.optics.object_space import ObjectSpace
from lfpiv_cli.weights.aperture import aperture_mask
from lfpiv_cli.weights.axis import AxisOptics, AxisWeights, Bending, axis_weights, depth_nodes
from lfpiv_cli.weights.operators import FactorisedOperator

# A lattice counts as aligned with the sensor when over its whole width it strays by less than a hundredth of a pixel.
ALIGNED_PX = 0.01
# Straight pieces of the bent ray's place on the array over X, a cubic: with eight they are off by 0.2 % of a lens pitch
# in the paper's simulation.
STRIPS = 8


def factorise(camera: Camera, media: Media, grid: Grid) -> FactorisedOperator:
    """Return the weights of all voxels of a grid by equivalent ray tracing, in factorised form.

    Raises
    ------
    ConfigError : the array is hexagonal or turned against the sensor, so that its two axes do not separate.
    """
    return factorise_through(camera, ObjectSpace(media, None, "paraxial"), grid)


def factorise_through(camera: Camera, space: ObjectSpace, grid: Grid) -> FactorisedOperator:
    """Return the weights of all voxels of a grid seen through an object space, in factorised form.

    Exact refraction couples the axes by the square of the lateral distance; each axis takes the other's mean.

    Raises
    ------
    ConfigError : the array's axes do not separate, or a voxel lies where it cannot be.
    """
    columns, rows = axis_optics(camera)
    x, y = (0, 1) if camera.column_axis == "x" else (1, 0)
    depths = depth_nodes(grid.axis_mm(2), grid.spacing_mm[2])
    if camera.focus_distance_mm + space.media.depth_ratio * depths.min() <= 0.0:
        raise ConfigError(
            f"volume: its nearest point lies {grid.bounds_mm(2)[0]:.4g} mm from the focal point, behind the main lens"
        )
    reach = camera.aperture_radius_mm + float(np.hypot(*(np.abs(grid.bounds_mm(axis)).max() for axis in (0, 1))))
    nodes, factors = (
        table.reshape(*depths.shape, -1) for table in space.slope_polynomials(camera, depths.ravel(), reach)
    )
    strips = 1 if space.straight else STRIPS

    def along(optics: AxisOptics, axis: int, other: int) -> AxisWeights:
        beside = float(np.mean(grid.axis_mm(other) ** 2))
        bending = Bending(nodes, factors, camera.focal_length_mm, beside, strips)
        return axis_weights(optics, grid.axis_mm(axis), grid.spacing_mm[axis], bending)

    along_columns, along_rows = along(columns, x, y), along(rows, y, x)
    mask = aperture_mask(along_columns.cells, along_rows.cells, camera.aperture_radius_mm)
    return FactorisedOperator(along_columns, along_rows, mask)


def separates(camera: Camera) -> bool:
    """Return whether the array's two axes separate, so that weights factorise."""
    basis = camera.lattice.basis
    stray_px = np.abs([basis[1, 0], basis[0, 1]]) / camera.lattice.pitch[::-1] * [camera.rows, camera.columns]
    return camera.lattice.layout == "square" and bool(stray_px.max() <= ALIGNED_PX)


def axis_optics(camera: Camera) -> tuple[AxisOptics, AxisOptics]:
    """Return the camera's two axes, (columns, rows), each with its lens pitch."""
    basis = camera.lattice.basis
    pixels = np.array([camera.columns, camera.rows])
    if not separates(camera):
        raise ConfigError(
            f"camera.microlenses: a {camera.lattice.layout} array turned by "
            f"{np.degrees(camera.lattice.rotation_rad):.4f} degrees against the sensor does not separate into columns "
            "and rows; a square one aligned with it is needed (a calibration aligns it)"
        )
    first, second = (
        AxisOptics(
            image_distance_mm=camera.image_distance_mm,
            microlens_distance_mm=camera.microlens_distance_mm,
            microlens_focal_length_mm=camera.microlens_focal_length_mm,
            aperture_radius_mm=camera.aperture_radius_mm,
            lens_origin_mm=float(camera.lattice.origin[axis]),
            lens_pitch_mm=float(basis[axis, axis]),
            pixel_mm=camera.pixel_mm,
            pixels=int(pixels[axis]),
        )
        for axis in (0, 1)
    )
    return first, second


def scene_distortion(camera: Camera, media: Media, grid: Grid) -> NDArray[np.float64] | None:
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
