"""What weights and a volume made with them will cost, estimated before the work: right to a factor of two or three."""

from __future__ import annotations

import math
import shutil
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from lfpiv_cli.calibration.model import Calibration
from lfpiv_cli.calibration.sheet import check_f_numbers, check_pitch, f_number_notices
from lfpiv_cli.errors import ConfigError, OutputError
from lfpiv_cli.files.config import Config
from lfpiv_cli.files.inputs import GB, ensure_room
from lfpiv_cli.files.weights_file import BYTES_A_VOXEL
from lfpiv_cli.grid import Grid
from lfpiv_cli.notice import Notice, written
from lfpiv_cli.optics import tracing
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.curved_space import CurvedSpace
from lfpiv_cli.weights.build import separates
from lfpiv_cli.weights.columns import LARGEST_BYTES
from lfpiv_cli.weights.kernels import SLAB, STRIP
from lfpiv_cli.weights.quadrature import RayCount
from lfpiv_cli.weights.scene import Source, seen_depths_mm
from lfpiv_cli.weights.strip_blocks import PARTS_JUDGED, strips_of

# Whether weights can be right: the data sheet beside itself, the calibration and the angles, before any work.


# Of the angle under which the rim of the lens is seen: beyond 45 degrees a thin lens is far from any real one.
LARGEST_TANGENT = 1.0
DEPTHS = 9


def check_rig(settings: Config, found: Calibration | None) -> list[Notice]:
    """Refuse a camera that cannot be as the data sheet has it, or beside a calibration; return what speaks against it.

    Raises
    ------
    ConfigError, InputError
    """
    sheet = settings.camera_model()
    check_f_numbers(sheet)
    if found is not None:
        check_pitch(found.fit, settings.micro_image_pitch_px())
    if settings.weights.method != "dlfc" and tracing.rim_tangent(sheet) > LARGEST_TANGENT:
        raise ConfigError(
            "camera.main_lens.aperture_mm: the rim of the lens is seen under a tangent of "
            f"{tracing.rim_tangent(sheet):.2f} (NA {_na(sheet):.2f}) from the focal point, at most {LARGEST_TANGENT:g} "
            "may be with traced rays; boards at several depths and weights.method: dlfc fit the rays of such an "
            "objective"
        )
    return f_number_notices(sheet)


def ray_notices(
    settings: Config, found: Calibration | None, camera: Camera, source: Source, grid: Grid
) -> list[Notice]:
    """Return how far traced rays are off: through the volume, z from the focal point, and a thin lens."""
    window = None
    with suppress(ConfigError):
        window = settings.window_model(found.mid_plane_z_mm if found else None)
    if isinstance(source, tracing.PolynomialRays):
        return []
    notices, limit = list[Notice](), f"at most {tracing.LARGEST_ERROR_PX:g} px"
    if isinstance(source, CurvedSpace):
        depths = seen_depths_mm(camera, source, grid)
    else:
        depths = np.linspace(*grid.bounds_mm(2), DEPTHS)
        bent_px = 0.0
        if source.refraction != "exact" and source.media != source.media.in_air():
            bent_px = tracing.refraction_error_mm(camera, source.media, window, depths) / camera.pixel_mm
        if bent_px > tracing.LARGEST_ERROR_PX:
            text = (
                "is paraxial, and Snell's law moves light at the rim of the aperture by "
                f"{'' if window else 'at least '}{written(bent_px, 2)} px on the array, {limit} without harm"
            )
            remedy = "--refraction exact" if window else "give the section window, or channel, and --refraction exact"
            notices.append(Notice("paraxial-refraction", "weights.refraction", text, remedy, bent_px, limit))
    error_px = tracing.sine_error_mm(camera, source.media, depths) / camera.pixel_mm
    share = 1.0 - float(np.cos(np.arctan(tracing.rim_tangent(camera))))
    if error_px > tracing.LARGEST_ERROR_PX and share > tracing.LARGEST_DEPTH_ERROR:
        text = (
            f"NA {_na(camera):.2f}: the rays of a thin lens are off by {written(error_px, 2)} px on the array at the "
            f"volume's faces, {limit} without harm; depths are wrong by up to {share:.1%}"
        )
        remedy = "a smaller aperture or a thinner volume, or boards at several depths and weights.method: dlfc"
        notices.append(Notice("paraxial-lens", "camera.main_lens.aperture_mm", text, remedy, error_px, limit))
    return notices


def _na(camera: Camera) -> float:
    """Return the numerical aperture towards the scene, in air."""
    tangent = tracing.rim_tangent(camera)
    return float(tangent / np.hypot(1.0, tangent))


# Measured on one core. A voxel's factors along an axis have 2 to 2.6 entries for each pixel of a lens image; they take
# 8 bytes and 1.2 us each, the aperture's mask 0.3 us a pixel of the sensor. A projection makes 5e9 multiplications a
# second, one for each entry along the rows and pixel along the columns; those of strips take half as long again. Behind
# curved faces fitting the rays of a strip's block takes .45 s and its entries half as long as others; that blocks will
# do is judged by a few of them, in both directions, before the work is estimated and again before it is done. A column
# takes some 8 ms and 1,500 pixels of 8 bytes, behind curved faces 13 ms. A core counts some four million rays a
# second.
ENTRIES_PER_PIXEL = 2.5
ENTRY_BYTES, ENTRY_S, MASK_PIXEL_S = 8, 1.2e-6, 3e-7
BLOCK_S, BLOCK_ENTRY_S, JUDGED_S, TIMES_JUDGED = 0.45, 6e-7, 0.28, 4
MULTIPLICATIONS_PER_S = 5e9
COLUMN_S, COLUMN_BYTES = 8e-3, 12_000
RAYS_PER_CORE_HOUR = 1.5e10
# To find and fit a tracer at about the best seeding. Of 600 x 448 pixels an image with 582 takes 9.1 s, one with 109
# takes 5.0 s: some 4 s are the image's own, which goes with its microlenses. Some 17 s come before the first one.
TRACER_S = 0.02
# Half an hour on two cores.
MOST_RAYS = 3e10
# Volumes and images of float32 that a solver holds.
VOLUMES_HELD, IMAGES_HELD, FLOAT_BYTES = 8, 12, 4
# Estimates may be too large by this.
WRONG_BY = 3.0
SMALLER = "a smaller volume, or larger voxels, need less"
# More than this is worth a word before it begins.
LONG_S, MUCH_BYTES = 600.0, 8e9


@dataclass(frozen=True)
class Cost:
    """Bytes in memory or in the file, and seconds of one core.

    Attributes
    ----------
    voxels : of the volume and its padding
    weights_bytes, weights_core_s : of making the weights
    image_bytes, image_core_s : of one volume by the configured solver, at most where columns are made on demand
    """

    voxels: int
    weights_bytes: float
    weights_core_s: float
    image_bytes: float
    image_core_s: float

    def summary(self) -> dict[str, float]:
        """Return the figures, named as estimates."""
        return {f"estimated_{name}": value for name, value in asdict(self).items()}


def cost_of(settings: Config, camera: Camera, source: Source, grid: Grid) -> Cost:
    """Return what the weights of a grid, padding included, and a volume on it will cost."""
    columns, rows, planes = grid.shape_xyz if camera.column_axis == "x" else (grid.shape_xyz[1], *grid.shape_xyz[::2])
    voxels, pixels = math.prod(grid.shape_xyz), camera.columns * camera.rows
    held = held_bytes(voxels, pixels)
    projections = 2 * settings.reconstruction.iterations
    rays = _rays(settings, source, grid)
    # In how many strips, and parts of strips, they factorise, 0 where they do in none.
    strips = 0.0
    if isinstance(source, CurvedSpace) and not rays:
        layout = strips_of(camera, source, grid)
        strips = 0.0 if layout is None else layout.strips * layout.parts
    elif not rays:
        strips = float(separates(camera, source, grid))
    if not strips:
        kept = columns_bytes(voxels)
        solving = projections * voxels * COLUMN_BYTES / ENTRY_BYTES / MULTIPLICATIONS_PER_S
        weights_bytes, making = (kept, 0.0) if rays else (0.0, voxels * COLUMN_S)
        return Cost(voxels, weights_bytes, 3600.0 * rays / RAYS_PER_CORE_HOUR, held + kept, making + solving)
    entries = ENTRIES_PER_PIXEL * float(camera.micro_image_lattice_px().pitch.mean())
    both_axes, pixel_bytes = planes * (strips * columns + rows) * entries, FLOAT_BYTES * pixels
    products = planes * rows * entries * (columns + camera.columns)
    weights_bytes, weights_s = both_axes * ENTRY_BYTES + pixel_bytes, both_axes * ENTRY_S + pixels * MASK_PIXEL_S
    if isinstance(source, CurvedSpace):
        blocks = (-(-planes // SLAB), -(-rows // STRIP))
        judged = TIMES_JUDGED * math.prod(map(min, blocks, PARTS_JUDGED[::-1]))
        weights_s += both_axes * (BLOCK_ENTRY_S - ENTRY_S) + BLOCK_S * math.prod(blocks) + JUDGED_S * judged
    image_bytes, image_s = held + both_axes * ENTRY_BYTES + pixel_bytes, projections * products / MULTIPLICATIONS_PER_S
    return Cost(voxels, weights_bytes, weights_s, image_bytes, image_s)


def ensure_fits(cost: Cost, output: Path) -> None:
    """Refuse weights that cannot be made here, or whose volume could not be held: no command could use them.

    Raises
    ------
    OutputError
    """
    made, volume = cost.weights_bytes / WRONG_BY, float(BYTES_A_VOXEL * cost.voxels)
    ensure_room(
        max(made, volume), f"a volume of {written(cost.voxels)} voxels (padding included), or its weights,", SMALLER
    )
    left = shutil.disk_usage(output.parent).free
    if made > left:
        raise OutputError(f"{output}: needs {made / GB:.2f} GB, and {left / GB:.2f} GB are free on the disk")


def ensure_volume_fits(settings: Config, by_volumes: bool) -> None:
    """Refuse a volume that could not be held, before there are weights to know its padding by.

    Parameters
    ----------
    by_volumes : whether it will be solved for, which takes several of it

    Raises
    ------
    OutputError
    """
    shape = settings.grid().shape_xyz
    voxels, pixels = math.prod(shape), math.prod(settings.image_shape())
    held = held_bytes(voxels, pixels) if by_volumes else float(BYTES_A_VOXEL * voxels)
    ensure_room(held, f"a volume of {shape[0]} x {shape[1]} x {shape[2]} voxels", SMALLER)


def held_bytes(voxels: int, pixels: int) -> float:
    """Return what a solver holds in memory besides the weights, for a volume, padding included, and an image."""
    return FLOAT_BYTES * (VOLUMES_HELD * voxels + IMAGES_HELD * pixels)


def columns_bytes(voxels: int) -> float:
    """Return what columns take in memory that are made on demand, at most."""
    return float(min(voxels * COLUMN_BYTES, LARGEST_BYTES))


def check_rays(settings: Config, source: Source, grid: Grid) -> None:
    """Refuse to count more rays for a grid, padding included, than there is time for (ConfigError)."""
    rays, voxels = _rays(settings, source, grid), math.prod(grid.shape_xyz)
    if rays > MOST_RAYS:
        raise ConfigError(
            f"weights.sampling: counting {written(rays)} rays for {voxels} voxels (padding included) would take about "
            f"{written(rays / RAYS_PER_CORE_HOUR, 2)} core hours and {written(voxels * COLUMN_BYTES / 1e9, 2)} GB; at "
            f"most {written(MOST_RAYS)} are counted, use sampling: exact"
        )


def _rays(settings: Config, source: Source, grid: Grid) -> int:
    """Return how many rays are to be counted for a grid, 0 where weights are integrals."""
    chosen = settings.weights
    if chosen.sampling == "exact" or isinstance(source, tracing.PolynomialRays):
        return 0
    return math.prod(grid.shape_xyz) * RayCount(chosen.points, chosen.rays_per_point).rays


def cost_notices(cost: Cost) -> list[Notice]:
    """Return whether making the weights, or holding what a volume needs, is more than one would expect."""
    most = max(cost.weights_bytes, cost.image_bytes)
    if cost.weights_core_s <= LONG_S and most <= MUCH_BYTES:
        return []
    text = (
        f"weights of {written(cost.voxels)} voxels will take about {written(cost.weights_core_s / 60.0, 2)} "
        f"minutes of a core, and a volume of one image up to {written(most / 1e9, 2)} GB and "
        f"{written(cost.image_core_s / 60.0, 2)} minutes of a core"
    )
    remedy = "a smaller volume or larger voxels; --dry-run tells what others will take"
    share = max(cost.weights_core_s / LONG_S, most / MUCH_BYTES)
    expected = f"at most {LONG_S / 60.0:g} minutes for the weights and {MUCH_BYTES / 1e9:g} GB"
    return [Notice("heavy-work", "volume", text, remedy, share, expected)]
