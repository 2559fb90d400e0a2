"""Finding the particles behind an image in memory (iterative particle reconstruction)."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.arrays import Floats, root_of_squares
from lfpiv_cli.errors import ConfigError, InputError
from lfpiv_cli.files import images as image_files
from lfpiv_cli.files.batch import Frame as ImageFrame
from lfpiv_cli.files.config import Config, carried_config
from lfpiv_cli.files.hdf5 import unpacked_bytes
from lfpiv_cli.files.inputs import ensure_room
from lfpiv_cli.files.particle_file import Points, symmetric
from lfpiv_cli.files.provenance import record
from lfpiv_cli.files.weights_file import WeightsFile, open_weights
from lfpiv_cli.grid import Scale
from lfpiv_cli.notice import Notice, warn_of
from lfpiv_cli.optics.curved_space import CurvedSpace
from lfpiv_cli.optics.tracing import ObjectSpace
from lfpiv_cli.particles.camera_light import FocalLength, focal_length_of
from lfpiv_cli.particles.counting import tracers_per_lens as counted
from lfpiv_cli.particles.diameter import ENOUGH, UNKNOWN_LENSES, diameter_by
from lfpiv_cli.particles.neighbour_frames import second_frame, second_pass
from lfpiv_cli.particles.noise import beside_neighbours
from lfpiv_cli.particles.rounds import ROUNDS, first_pass, steps_of
from lfpiv_cli.particles.search import LAST_UNEXPLAINED, MARGIN_DEPTHS, Task, task_of
from lfpiv_cli.particles.stated import MUCH_LEFT, Particles, result
from lfpiv_cli.particles.view import Light, View, ensure_square_cells, raw_view
from lfpiv_cli.reconstruction import images as of_images
from lfpiv_cli.reconstruction.haze import Haze
from lfpiv_cli.reconstruction.images import Image, Mask, filled, light
from lfpiv_cli.reconstruction.solvers import Normalisers
from lfpiv_cli.verbs import frames as of_frames
from lfpiv_cli.verbs.frames import IMAGE, STILL, Bench, Progress, Read, check_frame, read_frame, readable
from lfpiv_cli.verbs.tracers import TracerSize, light_notices, size_notices, tracer_size
from lfpiv_cli.weights.build import factorise_bricks
from lfpiv_cli.weights.columns import OnDemandOperator

# Frames that are looked at for the tracers' diameter, if the first do not hold enough.
LOOKED_AT = 5
# Depths beyond the volume for which light as waves is known, in depths over which light spreads by one lens.
BEYOND_DEPTHS = MARGIN_DEPTHS + 0.2
# Units of progress that `find`, `find_first` and `find_second` report.
STEPS = steps_of(ROUNDS)


def find_particles(
    weights: WeightsFile,
    image: NDArray[Any],
    *,
    neighbours: Sequence[NDArray[Any]] = (),
    dark: NDArray[Any] | None = None,
    background: NDArray[Any] | None = None,
    mask: NDArray[Any] | None = None,
    **settings: Any,
) -> Points:
    """Find the tracer particles behind an image: where they are, how bright, and how well that is known.

    Parameters
    ----------
    weights : WeightsFile
        From `build_weights` or `open_weights`.
    image : (rows, columns) counts
        Raw image.
    neighbours : sequence of (rows, columns) counts, optional
        Raw images of the frames before and after, or of the other one of a pair, which help to find what overlaps.
    dark, background, mask
        As of `reconstruct`.
    **settings
        Keys of the rig's section `reconstruction`, in their place: particle_diameter_mm, saturation_counts,
        photons_per_count.

    Returns
    -------
    Points
        `position_mm` (n, 3), z from the volume's reference, and in `arrays`: `intensity` (n,) counts and its standard
        error `intensity_sigma`, `covariance_mm2` (n, 6) as xx, yy, zz, xy, yz, xz, `chi2` (n,) about 1 where all light
        is explained, `seen` (n,) share of the light that meets the sensor, `flag` (n,) 1 outside the volume.

    Raises
    ------
    ConfigError
        The settings are not possible, rays are fitted (dlfc), or the microlenses do not stand upright.
    InputError
        An image has another shape than what the weights were made for.
    """
    carried = carried_config(weights.provenance, "the weights")
    chosen = carried.overridden("reconstruction", **(settings | {"solver": "particles"}))
    bench = of_frames.bench_of(
        searchable(weights, chosen),
        chosen,
        of_frames.given_picture(weights, dark),
        of_frames.given_picture(weights, mask),
    )
    level = of_frames.given_picture(weights, background)
    raws = [of_frames.picture_for(weights, each) for each in (image, *neighbours)]
    check_frame(bench, raws[0], IMAGE)
    notices = of_frames.frame_notices(bench, raws[0], light(raws[0], bench.dark, level), IMAGE)
    frame, *others = (frame_of(bench, raw, light(raw, bench.dark, level)) for raw in raws)
    bench, size = sized(bench, (frame, *others))
    if others:
        own, *beside = (find_first(bench, each) for each in (frame, *others))
        found = find_beside(bench, frame, own, beside)
    else:
        found = find(bench, frame)
    points = points_of(bench, frame, found, size, record("find_particles", chosen.resolved(), {}))
    warn_of([*notices, *size_notices(chosen, size), *light_notices(points, IMAGE)])
    return points


@dataclass(frozen=True, eq=False)
class Frame:
    """An image and what of it takes part.

    Attributes
    ----------
    image : (rows, columns) raw but for dark and background
    unusable : (rows, columns) pixels that take no part
    sums : of the padded weights without what these touch
    haze : in the image; None: none
    haze_error_counts : its standard error, also where none is certain
    """

    image: Image
    unusable: Mask
    sums: Normalisers
    haze: Haze | None = None
    haze_error_counts: float = 0.0

    @property
    def light(self) -> Image:
        """(rows, columns) the image without haze."""
        return self.image if self.haze is None else self.image - self.haze.image


def searchable(content: WeightsFile, settings: Config) -> WeightsFile:
    """Return weights to look for particles with: where an array is hexagonal, those of bricks for its cells.

    Columns on demand behind curved faces are made once and kept, where they fit into memory.

    Raises
    ------
    ConfigError
        Rays are fitted, the array does not stand upright, or it is hexagonal and seen through a scene.
    """
    if settings.weights.method == "dlfc":
        raise ConfigError("weights.method: particles are fitted with traced rays; build weights by ert for them")
    weights, operator = content.weights, content.weights.solver_operator
    space = _space(content, settings)
    ensure_square_cells(content.camera, space)
    if not isinstance(operator, OnDemandOperator):
        return content
    if isinstance(space, CurvedSpace):
        return replace(content, weights=replace(weights, solver_operator=operator.kept()))
    bricks = factorise_bricks(content.camera, settings.media_model(), weights.padded.grid)
    passing = bricks if operator.transmission is None else bricks.behind(operator.transmission)
    return replace(content, weights=replace(weights, solver_operator=passing))


def frame_of(bench: Bench, raw: Image, lit: Image) -> Frame:
    """Return a frame as particles are sought in it."""
    unusable = bench.unusable(raw)
    excluded = bench.excluded_with(unusable)
    sums = bench.sums_without(bench.content.weights.padded, excluded)
    return Frame(filled(lit, unusable), unusable, sums, *bench.haze_in(lit, unusable))


class Sized(NamedTuple):
    """The tracers' size; its covariance with diffusion where that is measured; whether enough tracers have told it."""

    size: TracerSize
    covariance: Floats | None
    is_certain: bool


def sized(bench: Bench, frames: Iterable[Frame], known: Sized | None = None) -> tuple[Bench, TracerSize]:
    """Return the bench with the tracers' size, and that: as it is known, or by its frames."""
    size, covariance, _ = known or size_of(bench, frames)
    keys = {"particle_diameter_mm": size.diameter_mm}
    if size.diffusion is not None:
        keys["diffusion_px"] = size.diffusion.px
    settings = bench.settings.overridden("reconstruction", **keys)
    return replace(bench, settings=settings, light_covariance=covariance), size


def size_of(bench: Bench, frames: Iterable[Frame]) -> Sized:
    """Return the tracers' diameter, from the first of its frames where it is not given.

    By waves with the sensor's charge diffusion.
    """
    chosen, lens_mm = bench.settings.reconstruction, _scale(bench).lens_mm
    given, given_px = chosen.particle_diameter_mm, chosen.diffusion_px
    found = diameter_by(
        (task_for(bench, frame) for frame in islice(frames, LOOKED_AT)), given and given / lens_mm, given_px
    )
    size = tracer_size(found, given, given_px, lens_mm, by_waves=chosen.wavelength_nm is not None)
    if found is not None:
        single = (tracer_size(each, given, given_px, lens_mm, size.diffusion is not None) for each in found.frames)
        size = replace(size, frames=tuple(single))
    held = None if found is None or size.diffusion is None else found.held
    return Sized(size, None if held is None else held.covariance, found is not None and found.tracers >= ENOUGH)


def find(bench: Bench, frame: Frame, progress: Progress | None = None) -> Particles:
    """Return the particles behind an image."""
    task = task_for(bench, frame)
    return result(task, first_pass(task, progress=progress))


def find_first(bench: Bench, frame: Frame, progress: Progress | None = None) -> Floats:
    """Return the particles (n, 4) of a frame's first pass, for its own second pass and those of its neighbours."""
    return first_pass(task_for(bench, frame), progress=progress).particles


def find_second(
    bench: Bench, frame: Frame, before: Frame, particles: Floats, progress: Progress | None = None
) -> Floats:
    """Return what `find_first` returns, for the second frame of a pair: with those (n, 4) of the first, `before`."""
    task = task_for(bench, frame)
    return second_frame(task, task_for(bench, before), particles, progress)


def find_beside(bench: Bench, frame: Frame, own: Floats, neighbours: Sequence[Floats]) -> Particles:
    """Return the particles behind an image with the help of the first passes of it and of the frames beside it."""
    task = task_for(bench, frame)
    return result(task, second_pass(task, own, neighbours))


def _scale(bench: Bench) -> Scale:
    return bench.content.camera.scale(bench.settings.media_model())


def task_for(bench: Bench, frame: Frame) -> Task:
    """Return the task that a frame sets."""
    content, photons = bench.content, bench.settings.reconstruction.photons_per_count
    # By waves for all depths of the weights.
    margin = BEYOND_DEPTHS * _scale(bench).depth_mm
    low, high = content.weights.padded.grid.bounds_mm(2)
    view = _view(bench, light_of(bench.settings, (low - margin, high + margin)))
    white = None if content.weights.calibration is None else content.weights.calibration.white
    return task_of(
        frame.image,
        view,
        content.weights,
        content.camera,
        frame.sums,
        frame.unusable,
        photons,
        bench.light_covariance,
        None if frame.haze is None else frame.haze.image,
        None if white is None or frame.haze_error_counts == 0.0 else frame.haze_error_counts * white,
    )


def _view(bench: Bench, waves: Light | None) -> View:
    """Return how particles are seen, by waves or by rays."""
    content, settings = bench.content, bench.settings
    radius = 0.5 * (settings.reconstruction.particle_diameter_mm or UNKNOWN_LENSES * _scale(bench).lens_mm)
    calibration, space = content.weights.calibration, _space(content, settings)
    # Particles are fitted behind arrays that stand upright, as in the weights' frame.
    return raw_view(content.camera, settings.media_model(), radius, calibration, space, waves, content.passed)


def light_of(settings: Config, depths_mm: tuple[float, float]) -> Light | None:
    """Return the light as waves, as it is fitted between two depths; None: by rays."""
    waves = settings.reconstruction.wave_light()
    return None if waves is None else Light(waves.wavelength_mm, waves.diffusion_px, depths_mm)


def points_of(bench: Bench, frame: Frame, found: Particles, size: TracerSize, provenance: Mapping[str, Any]) -> Points:
    """Return the particles found behind an image in the coordinates of files, by Snell's law where it is known."""
    content = bench.content
    space = _space(content, bench.settings)
    bounds = np.array([content.weights.grid.bounds_mm(axis) for axis in range(3)])
    within = (found.position_mm >= bounds[:, 0]) & (found.position_mm <= bounds[:, 1])
    inside = np.all(within, axis=1)
    # How many microlenses the volume fills as the scene shows them; they see what lies in front of and behind it, too.
    camera, (width, height, _) = content.camera, np.diff(bounds)[:, 0]
    lenses = float(width * height) * camera.magnification**2 / camera.lattice.cell_area
    seen, scale = np.all(within[:, :2], axis=1), _scale(bench)
    # Where light spreads by less than a lens each lights those that it lies over.
    narrow = seen & (np.abs(found.position_mm[:, 2]) < scale.depth_mm)
    lit_by_each = (1.0 + size.diameter_mm / scale.lens_mm) ** 2
    left, haze = what_is_left(frame, found), frame.haze
    norm = root_of_squares(np.where(frame.unusable, 0.0, frame.light))
    share_left = root_of_squares(left) / norm if norm > 0.0 else 0.0
    left_rms = float(np.sqrt(np.mean(left[~frame.unusable] ** 2)))
    noise = found.noise.of_dark(None if haze is None else haze.image[~frame.unusable].astype(np.float64))
    # Of four tracers for each microlens only 1.3 are found, and few of them are right. What noise leaves is no light.
    beside = beside_neighbours(left.ravel(), np.flatnonzero(~frame.unusable), left.shape[1])
    not_beside = max(1.0 - float(np.mean(beside**2)) / left_rms**2, 0.0) if left_rms > 0.0 else 0.0
    smooth = share_left * float(np.sqrt(not_beside))
    number = tracers_per_lens(bench, frame) if smooth > MUCH_LEFT else None
    focus = _focal_length(bench, frame, found)
    return Points(
        content.reference.points_from_focal_point(found.position_mm),
        {
            "intensity": found.light_counts,
            "intensity_sigma": found.light_sigma_counts,
            "covariance_mm2": symmetric(found.covariance_mm2),
            "chi2": found.chi2,
            "seen": found.seen,
            # Those outside the volume are kept because they light it.
            "flag": (~inside).astype(np.uint8),
        },
        content.reference,
        attributes=content.reference.attributes()
        | {
            "refraction": "paraxial" if isinstance(space, ObjectSpace) and space.straight else "exact",
            "light": "rays" if bench.settings.reconstruction.wavelength_nm is None else "waves",
            "residual": share_left,
            "residual_smooth": smooth,
            "residual_lit": found.left,
            "residual_alike": found.alike,
            "residual_rms_counts": left_rms,
            "excluded_pixels": int(np.count_nonzero(frame.unusable)),
            "read_noise_counts": noise,
            "particles_per_lens": float(np.count_nonzero(seen)) / lenses,
            "per_lens_in_focus": lit_by_each * float(np.count_nonzero(narrow)) / lenses,
            "depth_ambiguous": float(np.mean(found.ambiguous[inside])) if inside.any() else 0.0,
            "beyond_depths": float(np.mean(found.beyond)) if inside.size else 0.0,
        }
        | ({} if haze is None else {"haze_counts": haze.level_counts})
        | ({} if found.offset_counts is None else {"light_offset_counts": found.offset_counts})
        | ({} if number is None else {"tracers_per_lens": number})
        | ({} if focus is None else {"microlens_focus": focus.off, "microlens_focus_sigma": focus.sigma})
        | size.attributes(),
        provenance=dict(provenance),
    )


def _focal_length(bench: Bench, frame: Frame, found: Particles) -> FocalLength | None:
    """Return the microlenses' focal length by the particles of an image; None where too few tell it."""
    # By rays also where particles are fitted by waves, of which no second table is made: rays tell half of it.
    view = _view(bench, None)
    particles = np.column_stack([bench.content.camera.to_image_axes(found.position_mm), found.light_counts])
    residual = found.residual.ravel()
    weight = found.noise.weights(frame.image.ravel() - residual, residual, LAST_UNEXPLAINED)
    weight[frame.unusable.ravel()] = 0.0
    return focal_length_of(view, particles, residual, weight)


def what_is_left(frame: Frame, found: Particles) -> Floats:
    """Return what particles leave of an image (rows, columns), counts, 0 where it takes no part."""
    return np.where(frame.unusable, 0.0, found.residual)


def _space(content: WeightsFile, settings: Config) -> ObjectSpace | CurvedSpace:
    """Return what lies before the particles: by Snell's law where the window's thickness and place are known."""
    if settings.sections.scene is not None:
        return settings.object_space()
    calibration = content.weights.calibration
    mid_plane = calibration.mid_plane_z_mm if calibration else None
    if (settings.channel is None or mid_plane is None) and settings.sections.window is None:
        return ObjectSpace(settings.media_model(), None, "paraxial")
    return ObjectSpace(settings.media_model(), settings.window_model(mid_plane), "exact")


def tracers_per_lens(bench: Bench, frame: Frame) -> float | None:
    """Return the tracers for each microlens, counted by how uneven their light is.

    None where too little of the volume is seen. Their size hardly matters to it, and what crowded tracers seem to have
    would: it is taken as half a microlens.
    """
    settings = bench.settings.overridden("reconstruction", particle_diameter_mm=UNKNOWN_LENSES * _scale(bench).lens_mm)
    return counted(task_for(replace(bench, settings=settings), frame), bench.lens_images.lattice_px)


@dataclass(eq=False)
class Finder:
    """Finds the particles of frames, alone or with the first passes of those beside them.

    That of the second frame of a pair begins with what the first frame's found, never the other way round: so it does
    not matter which frames are there already.

    Attributes
    ----------
    bench, read : what frames share, and what reads one
    beside : the numbers of those beside each; None: each is found alone
    first_of : of each second frame of a pair the first
    keep_going : one of those beside may be unreadable
    """

    bench: Bench
    read: Read
    frames: Sequence[ImageFrame]
    beside: Sequence[tuple[int, ...]] | None
    first_of: Mapping[int, int]
    keep_going: bool

    def __post_init__(self) -> None:
        """Remember a frame and one at either side, two of which the next one needs again."""
        self._first_pass_of: Callable[[int], Floats] = lru_cache(maxsize=3)(self._first_pass)
        self._advance: Progress | None = None

    def find(self, number: int, frame: Frame, advance: Progress) -> tuple[Particles, list[Notice]]:
        """Return the particles of a frame, and which of those beside it did not help, or are the same image.

        Raises
        ------
        InputError : one beside it cannot be read, and that is to stop the batch
        """
        self._advance = advance
        if self.beside is None:
            return find(self.bench, frame, advance), []
        notices, helping = [], []
        for k in self.beside[number]:
            try:
                if self.keep_going:
                    self._frame(k)
                helping.append(k)
            except InputError as error:
                text = f"is found without the help of {self.frames[k].stem}: {error}"
                notices.append(Notice("frame-alone", self.frames[number].stem, text, "mend that one"))
        if not helping:
            return find(self.bench, frame, advance), notices
        for k in helping:
            if k > number and np.array_equal(self.read(k)[0], self.read(number)[0]):
                text = f"has the pixels of {self.frames[k].stem}: both are one and the same image"
                notices.append(Notice("frames-alike", self.frames[number].stem, text, "check that the images are two"))
        seen = {k: self._first_pass_of(k) for k in sorted((number, *helping))}
        return find_beside(self.bench, frame, seen[number], [seen[k] for k in helping]), notices

    def _first_pass(self, number: int) -> Floats:
        frame, first = self._frame(number), self.first_of.get(number)
        if first is None:
            return find_first(self.bench, frame, self._advance)
        before = self._frame(first)
        return find_second(self.bench, frame, before, self._first_pass_of(first), self._advance)

    def _frame(self, number: int) -> Frame:
        raw, lit = self.read(number)
        check_frame(self.bench, raw, str(self.frames[number].path))
        return frame_of(self.bench, raw, lit)


class Prepared:
    """Opens weights once, as long as their file stays as it is: of full size that takes as long as some frames.

    Attributes
    ----------
    size : of the tracers in all frames to come, where it is known before these are
    """

    def __init__(self) -> None:
        """Begin with nothing."""

        @lru_cache(maxsize=1)
        def opened(path: Path, *_state: int | None) -> WeightsFile:
            ensure_room(unpacked_bytes(path), f"reading {path}")
            return open_weights(path)

        self._opened = opened
        self._searchable: tuple[WeightsFile, WeightsFile] | None = None
        self._bench: Bench | None = None
        self.size: Sized | None = None

    def weights(self, path: Path) -> WeightsFile:
        """Return the weights of a file.

        Raises
        ------
        InputError : as `open_weights`
        OutputError : there is too little memory for them
        """
        status = path.stat() if os.path.exists(path) else None
        return self._opened(path, status and status.st_size, status and status.st_mtime_ns)

    def searchable(self, path: Path, settings: Config) -> WeightsFile:
        """Return the weights of a file to look for particles with.

        Raises
        ------
        InputError : they are none for that, see `searchable`
        """
        content = self.weights(path)
        if self._searchable is None or self._searchable[0] is not content:
            try:
                self._searchable = content, searchable(content, settings)
            except ConfigError as error:
                raise InputError(f"{path}: {error}") from error
        return self._searchable[1]

    def reading(
        self,
        content: WeightsFile,
        settings: Config,
        frames: Sequence[ImageFrame],
        options: of_frames.ImageOptions,
        keep_going: bool,
    ) -> tuple[Bench, Read]:
        """Return what frames share, and what reads one; with `keep_going` some may be unreadable."""
        shape = content.image_shape
        dark = None if options.dark is None else image_files.read_reference(options.dark, shape)
        pitch_px = float(content.camera.micro_image_lattice_px().pitch.max())
        # What is 0 is left out: as a file has it, or what does not move in the frames (`still`).
        mask = None
        if options.mask == STILL:
            images = readable(lambda number: read_frame(frames[number], shape), range(len(frames)), keep_going)
            mask = np.where(of_images.still_light(images, pitch_px), np.float32(0.0), np.float32(1.0))
        elif options.mask is not None:
            mask = image_files.read_reference(Path(options.mask), shape)
        # The sums are those of the last bench where these are the same.
        self._bench = bench = of_frames.bench_of(content, settings, dark, mask, earlier=self._bench)
        return bench, of_frames.reader(options.level, frames, shape, dark, keep_going)
