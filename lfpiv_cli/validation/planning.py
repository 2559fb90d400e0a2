"""What a rig will see and how much it can tell, before it records anything: lengths, seeding, times.

Axes: world x, y, z in mm, z away from the camera from the nominal focal point; pairs of lengths are along world (x, y).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.media import Media, equivalent_object_distance

# Tracers for each microlens in view that serve velocity best: each lights about as many pixels as a microlens has, so
# that with one of them the pixels of neighbours overlap, and particles go wrong from two on.
BEST_PER_LENS = 0.5
SPARSE_PER_LENS, CROWDED_PER_LENS, MOST_PER_LENS = 0.05, 1.3, 3.0
# Displacements in voxels that are large against the errors and small against a coarse window.
SMALLEST_STEP, BEST_STEP, LARGEST_STEP = 3.0, 5.0, 8.0


def half_view_mm(camera: Camera, media: Media, z_mm: ArrayLike, rim: float = -1.0) -> NDArray[np.float64]:
    """Return half the field of view (n, 2) along x and y at depths (n,), 0 where there is none.

    Parameters
    ----------
    rim : radii of a point's light on the array that may lie beyond the sensor's edge: -1, all of a point's light is
        seen; 0, half of it; 1, it is seen at all
    """
    distance = equivalent_object_distance(z_mm, camera.focus_distance_mm, media)
    # A lens at the sensor's edge is cut.
    blur = np.abs(camera.defocus(distance)) * camera.aperture_radius_mm + 0.5 * float(camera.lattice.pitch.max())
    half = 0.5 * camera.pixel_mm * np.array([camera.columns, camera.rows]) / camera.micro_image_scale
    on_array = half + rim * blur[..., np.newaxis]
    seen = np.maximum(on_array, 0.0) * (distance / camera.image_distance_mm)[..., np.newaxis]
    return np.asarray(seen if camera.column_axis == "x" else seen[..., ::-1])


def share_in_view(
    camera: Camera, media: Media, bounds_mm: NDArray[np.float64], rim: float = -1.0, planes: int = 41
) -> float:
    """Return the share of a box's volume in the field of view, `rim` as in `half_view_mm`.

    Parameters
    ----------
    bounds_mm : (3, 2) lowest and highest x, y, z of the box
    """
    half = half_view_mm(camera, media, np.linspace(bounds_mm[2, 0], bounds_mm[2, 1], planes), rim)
    low, high = np.maximum(bounds_mm[:2, 0], -half), np.minimum(bounds_mm[:2, 1], half)
    sides = np.maximum(high - low, 0.0) / np.diff(bounds_mm[:2])[:, 0]
    return float(np.mean(np.prod(sides, axis=1)))


def depth_of_field_mm(camera: Camera, media: Media) -> float:
    """Return how far before and behind the focal plane points can be refocused.

    There their light reaches as many lenses across as a lens has pixels, and each lens sees it in one pixel.
    """
    return camera.scale(media).depth_mm * pixels_per_lens(camera)


def pixels_per_lens(camera: Camera) -> float:
    """Return the pixels across a lens image: the views from across the aperture."""
    return float(camera.micro_image_lattice_px().pitch.mean())


def matched_f_number(magnification: float, microlens_f_number: float) -> float:
    """Return the main lens's F_m / p_m with which lens images just touch: its cone is that of the microlenses."""
    return microlens_f_number / (1.0 - magnification)


def tracers_in(camera: Camera, per_lens: float, sides_mm: ArrayLike) -> float:
    """Return the tracers in a box of sides (2 or 3,) for so many in front of each microlens that looks into it."""
    width, height = np.asarray(sides_mm, dtype=np.float64)[:2] * abs(camera.magnification)
    return float(per_lens * width * height / camera.lattice.cell_area)


def time_step_s(velocity_m_s: float, voxel_mm: float, voxels: float = BEST_STEP) -> float:
    """Return the time in which a velocity crosses so many voxels."""
    return voxels * voxel_mm / (abs(velocity_m_s) * 1e3)
