"""Frames: read ahead, dark and background taken off; what of them takes part, and what speaks against them.

Their records say of which other frames background and mask are made.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.arrays import Floats, Singles
from lfpiv_cli.calibration import light_checks
from lfpiv_cli.calibration.lens_light import LensImages, level_error
from lfpiv_cli.calibration.rectification import Rectification
from lfpiv_cli.calibration.sheet import sheet_fit
from lfpiv_cli.errors import InputError, UsageError
from lfpiv_cli.files import images as image_files
from lfpiv_cli.files.batch import Frame
from lfpiv_cli.files.config import Config
from lfpiv_cli.files.inputs import given
from lfpiv_cli.files.provenance import sha256
from lfpiv_cli.files.weights_file import WeightsFile
from lfpiv_cli.notice import Notice, written
from lfpiv_cli.reconstruction import images as of_images
from lfpiv_cli.reconstruction.haze import ROUNDING_COUNTS, Haze, white_of
from lfpiv_cli.reconstruction.images import Image, Mask
from lfpiv_cli.reconstruction.solvers import Normalisers, Operator, normalisers
from lfpiv_cli.robust import MAD_TO_SIGMA, spread_below_zero

# Beyond so much the two are not the same.
CONTRADICTING_SHARE = 0.01

Found = TypeVar("Found")
# Reads frame `number`: raw, and with dark or background taken off.
Read = Callable[[int], tuple[Image, Image]]

# In place of a mask's file: what does not move in the frames is left out.
STILL = "still"
BACKGROUNDS = {"minimum": of_images.minimum_background, "mean": of_images.mean_background}


@dataclass(frozen=True)
class Background:
    """What is subtracted as background: an image, or the minimum or mean over the frames, or over some around each.

    Attributes
    ----------
    path : of the image, None where it is made from the frames
    kind : name in `BACKGROUNDS`
    frames : how many around each frame; None: all of them
    """

    path: Path | None = None
    kind: str | None = None
    frames: int | None = None

    @classmethod
    def parse(cls, text: str | None) -> Background:
        """Return the background given as a file's name, `minimum`, `mean`, or `minimum:15` for fifteen frames."""
        if text is None:
            return cls()
        over_frames = re.fullmatch(rf"({'|'.join(BACKGROUNDS)})(?::(\d+))?", text)
        if over_frames is None:
            return cls(path=Path(text))
        kind, count = over_frames.groups()
        return cls(kind=kind, frames=None if count is None else int(count))

    def around(self, number: int, total: int) -> range:
        """Return the numbers of the frames, of `total`, that the background of one is made from."""
        if self.kind is None:
            return range(0)
        count = total if self.frames is None else min(self.frames, total)
        first = min(max(number - count // 2, 0), total - count)
        return range(first, first + count)


@dataclass(frozen=True, kw_only=True)
class ImageOptions:
    """What is taken off images, and what of them is left out.

    Attributes
    ----------
    dark : image taken with the cap on; its hot and dead pixels are left out
    background : image to subtract, or `minimum` or `mean` over the images, or as `minimum:15`
    mask : image that is black where pixels are left out, or `still`: where bright light does not move in the images
    """

    dark: Path | None = None
    background: str | None = None
    mask: str | Path | None = None

    @property
    def level(self) -> Background:
        """The background."""
        return Background.parse(self.background)

    @property
    def mask_file(self) -> Path | None:
        """The mask, where it is a file."""
        return None if self.mask in (None, STILL) else Path(str(self.mask))

    def ensure_one_by_one(self) -> None:
        """Refuse what is made from all frames, of which some are still to come (UsageError)."""
        if self.level.kind is not None or self.mask == STILL:
            refused = f"--background {self.background}" if self.level.kind else f"--mask {STILL}"
            why = "made from all frames, some of which have not come yet; wait for them"
            raise UsageError(f"--watch: {refused} is {why}")

    def files(self, weights: Path) -> dict[str, Path]:
        """Return the files that all frames are made from by their roles."""
        return given(weights=weights, dark=self.dark, background=self.level.path, mask=self.mask_file)


def reader(
    level: Background, frames: Sequence[Frame], shape: tuple[int, int], dark: Image | None, keep_going: bool = False
) -> Read:
    """Return the function that reads frame `number`: raw, and with dark or background taken off.

    With `keep_going` frames that cannot be read are left out of the backgrounds of others.
    """
    fixed = image_files.read_reference(level.path, shape) if level.path else None
    window = len(level.around(0, len(frames)))

    @lru_cache(maxsize=window if level.frames else 1)
    def page(number: int) -> Image:
        return read_frame(frames[number], shape)

    @lru_cache(maxsize=1)
    def over(numbers: range) -> Singles:
        return BACKGROUNDS[level.kind or ""](readable(page, numbers, keep_going))

    def read(number: int) -> tuple[Image, Image]:
        numbers = level.around(number, len(frames))
        raw = page(number)
        return raw, of_images.light(raw, dark, over(numbers) if level.kind else fixed)

    return read


def read_frame(frame: Frame, shape: tuple[int, int]) -> Image:
    """Read a frame (InputError: it cannot be read, or has another shape)."""
    if frame.fault is not None:
        raise InputError(frame.fault)
    return image_files.read_image(frame.path, frame.page, shape)


def readable(read: Callable[[int], Found], numbers: Iterable[int], keep_going: bool) -> Iterator[Found]:
    """Yield images, those that cannot be read left out where the others are to go on."""
    for number in numbers:
        try:
            image = read(number)
        except InputError:
            if not keep_going:
                raise
            continue
        yield image


class ReadAhead:
    """Frames, each read while the one before is worked on."""

    def __init__(self, read: Read, numbers: Sequence[int]) -> None:
        """Take the function that reads a frame, and the numbers of those that are coming in their order."""
        self._read, self._pool = read, ThreadPoolExecutor(max_workers=1)
        self._following = dict(pairwise(numbers))
        self._coming: tuple[int, Future[tuple[Image, Image]]] | None = None

    def __call__(self, number: int) -> tuple[Image, Image]:
        """Return a frame, and begin to read the one that follows."""
        coming, self._coming = self._coming, None
        current = coming[1] if coming and coming[0] == number else self._pool.submit(self._read, number)
        following = self._following.get(number)
        if following is not None:
            self._coming = following, self._pool.submit(self._read, following)
        return current.result()


def other_frames(level: Background, frames: Sequence[Frame], mask: str | Path | None = None) -> Callable[[int], str]:
    """Return the function that says which other frames the background and mask of one are made from.

    Frames whose files cannot be read at all are not among them.
    """

    # The frames around one are nearly those around the next.
    @lru_cache(maxsize=max(2 * (level.frames or 0), 1))
    def page(number: int) -> str:
        return f"{sha256(frames[number].path)} {frames[number].page}\n"

    # Where the background is made from all frames, it is the same for all, as the mask is.
    @lru_cache(maxsize=2)
    def over(numbers: range) -> str:
        pages = [page(k) for k in numbers if frames[k].fault is None]
        digest = hashlib.sha256("".join(pages).encode()).hexdigest()
        return f"over {len(pages)} frames, SHA-256 {digest}"

    def words(number: int) -> str:
        around = level.around(number, len(frames))
        background = "" if level.kind is None else f", background: {level.kind} {over(around)}"
        return background + (f", mask: {STILL} {over(range(len(frames)))}" if mask == STILL else "")

    return words


Progress = Callable[[int], None]

# Where more middles of lens images than this share are within so many standard deviations of what is between lens
# images, half of them within a quarter of one, there is no haze: so many are of one tracer for each microlens.
MOST_DARK, DARK_SIGMAS, LEAST_SIGMAS = 0.1, 3.0, 0.25
# The brightest of some millions of pixels stands 5.2 standard deviations out of normal noise.
NOISE_SIGMAS = 6.0
# The name of one in memory.
IMAGE = "the image"
MOVED_SINCE_CALIBRATION = (
    "calibrate with a white image of the camera as it is, or refine-calibration, which finds the shift"
)


@dataclass(frozen=True, eq=False)
class Bench:
    """What all frames of a recording share.

    Attributes
    ----------
    dark : dark image (rows, columns) or None
    lasting : raw pixels that are never usable: defects of the dark image, specks' shadows, and where the mask is black
    excluded : pixels in the weights' frame that never take part: off the sensor, or touched by `lasting`
    sums : of the weights without `excluded`; None where weights are made for each image
    lens_images : what the light of frames is held against
    light_covariance : of the tracers' size and of diffusion, see `particles.camera_light`; None: not measured
    """

    content: WeightsFile
    settings: Config
    dark: Image | None
    lasting: Mask
    excluded: Mask
    sums: Normalisers | None
    lens_images: LensImages
    light_covariance: Floats | None = None

    def unusable(self, raw: Image) -> Mask:
        """Return which pixels of a raw frame take no part."""
        return np.asarray(self.lasting | of_images.saturated(raw, self.settings.reconstruction.saturation_counts))

    def excluded_with(self, unusable: Mask) -> Mask:
        """Return which pixels in the weights' frame take no part in a frame with unusable raw pixels."""
        too_bright = unusable & ~self.lasting
        if not too_bright.any():
            return self.excluded
        return self.excluded | of_images.touched(too_bright, self.content.weights.prepare)

    def haze_in(self, lit: Image, unusable: Mask) -> tuple[Haze | None, float]:
        """Return the haze in a raw frame with dark or background taken off, and its standard error in counts.

        None: there is none, or none that is certain. Few tracers leave most lens images dark, which takes less time to
        see than haze.
        """
        calibration = self.content.weights.calibration
        if calibration is None or calibration.white is None or not calibration.fit.lenses:
            return None, 0.0
        level, noise = self.lens_images.background(np.where(unusable, np.float32(np.nan), lit))
        column, row = np.clip(np.rint(calibration.fit.centres_px).astype(np.int64), 0, np.array(lit.shape[::-1]) - 1).T
        above = lit[row, column] - level
        dark = above[np.abs(above) < DARK_SIGMAS * noise]
        if dark.size > MOST_DARK * above.size and np.median(dark) < LEAST_SIGMAS * noise:
            return None, float(np.hypot(np.median(dark), ROUNDING_COUNTS))
        white = white_of(calibration)
        known = level_error(noise, self.lens_images.between.size)
        return (None, 0.0) if white is None else white.haze_in(lit, ~unusable, (level, noise), known)

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
    lasting = np.zeros(weights.image_shape, np.bool_) if dark is None else of_images.defects(dark)
    if mask is not None:
        lasting |= mask == 0.0
    if weights.calibration is not None and weights.calibration.shadowed is not None:
        lasting |= weights.calibration.shadowed
    if lasting.all():
        raise InputError("mask and dark image leave out all pixels; a mask is black only where nothing is believed")
    excluded = of_images.touched(lasting, weights.prepare) if lasting.any() else np.zeros(weights.image_shape, np.bool_)
    if weights.calibration is not None:
        excluded |= ~weights.calibration.rectification.inside
    if earlier is not None and earlier.content is content and np.array_equal(earlier.excluded, excluded):
        sums = earlier.sums
    else:
        sums = None if weights.on_demand else normalisers(weights.padded, excluded)
    # The lens images that the weights were made for: calibrated, or the data sheet's.
    calibration, camera = weights.calibration, content.camera
    rectification = calibration.rectification if calibration else Rectification(sheet_fit(camera), content.image_shape)
    transmission = calibration.transmission if calibration else None
    lens_images = LensImages.of(rectification, transmission, camera.lens_image_fill)
    return Bench(content, settings, dark, lasting, excluded, sums, lens_images)


def check_frame(bench: Bench, raw: Image, place: str) -> None:
    """Refuse a raw frame that shows nothing at all: no pixel is usable, or it has one value everywhere (InputError)."""
    if raw.min() == raw.max():
        raise InputError(f"{place}: has one value everywhere ({raw.flat[0]:g}); it shows no particles")
    if bench.unusable(raw).all():
        raise InputError(f"{place}: all pixels are saturated or left out; there is nothing to reconstruct from")


def frame_notices(bench: Bench, raw: Image, lit: Image, name: str) -> list[Notice]:
    """Return what speaks against a raw frame, given also with dark or background taken off (`lit`)."""
    unusable = bench.unusable(raw)
    seen, used = np.where(unusable, np.float32(np.nan), lit), lit[~unusable]
    share = light_checks.saturated_share(seen, unusable & ~bench.lasting, bench.lens_images.background(seen))
    notices = light_checks.exposure_notices(share, name)
    brightest = float(used.max() - np.median(used))
    noises: list[float] = []
    for noise in _noise_at_most(seen):
        noises.append(noise)
        if brightest > NOISE_SIGMAS * noise:
            break
    else:
        text = (
            f"its brightest pixel is {written(brightest)} counts above the others, with a noise of "
            f"{written(min(noises))}: no more than noise makes"
        )
        remedy = "check light, exposure and the order of the frames"
        expected = f"above {written(NOISE_SIGMAS * min(noises))}"
        notices.append(Notice("frame-dark", name, text, remedy, brightest, expected))
    images, calibration = bench.lens_images, bench.content.weights.calibration
    if calibration is not None:
        notices += light_checks.uniform_notices(images, calibration.fit, seen, name)
    return [
        *notices,
        *light_checks.level_notices(images, seen, name),
        *light_checks.position_notices(images, seen, name, MOVED_SINCE_CALIBRATION),
    ]


def _noise_at_most(seen: Image) -> Iterator[float]:
    """Yield what the standard deviation of an image's noise is at most, NaN where a pixel is not usable.

    By the median, around which crowded tracers spread, too; by what lies below 0, of which they leave none; and between
    pixels side by side, where their light changes little. Each sorts some millions of pixels.
    """
    counts = seen[np.isfinite(seen)]
    yield MAD_TO_SIGMA * float(np.median(np.abs(counts - np.median(counts))))
    below = spread_below_zero(counts)
    if below > 0.0:
        yield below
    steps = np.concatenate([np.diff(seen, axis=axis).ravel() for axis in (0, 1)])
    steps = np.abs(steps[np.isfinite(steps)])
    if steps.size:
        yield MAD_TO_SIGMA * float(np.median(steps)) / np.sqrt(2.0)


def haze_notices(attributes: Mapping[str, Any], name: str) -> list[Notice]:
    """Return what is said of the haze that was taken off a frame, by the attributes of what was made of it."""
    if "haze_counts" not in attributes:
        return []
    level = float(attributes["haze_counts"])
    text = (
        f"{written(level)} counts in the middle of lens images, smooth over the sensor, are no tracer's light: this "
        "haze is taken off, its noise stays"
    )
    remedy = "less scattered light: clean windows and fluid, a dark wall behind, a filter before fluorescent tracers"
    return [Notice("haze", name, text, remedy, level, "none above the noise")]


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


def residual_path(particles: Path) -> Path:
    """Return where the residual image of a file of particles goes."""
    return particles.with_name(f"{particles.stem}_residual.tif")


def dt_notices(stated_s: float | None, recorded_s: Iterable[float | None], name: str) -> list[Notice]:
    """Return where a stated time between frames contradicts the recorded ones, as far as these are known."""
    known = [step for step in recorded_s if step is not None]
    if stated_s is None or not known:
        return []
    worst = max(known, key=lambda step: abs(step - stated_s))
    if abs(worst - stated_s) <= CONTRADICTING_SHARE * stated_s:
        return []
    text = f"its frames were recorded {written(worst, 6)} s apart, and {written(stated_s, 6)} s are stated"
    remedy = "correct correlation.dt_s, or leave it out: then the recorded time is taken"
    return [Notice("time-between-frames", name, text, remedy, worst, f"{stated_s:g}")]
