"""Finding the particles behind an image in memory (iterative particle reconstruction)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.errors import ConfigError
from lfpiv_cli.files.bench import NM_TO_MM
from lfpiv_cli.files.config import Config, carried_config
from lfpiv_cli.files.particle_file import Points, symmetric
from lfpiv_cli.files.provenance import record
from lfpiv_cli.files.weights_file import WeightsFile
from lfpiv_cli.grid import Grid
from lfpiv_cli.interface.notices import warn_of
from lfpiv_cli.interface.reconstruction import (
    IMAGE,
    Bench,
    bench_of,
    check_frame,
    frame_notices,
    given_picture,
    picture_for,
)
from lfpiv_cli.notice import Notice, written
from lfpiv_cli.optics.curved_space import CurvedSpace
from lfpiv_cli.optics.line_responses import USUAL_DIFFUSION_PX
from lfpiv_cli.optics.object_space import ObjectSpace
from lfpiv_cli.particles.counting import tracers_per_lens as counted
from lfpiv_cli.particles.diameter import LIMIT_SIGMAS, UNKNOWN_LENSES, Diameter, diameter_by
from lfpiv_cli.particles.diffusion import USUAL_SIGMA_PX
from lfpiv_cli.particles.light_errors import MUCH_LEFT
from lfpiv_cli.particles.microlens_focus import FocalLength, focal_length_of
from lfpiv_cli.particles.neighbour_frames import second_pass
from lfpiv_cli.particles.rounds import ROUNDS, first_pass
from lfpiv_cli.particles.search import LAST_UNEXPLAINED, Particles, Task, result, task_of
from lfpiv_cli.particles.second_frames import second_frame
from lfpiv_cli.particles.view import Light, View, ensure_square_cells, raw_view
from lfpiv_cli.reconstruction.equations import Normalisers
from lfpiv_cli.reconstruction.images import Image, Mask, filled, light
from lfpiv_cli.tracks.tracking import SEARCH_LENSES
from lfpiv_cli.weights.build import factorise_bricks
from lfpiv_cli.weights.columns import OnDemandOperator
from lfpiv_cli.weights.model import behind_transmission

# More than this share of an image's light, its noise taken off, is too much to leave unexplained.
LARGEST_UNEXPLAINED = 0.2
# At so many found for each microlens, fewer than there are, stated errors begin to cover less than four fifths.
LARGEST_CROWD = 1.3
# Microlenses whose focal length is off by a larger share are told: depths are off by some three stated errors for each
# per cent. Good ones seem up to 0.002 off, and more the more light is left.
LARGEST_FOCUS_ERROR = 0.005
# Frames that are looked at for the tracers' diameter, if the first do not hold enough.
LOOKED_AT = 5
# Beyond so many standard errors what is seen is not by chance.
CERTAIN_SIGMAS = 5.0
# Beyond so many standard errors a given diameter contradicts the images.
CONTRADICTING_SIGMAS = 4.0
# Depths beyond the volume in which particles are fitted, too, in depths over which light spreads by one lens.
BEYOND_DEPTHS = 0.5
# Units of progress that `find`, `find_first` and `find_second` report.
STEPS = sum(settings.iterations + 1 for settings in ROUNDS)


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
    bench = bench_of(searchable(weights, chosen), chosen, given_picture(weights, dark), given_picture(weights, mask))
    level = given_picture(weights, background)
    raws = [picture_for(weights, each) for each in (image, *neighbours)]
    check_frame(bench, raws[0], IMAGE)
    notices = frame_notices(bench, raws[0], light(raws[0], bench.dark, level), IMAGE)
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
    """

    image: Image
    unusable: Mask
    sums: Normalisers


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
    passing = bricks if operator.transmission is None else behind_transmission(bricks, operator.transmission)
    return replace(content, weights=replace(weights, solver_operator=passing))


def frame_of(bench: Bench, raw: Image, lit: Image) -> Frame:
    """Return a frame as particles are sought in it."""
    unusable = bench.unusable(raw)
    excluded = bench.excluded_with(unusable)
    return Frame(filled(lit, unusable), unusable, bench.sums_without(bench.content.weights.padded, excluded))


@dataclass(frozen=True)
class Diffusion:
    """The sensor's charge diffusion.

    Attributes
    ----------
    px : that particles are fitted with by waves
    measured_px, sigma_px : by the tracers' images, and its standard error; None where no image shows it
    given : whether it is given
    told : whether the images tell it, not what is usual
    """

    px: float
    measured_px: float | None = None
    sigma_px: float | None = None
    given: bool = False
    told: bool = False

    def attributes(self) -> dict[str, float]:
        """Return what files say of it: its standard error where it is not given."""
        usual = USUAL_SIGMA_PX if self.sigma_px is None else self.sigma_px
        return {"diffusion_px": self.px} | ({} if self.given else {"diffusion_sigma_px": usual})

    def summary(self) -> dict[str, float | None]:
        """Return what is told of it; None where it is not known."""
        return {
            "diffusion_px": self.px,
            "diffusion_measured_px": self.measured_px,
            "diffusion_sigma_px": self.sigma_px,
        }


@dataclass(frozen=True)
class TracerSize:
    """The tracers' diameter.

    Attributes
    ----------
    diameter_mm : that they are fitted with
    measured_mm, sigma_mm : by their images, and its standard error; None where no image shows it
    resolved : whether more than an upper limit is known by the images
    diffusion : by waves, how far charge diffuses in the sensor
    """

    diameter_mm: float
    measured_mm: float | None = None
    sigma_mm: float | None = None
    resolved: bool = False
    diffusion: Diffusion | None = None

    @property
    def at_most_mm(self) -> float | None:
        """What it is not above, by the images."""
        if self.measured_mm is None or self.sigma_mm is None:
            return None
        return self.measured_mm + LIMIT_SIGMAS * self.sigma_mm

    def attributes(self) -> dict[str, float]:
        """Return what files say of it: its standard error where it is by the images."""
        told = {"particle_diameter_mm": self.diameter_mm}
        if self.sigma_mm is not None and self.diameter_mm == self.measured_mm:
            told["particle_diameter_sigma_mm"] = self.sigma_mm
        return told | (self.diffusion.attributes() if self.diffusion else {})

    def summary(self) -> dict[str, float | None]:
        """Return what is told of it; None where it is not known."""
        return {
            "particle_diameter_mm": self.diameter_mm,
            "particle_diameter_measured_mm": self.measured_mm,
            "particle_diameter_sigma_mm": self.sigma_mm,
        } | (self.diffusion.summary() if self.diffusion else {})


def sized(bench: Bench, frames: Iterable[Frame]) -> tuple[Bench, TracerSize]:
    """Return the bench with the tracers' diameter, from the first of its frames where it is not given.

    By waves with the sensor's charge diffusion.
    """
    chosen, lens_mm = bench.settings.reconstruction, _lens_mm(bench)
    given, given_px = chosen.particle_diameter_mm, chosen.diffusion_px
    found = diameter_by(
        (task_for(bench, frame) for frame in islice(frames, LOOKED_AT)), given and given / lens_mm, given_px
    )
    if found is None:
        size = TracerSize(given or UNKNOWN_LENSES * lens_mm)
    else:
        measured = lens_mm * found.lenses
        size = TracerSize(given or measured, measured, lens_mm * found.sigma_lenses, found.resolved)
    if chosen.wavelength_nm is None:
        settings, covariance = bench.settings.overridden("reconstruction", particle_diameter_mm=size.diameter_mm), None
    else:
        diffusion = _diffusion(found, given_px)
        size = replace(size, diffusion=diffusion)
        settings = bench.settings.overridden(
            "reconstruction", particle_diameter_mm=size.diameter_mm, diffusion_px=diffusion.px
        )
        covariance = None if found is None or found.held is None else found.held.covariance
    return replace(bench, settings=settings, light_covariance=covariance), size


def _diffusion(found: Diameter | None, given_px: float | None) -> Diffusion:
    """Return the sensor's charge diffusion: as given, by the images, or as is usual."""
    given = given_px is not None
    shown = None if found is None else found.shown if given else found.held
    px = given_px if given_px is not None else USUAL_DIFFUSION_PX if shown is None else shown.diffusion_px
    if shown is None:
        return Diffusion(px, given=given)
    return Diffusion(px, shown.diffusion_px, shown.sigma_px, given, shown.told)


def size_notices(settings: Config, size: TracerSize) -> list[Notice]:
    """Return where what is given of diameter and diffusion contradicts the images, or where they do not tell it."""
    return _diameter_notices(settings, size) + ([] if size.diffusion is None else _diffusion_notices(size.diffusion))


def _diffusion_notices(found: Diffusion) -> list[Notice]:
    """Return where a given diffusion contradicts the images, or where they do not tell it."""
    key = "reconstruction.diffusion_px"
    if found.measured_px is None or found.sigma_px is None or not found.told:
        text = f"the images do not tell how far charge diffuses: {written(found.px)} px is taken"
        remedy = "give it, or tracers that stand alone at several depths"
        return [] if found.given else [Notice("diffusion-unknown", key, text, remedy, found.sigma_px, None)]
    if found.given and abs(found.px - found.measured_px) > CONTRADICTING_SIGMAS * found.sigma_px:
        text = (
            f"{found.px:g} px, but by the images it is {written(found.measured_px)} ± {written(found.sigma_px, 2)} px"
        )
        remedy = "leave it out, and it is taken from the images; or check wavelength_nm and calibration"
        return [Notice("diffusion", key, text, remedy, found.px, f"{written(found.measured_px)} px")]
    return []


def _diameter_notices(settings: Config, size: TracerSize) -> list[Notice]:
    given, key = settings.reconstruction.particle_diameter_mm, "reconstruction.particle_diameter_mm"
    if size.measured_mm is None or size.sigma_mm is None:
        if given is not None:
            return []
        text = (
            "too few tracers stand alone for the images to show their size; "
            f"{written(size.diameter_mm)} mm is taken, half a microlens in the scene"
        )
        return [Notice("particle-diameter-unknown", key, text, "give it", None, "tracers that stand alone")]
    if given is not None and abs(given - size.measured_mm) > CONTRADICTING_SIGMAS * size.sigma_mm:
        text = f"{given:g} mm, but by the images it is {written(size.measured_mm)} ± {written(size.sigma_mm, 2)} mm"
        remedy = "leave it out, and it is taken from the images; or check calibration and focus"
        return [Notice("particle-diameter", key, text, remedy, given, f"{written(size.measured_mm)} mm")]
    if given is None and not size.resolved and (at_most_mm := size.at_most_mm) is not None:
        text = f"tracers are smaller than the images show: at most {written(at_most_mm, 2)} mm"
        return [Notice("particle-diameter-limit", key, text, "give it, if it is known", at_most_mm, None)]
    return []


def find(bench: Bench, frame: Frame, progress: Callable[[int], None] | None = None) -> Particles:
    """Return the particles behind an image."""
    task = task_for(bench, frame)
    return result(task, first_pass(task, progress=progress))


def find_first(bench: Bench, frame: Frame, progress: Callable[[int], None] | None = None) -> NDArray[np.float64]:
    """Return the particles (n, 4) of a frame's first pass, for its own second pass and those of its neighbours."""
    return first_pass(task_for(bench, frame), progress=progress).particles


def find_second(
    bench: Bench,
    frame: Frame,
    before: Frame,
    particles: NDArray[np.float64],
    progress: Callable[[int], None] | None = None,
) -> NDArray[np.float64]:
    """Return what `find_first` returns, for the second frame of a pair: with those (n, 4) of the first, `before`."""
    task = task_for(bench, frame)
    return second_frame(task, task_for(bench, before), particles, SEARCH_LENSES * task.view.scale.lens_mm, progress)


def find_beside(
    bench: Bench, frame: Frame, own: NDArray[np.float64], neighbours: Sequence[NDArray[np.float64]]
) -> Particles:
    """Return the particles behind an image with the help of the first passes of it and of the frames beside it."""
    task = task_for(bench, frame)
    return result(task, second_pass(task, own, neighbours, SEARCH_LENSES * task.view.scale.lens_mm))


def _lens_mm(bench: Bench) -> float:
    return bench.content.camera.scale(bench.settings.media_model()).lens_mm


def task_for(bench: Bench, frame: Frame) -> Task:
    """Return the task that a frame sets."""
    content, photons = bench.content, bench.settings.reconstruction.photons_per_count
    view = _view(bench, _light(content, bench.settings))
    return task_of(
        frame.image, view, content.weights, content.camera, frame.sums, frame.unusable, photons, bench.light_covariance
    )


def _view(bench: Bench, waves: Light | None) -> View:
    """Return how particles are seen, by waves or by rays."""
    content, settings = bench.content, bench.settings
    radius = 0.5 * (settings.reconstruction.particle_diameter_mm or UNKNOWN_LENSES * _lens_mm(bench))
    calibration, space = content.weights.calibration, _space(content, settings)
    # Particles are fitted behind arrays that stand upright, as in the weights' frame.
    return raw_view(content.camera, settings.media_model(), radius, calibration, space, waves, content.passed)


def _light(content: WeightsFile, settings: Config) -> Light | None:
    """Return the light as waves where its wavelength is given, for all depths of the weights; None: by rays."""
    margin = BEYOND_DEPTHS * content.camera.scale(settings.media_model()).depth_mm
    low, high = content.weights.padded.grid.bounds_mm(2)
    return light_of(settings, (low - margin, high + margin))


def light_of(settings: Config, depths_mm: tuple[float, float]) -> Light | None:
    """Return the light as waves, as it is fitted between two depths; None: by rays."""
    chosen = settings.reconstruction
    if chosen.wavelength_nm is None:
        return None
    diffusion_px = USUAL_DIFFUSION_PX if chosen.diffusion_px is None else chosen.diffusion_px
    return Light(chosen.wavelength_nm * NM_TO_MM, diffusion_px, depths_mm)


def points_of(bench: Bench, frame: Frame, found: Particles, size: TracerSize, provenance: Mapping[str, Any]) -> Points:
    """Return the particles found behind an image in the coordinates of files, by Snell's law where it is known."""
    content = bench.content
    space = _space(content, bench.settings)
    outside = _outside(found.position_mm, content.weights.grid)
    left = what_is_left(frame, found)
    norm = float(np.linalg.norm(np.where(frame.unusable, 0.0, frame.image)))
    share_left = float(np.linalg.norm(left)) / norm if norm > 0.0 else 0.0
    # Of four tracers for each microlens only 1.3 are found, and few of them are right.
    number = tracers_per_lens(bench, frame) if share_left > MUCH_LEFT else None
    focus = _focal_length(bench, frame, found)
    return Points(
        content.reference.points_from_focal_point(found.position_mm),
        {
            "intensity": found.light_counts,
            "intensity_sigma": found.light_sigma_counts,
            "covariance_mm2": symmetric(found.covariance_mm2),
            "chi2": found.chi2,
            "seen": found.seen,
            "flag": outside,
        },
        content.reference,
        attributes=content.reference.attributes()
        | {
            "refraction": "paraxial" if isinstance(space, ObjectSpace) and space.straight else "exact",
            "light": "rays" if bench.settings.reconstruction.wavelength_nm is None else "waves",
            "residual": share_left,
            "residual_rms_counts": float(np.sqrt(np.mean(left[~frame.unusable] ** 2))),
            "excluded_pixels": int(np.count_nonzero(frame.unusable)),
            "read_noise_counts": found.noise.read_counts,
            "particles_per_lens": float(np.count_nonzero(outside == 0)) / _lenses_before(bench),
        }
        | ({} if number is None else {"tracers_per_lens": number})
        | ({} if focus is None else {"microlens_focus": focus.off, "microlens_focus_sigma": focus.sigma})
        | size.attributes(),
        provenance=dict(provenance),
    )


def light_notices(points: Points, name: str) -> list[Notice]:
    """Return where none were found, where they crowd, or leave more of the image's light than noise makes."""
    measured = points.attributes
    noise_share = measured["read_noise_counts"] / max(measured["residual_rms_counts"], measured["read_noise_counts"])
    unexplained = measured["residual"] * float(np.sqrt(1.0 - min(noise_share, 1.0) ** 2))
    count, notices = len(points.position_mm), []
    if unexplained > LARGEST_UNEXPLAINED:
        notices.append(
            Notice(
                "light-unexplained",
                name,
                f"{count or 'no'} particles found, and {unexplained:.0%} of the light is not explained by them, at "
                f"most {LARGEST_UNEXPLAINED:.0%} of a good image's",
                "check the calibration (refine-calibration), particle_diameter_mm, --dark, --background and the volume",
                unexplained,
                f"at most {LARGEST_UNEXPLAINED:g}",
            )
        )
    elif unexplained > MUCH_LEFT:
        notices.append(
            Notice(
                "light-model",
                name,
                f"{unexplained:.0%} of the light is not that of the particles found by {measured['light']}, at most "
                f"{MUCH_LEFT:.0%} where the model is right and few are missing: stated errors may be too small",
                "give reconstruction.wavelength_nm, as lenses diffract"
                if measured["light"] == "rays"
                else "check the calibration, wavelength_nm and diffusion_px",
                unexplained,
                f"at most {MUCH_LEFT:g}",
            )
        )
    found = measured["particles_per_lens"]
    crowd = max(found, measured.get("tracers_per_lens", 0.0))
    if crowd > LARGEST_CROWD:
        counted = (
            f", {written(found)} found of {written(crowd)} by how unevenly they light them" if crowd > found else ""
        )
        notices.append(
            Notice(
                "particles-crowded",
                name,
                f"{written(crowd)} particles for each microlens{counted}, at most {LARGEST_CROWD:g}: beyond, "
                "neighbours are taken for one another, and standard errors do not know of it",
                "fewer tracers, or volumes and their correlation; --background, where other light is in the image",
                crowd,
                f"at most {LARGEST_CROWD:g}",
            )
        )
    off, largest = measured.get("microlens_focus", 0.0), LARGEST_FOCUS_ERROR * max(unexplained / MUCH_LEFT, 1.0)
    if abs(off) > max(largest, CERTAIN_SIGMAS * measured.get("microlens_focus_sigma", 0.0)):
        least = "at least " if measured.get("light") == "waves" else ""
        notices.append(
            Notice(
                "microlens-focus",
                name,
                f"by the tracers' light under single microlenses their focal length is {least}{abs(off):.1%} "
                f"{'longer' if off > 0.0 else 'shorter'} than the rig says, at most {largest:.1%} of a good one, or "
                "microlens_distance_mm is as much off the other way: depths are off, and stated errors too small",
                f"microlenses.focal_length_mm {written(1.0 + off, 4)} times as large, and build the weights again "
                "until it stays",
                off,
                f"within {largest:g}",
            )
        )
    if not count and not notices:
        text = "no particles found: nothing stands out of the noise"
        notices.append(Notice("no-particles", name, text, "check exposure, --dark and --mask", 0.0, "some"))
    return notices


def _focal_length(bench: Bench, frame: Frame, found: Particles) -> FocalLength | None:
    """Return the microlenses' focal length by the particles of an image; None where too few tell it."""
    # By rays also where particles are fitted by waves, of which no second table is made: rays tell half of it.
    view = _view(bench, None)
    particles = np.column_stack([bench.content.camera.to_image_axes(found.position_mm), found.light_counts])
    residual = found.residual.ravel()
    weight = found.noise.weights(frame.image.ravel() - residual, residual, LAST_UNEXPLAINED)
    weight[frame.unusable.ravel()] = 0.0
    return focal_length_of(view, particles, residual, weight)


def what_is_left(frame: Frame, found: Particles) -> NDArray[np.float64]:
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
    settings = bench.settings.overridden("reconstruction", particle_diameter_mm=UNKNOWN_LENSES * _lens_mm(bench))
    return counted(task_for(replace(bench, settings=settings), frame), bench.lens_images.lattice_px)


def _lenses_before(bench: Bench) -> float:
    """Return how many microlenses the volume fills as the scene shows them."""
    camera, grid = bench.content.camera, bench.content.weights.grid
    (low_x, high_x), (low_y, high_y) = (grid.bounds_mm(axis) for axis in (0, 1))
    return (high_x - low_x) * (high_y - low_y) * camera.magnification**2 / camera.lattice.cell_area


def _outside(position_mm: NDArray[np.float64], grid: Grid) -> NDArray[np.uint8]:
    """Return 1 for particles outside the volume, kept because they light it, 0 for those inside."""
    bounds = np.array([grid.bounds_mm(axis) for axis in range(3)])
    inside = np.all((position_mm >= bounds[:, 0]) & (position_mm <= bounds[:, 1]), axis=1)
    return (~inside).astype(np.uint8)
