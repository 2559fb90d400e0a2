"""Reconstructing the volume behind an image in memory; what takes part of an image, and what does not."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.calibration.lens_light import LensImages
from lfpiv_cli.calibration.light_checks import (
    exposure_notices,
    level_notices,
    position_notices,
    saturated_share,
    uniform_notices,
)
from lfpiv_cli.calibration.rectification import Rectification
from lfpiv_cli.calibration.sheet import sheet_fit
from lfpiv_cli.errors import InputError, UsageError
from lfpiv_cli.files.config import Config, carried_config
from lfpiv_cli.files.provenance import record
from lfpiv_cli.files.vtkhdf import Volume
from lfpiv_cli.files.weights_file import WeightsFile
from lfpiv_cli.interface.notices import warn_of
from lfpiv_cli.notice import Notice, written
from lfpiv_cli.reconstruction.equations import Normalisers, Operator, normalisers
from lfpiv_cli.reconstruction.images import Image, Mask, as_if_lit, defects, filled, light, saturated, touched
from lfpiv_cli.reconstruction.solvers import Reconstruction
from lfpiv_cli.reconstruction.solvers import reconstruct as solve
from lfpiv_cli.robust import HALF_NORMAL_MEDIAN, MAD_TO_SIGMA

Progress = Callable[[int], None]

# The brightest of some millions of pixels stands 5.2 standard deviations out of normal noise.
NOISE_SIGMAS = 6.0
# The name of one in memory.
IMAGE = "the image"
MOVED_SINCE_CALIBRATION = (
    "calibrate with a white image of the camera as it is, or refine-calibration, which finds the shift"
)


def reconstruct(
    weights: WeightsFile,
    image: NDArray[Any],
    *,
    dark: NDArray[Any] | None = None,
    background: NDArray[Any] | None = None,
    mask: NDArray[Any] | None = None,
    **settings: Any,
) -> Volume:
    """Reconstruct the volume of tracer particles behind an image.

    Parameters
    ----------
    weights : WeightsFile
        From `build_weights` or `open_weights`.
    image : (rows, columns) counts
        Raw image.
    dark : (rows, columns) counts, optional
        Raw image taken with the cap on: is subtracted, and its hot and dead pixels are left out.
    background : (rows, columns) counts, optional
        Raw image without tracers, subtracted in place of the dark one.
    mask : (rows, columns), optional
        0 where pixels are left out (reflections, bubbles).
    **settings
        Keys of the rig's section `reconstruction`, in their place: solver, iterations, relaxation and so on.

    Returns
    -------
    Volume
        `array` (nz, ny, nx) float32, light in counts; `grid`, spacing and origin in mm, z from the volume's reference;
        `attributes` with the relative `residual` after each iteration.

    Raises
    ------
    ConfigError
        The settings are not possible.
    UsageError
        The solver is `particles`, which makes no volume: see `find_particles`.
    InputError
        An image has another shape than what the weights were made for, or does not fit into memory.
    """
    chosen = carried_config(weights.provenance, "the weights").overridden("reconstruction", **settings)
    if chosen.reconstruction.solver == "particles":
        raise UsageError("reconstruct: the solver particles makes no volume; find_particles finds them")
    bench = bench_of(weights, chosen, given_picture(weights, dark), given_picture(weights, mask))
    raw = picture_for(weights, image)
    lit = light(raw, bench.dark, given_picture(weights, background))
    check_frame(bench, raw, IMAGE)
    warn_of(frame_notices(bench, raw, lit, IMAGE))
    return volume_of(bench, raw, lit, record("reconstruct", chosen.resolved(), {}))


@dataclass(frozen=True, eq=False)
class Bench:
    """What all frames of a recording share.

    Attributes
    ----------
    dark : dark image (rows, columns) or None
    lasting : raw pixels that are never usable: defects of the dark image, and where the mask is black
    excluded : pixels in the weights' frame that never take part: off the sensor, or touched by `lasting`
    sums : of the weights without `excluded`; None where weights are made for each image
    lens_images : what the light of frames is held against
    light_covariance : of the tracers' size and of diffusion, see `particles.diffusion`; None: not measured
    """

    content: WeightsFile
    settings: Config
    dark: Image | None
    lasting: Mask
    excluded: Mask
    sums: Normalisers | None
    lens_images: LensImages
    light_covariance: NDArray[np.float64] | None = None

    def unusable(self, raw: Image) -> Mask:
        """Return which pixels of a raw frame take no part."""
        return np.asarray(self.lasting | saturated(raw, self.settings.reconstruction.saturation_counts))

    def excluded_with(self, unusable: Mask) -> Mask:
        """Return which pixels in the weights' frame take no part in a frame with unusable raw pixels."""
        too_bright = unusable & ~self.lasting
        if not too_bright.any():
            return self.excluded
        return self.excluded | touched(too_bright, self.content.weights.prepare)

    def sums_without(self, operator: Operator, excluded: Mask) -> Normalisers:
        """Return an operator's sums without what a frame excludes: from those that all frames share, if they do."""
        if self.sums is None:
            return normalisers(operator, excluded)
        return self.sums if excluded is self.excluded else self.sums.without(operator, excluded)


def bench_of(
    content: WeightsFile, settings: Config, dark: Image | None, mask: Image | None, earlier: Bench | None = None
) -> Bench:
    """Return what all frames share, given a dark image and a mask (rows, columns) that is 0 where nothing is believed.

    The sums are those of an `earlier` one with the same weights and pixels.

    Raises
    ------
    InputError
        No pixel is left.
    """
    weights = content.weights
    lasting = np.zeros(weights.image_shape, np.bool_) if dark is None else defects(dark)
    if mask is not None:
        lasting |= mask == 0.0
    if lasting.all():
        raise InputError("mask and dark image leave out all pixels; a mask is black only where nothing is believed")
    excluded = touched(lasting, weights.prepare) if lasting.any() else np.zeros(weights.image_shape, np.bool_)
    if weights.calibration is not None:
        excluded |= ~weights.calibration.rectification.inside
    if earlier is not None and earlier.content is content and np.array_equal(earlier.excluded, excluded):
        sums = earlier.sums
    else:
        sums = None if weights.on_demand else normalisers(weights.padded, excluded)
    return Bench(content, settings, dark, lasting, excluded, sums, _lens_images(content))


def _lens_images(content: WeightsFile) -> LensImages:
    """Return the lens images that weights were made for: calibrated, or the data sheet's."""
    found, camera = content.weights.calibration, content.camera
    if found is None:
        return LensImages.of(Rectification(sheet_fit(camera), content.image_shape), None, camera.lens_image_width)
    return LensImages.of(found.rectification, found.transmission, camera.lens_image_width)


def volume_of(
    bench: Bench, raw: Image, lit: Image, provenance: Mapping[str, Any], progress: Progress | None = None
) -> Volume:
    """Return the volume behind a raw frame, given also with dark or background taken off (`lit`)."""
    unusable = bench.unusable(raw)
    excluded = bench.excluded_with(unusable)
    content = bench.content
    result = _solved(bench, content.weights.prepare(filled(lit, unusable)), excluded, progress)
    return Volume(
        content.weights.to_world(result.volume),
        content.reference.grid_from_focal_point(content.weights.grid),
        content.reference,
        attributes=content.reference.attributes()
        | {
            "residual": result.residual,
            "excluded_pixels": int(np.count_nonzero(excluded)),
            "support_voxels": result.support_voxels,
        },
        provenance=dict(provenance),
    )


def check_frame(bench: Bench, raw: Image, place: str) -> None:
    """Refuse a raw frame that shows nothing at all: no pixel is usable, or it has one value everywhere.

    Raises
    ------
    InputError
    """
    if raw.min() == raw.max():
        raise InputError(f"{place}: has one value everywhere ({raw.flat[0]:g}); it shows no particles")
    if bench.unusable(raw).all():
        raise InputError(f"{place}: all pixels are saturated or left out; there is nothing to reconstruct from")


def frame_notices(bench: Bench, raw: Image, lit: Image, name: str) -> list[Notice]:
    """Return what speaks against a raw frame, given also with dark or background taken off (`lit`)."""
    unusable = bench.unusable(raw)
    seen, used = np.where(unusable, np.float32(np.nan), lit), lit[~unusable]
    share = saturated_share(seen, unusable & ~bench.lasting, bench.lens_images.background(seen))
    notices = exposure_notices(share, name)
    brightest, noise = float(used.max() - np.median(used)), _noise(used)
    if brightest <= NOISE_SIGMAS * noise:
        notices.append(
            Notice(
                "frame-dark",
                name,
                f"its brightest pixel is {written(brightest)} counts above the others, with a noise of "
                f"{written(noise)}: no more than noise makes",
                "check light, exposure and the order of the frames",
                brightest,
                f"above {written(NOISE_SIGMAS * noise)}",
            )
        )
    return [*notices, *_light_notices(bench, seen, name)]


def _light_notices(bench: Bench, lit: Image, name: str) -> list[Notice]:
    """Return what the light of a frame, its unusable pixels NaN, says against it and the calibration."""
    images, calibration = bench.lens_images, bench.content.weights.calibration
    notices = [] if calibration is None else list(uniform_notices(images, calibration.fit, lit, name))
    return [*notices, *level_notices(images, lit, name), *position_notices(images, lit, name, MOVED_SINCE_CALIBRATION)]


def _noise(counts: NDArray[np.float32]) -> float:
    """Return at most the standard deviation of an image's noise: by what lies below 0, or around the median."""
    noise = MAD_TO_SIGMA * float(np.median(np.abs(counts - np.median(counts))))
    below = counts[counts < 0.0]
    return min(noise, float(np.median(-below)) / HALF_NORMAL_MEDIAN) if below.size else noise


def _solved(bench: Bench, image: Image, excluded: Mask, progress: Progress | None) -> Reconstruction:
    """Return the reconstruction of an image in the weights' frame."""
    operator = bench.content.weights.padded
    if bench.sums is None:
        operator = operator.for_image(as_if_lit(image, excluded))
    sums = bench.sums_without(operator, excluded)
    return solve(operator, image, bench.settings.solver_settings(), sums=sums, progress=progress)


def picture_for(weights: WeightsFile, picture: NDArray[Any]) -> Image:
    """Return a picture as the reader of files has it, float32.

    Raises
    ------
    InputError
        Its shape is not that of the images that the weights were made for.
    """
    if np.shape(picture) != weights.image_shape:
        raise InputError(f"a picture of {np.shape(picture)} pixels does not fit weights made for {weights.image_shape}")
    return np.asarray(picture, dtype=np.float32)


def given_picture(weights: WeightsFile, picture: NDArray[Any] | None) -> Image | None:
    """Return a picture as `picture_for` does, None where there is none."""
    return None if picture is None else picture_for(weights, picture)
