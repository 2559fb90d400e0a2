"""Finding and following the particles of a time-resolved sequence together, in memory (as in Shake-The-Box)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.arrays import Floats
from lfpiv_cli.errors import UsageError
from lfpiv_cli.files.config import carried_config
from lfpiv_cli.files.particle_file import Points
from lfpiv_cli.files.provenance import record
from lfpiv_cli.files.weights_file import WeightsFile
from lfpiv_cli.notice import Notice, warn_of
from lfpiv_cli.particles.neighbour_frames import Predicted, find_predicted
from lfpiv_cli.particles.rounds import first_pass
from lfpiv_cli.particles.search import blank, rebuilt
from lfpiv_cli.particles.stated import Particles, result
from lfpiv_cli.reconstruction.images import Image, light
from lfpiv_cli.tracks import sequences
from lfpiv_cli.tracks.candidates import Seen, Trajectories, long_ones
from lfpiv_cli.tracks.sequences import PAST_FRAMES, REACH_FRAMES, PartialTracks, Prediction
from lfpiv_cli.verbs import particles as of_particles
from lfpiv_cli.verbs.checks import few_notices
from lfpiv_cli.verbs.frames import Bench, Progress, bench_of, check_frame, frame_notices, given_picture, picture_for
from lfpiv_cli.verbs.particles import Frame
from lfpiv_cli.verbs.tracers import TracerSize, light_notices, size_notices
from lfpiv_cli.verbs.tracks import Tracked, Tracking, seen_in, tracked, tracking_of

# A track is confirmed by four frames: a ghost finds light by chance in two, hardly ever in four.
SHORTEST = 4
# A sequence begins with two frames that help each other; the third is the first that can be predicted.
FEWEST_FRAMES = 3
# Frames back that forecasts look at, and one.
LOOKED_BACK = PAST_FRAMES + 2


@dataclass(frozen=True, eq=False)
class Followed:
    """What was found in a sequence.

    Attributes
    ----------
    particles : of each frame
    tracks : through them
    """

    particles: list[Points] = field(repr=False)
    tracks: Tracked


def follow(
    weights: WeightsFile,
    images: Sequence[NDArray[Any]],
    *,
    dark: NDArray[Any] | None = None,
    background: NDArray[Any] | None = None,
    mask: NDArray[Any] | None = None,
    dt_s: float | None = None,
    search_voxel: float | None = None,
    shortest: int = SHORTEST,
    both_ways: bool = False,
    **settings: Any,
) -> Followed:
    """Find and follow the tracer particles of a time-resolved sequence: each frame is predicted by those before it.

    Parameters
    ----------
    weights : WeightsFile
        From `build_weights` or `open_weights`.
    images : sequence of (rows, columns) counts
        Raw images in the order of time, three at least.
    dark, background, mask
        As of `reconstruct`.
    dt_s : float, optional
        Time from one frame to the next, s, in place of the rig's `correlation.dt_s`.
    search_voxel : float, optional
        Displacements from the first frame to the second are sought up to so many voxels along each axis.
    shortest : int
        Fewest frames of a track.
    both_ways : bool
        Go through the sequence a second time: each frame with the tracks before and after it.
    **settings
        Keys of the rig's section `reconstruction`, in their place, as of `find_particles`.

    Returns
    -------
    Followed
        `particles`, for each frame what `find_particles` gives, and `tracks`, what `track` gives for a sequence.

    Raises
    ------
    UsageError
        Fewer than three images, or than the tracks must have.
    ConfigError, InputError
        As `find_particles` and `track`.
    """
    ensure_sequence(len(images), shortest)
    carried = carried_config(weights.provenance, "the weights").overridden("correlation", dt_s=dt_s)
    chosen = carried.overridden("reconstruction", **(settings | {"solver": "particles"}))
    tracking = tracking_of(chosen, search_voxel, shortest, len(images), "the weights")
    bench = bench_of(
        of_particles.searchable(weights, chosen), chosen, given_picture(weights, dark), given_picture(weights, mask)
    )
    level = given_picture(weights, background)
    names = [f"image {number}" for number in range(len(images))]
    pictures = [picture_for(weights, image) for image in images]

    def frame(number: int) -> Frame:
        return of_particles.frame_of(bench, pictures[number], light(pictures[number], bench.dark, level))

    for name, raw in zip(names, pictures, strict=True):
        check_frame(bench, raw, name)
        warn_of(frame_notices(bench, raw, light(raw, bench.dark, level), name))
    bench, size = of_particles.sized(bench, (frame(number) for number in range(len(images))))
    warn_of(size_notices(chosen, size))
    provenance = record("follow", chosen.resolved() | tracking.reported(), {})
    sequence = Recorded(bench, size, tracking, frame, names, provenance)
    particles: list[Points] = []
    way: Forwards | BothWays = (forwards := Forwards(sequence, particles.__getitem__))
    notices: list[Notice] = []
    for number in range(len(images)):
        points, _, said = way.find(number)
        particles.append(points)
        notices += said
    found: Trajectories | None = forwards.found()
    if both_ways:
        way = BothWays(sequence, forwards.found(), particles.__getitem__)
        again = [way.find(number) for number in range(len(images))]
        particles, found = [points for points, _, _ in again], None
        notices = [notice for _, _, said in again for notice in said]
    warn_of(notices)
    tracks = tracked(particles, chosen, tracking, provenance, found)
    warn_of(few_notices([len(points.position_mm) for points in particles], names, tracks.summary, tracks.points))
    return Followed(particles, tracks)


def ensure_sequence(frames: int, shortest: int) -> None:
    """Refuse with UsageError what is no sequence, or one that is shorter than its tracks must be."""
    if frames < FEWEST_FRAMES:
        raise UsageError(
            f"follow needs {FEWEST_FRAMES} frames at least, got {frames}; for a pair: reconstruct --solver particles "
            "--pairing ab, then track"
        )
    if frames < shortest:
        raise UsageError(f"--shortest: no track has {shortest} places in {frames} frames; give at most {frames}")


@dataclass(frozen=True, eq=False)
class Recorded:
    """A sequence that is to be followed.

    Attributes
    ----------
    bench : what its frames share
    size : of the tracers
    tracking : how they are followed
    frame : gives each frame by its number
    names : of the frames
    provenance : record of what is made
    """

    bench: Bench
    size: TracerSize
    tracking: Tracking
    frame: Callable[[int], Frame]
    names: Sequence[str]
    provenance: dict[str, Any]


# The particles of a frame, what they leave of its image (rows, columns), and what is said of it.
Found = tuple[Points, Image, list[Notice]]


class Forwards:
    """The first way through a sequence: each frame is found with those before it, the first two help each other.

    Only the last few frames are held in memory.
    """

    def __init__(self, sequence: Recorded, read: Callable[[int], Points]) -> None:
        """Take the sequence, and what gives the particles of a frame that were found before."""
        self._sequence, self._read = sequence, read
        self._recent: dict[int, Seen] = {}
        self._so_far: PartialTracks | None = None
        self._first_two: list[Particles] = []

    def find(self, number: int, progress: Progress | None = None) -> Found:
        """Find the particles of a frame; those of all frames before it are known."""
        sequence, bench, frame = self._sequence, self._sequence.bench, self._sequence.frame(number)
        if number < 2:
            if not self._first_two:
                two = [sequence.frame(k) for k in range(2)]
                own = [of_particles.find_first(bench, each, progress) for each in two]
                self._first_two = [of_particles.find_beside(bench, two[k], own[k], [own[1 - k]]) for k in range(2)]
            return _made(sequence, number, frame, self._first_two[number], [])
        return _made(sequence, number, frame, *_next(sequence, number, frame, self._up_to(number).ahead, progress))

    def found(self) -> Trajectories:
        """Return how the particles of all frames belong together."""
        return self._up_to(len(self._sequence.names)).found

    def _up_to(self, number: int) -> PartialTracks:
        """Link the particles of the frames before one."""
        tracking, recent, partial = self._sequence.tracking, self._recent, self._so_far
        for k in range(0 if partial is None else partial.last + 1, number):
            recent[k] = seen_in(self._read(k))
            recent.pop(k - LOOKED_BACK, None)
            if partial is None:
                partial = sequences.begun(recent)
            else:
                partial = sequences.extended(partial, recent, tracking.search_mm, tracking.scale)
        if partial is None:
            raise ValueError("a sequence has frames")
        self._so_far = partial
        return partial


class BothWays:
    """The second way: each frame is found again where its tracks before and after it let expect its particles.

    Tracks of three places count, too, though four confirm one: what they lead to finds its light there, or not.

    Only the frames about the one that is made are held in memory.

    Parameters
    ----------
    found : how particles belong together on the way forwards
    forward : gives the particles that were found in a frame then; those of a frame that no track comes near stay
    """

    def __init__(self, sequence: Recorded, found: Trajectories, forward: Callable[[int], Points]) -> None:
        """Take how particles belong together on the way forwards."""
        self._sequence, self._forward = sequence, forward
        self._followed = long_ones(found, sequences.SHORTEST)
        self._recent: dict[int, Seen] = {}

    def find(self, number: int, progress: Progress | None = None) -> Found:
        """Find the particles of a frame again."""
        sequence, bench, before = self._sequence, self._sequence.bench, self._recent
        near = range(max(number - REACH_FRAMES, 0), min(number + REACH_FRAMES + 1, len(sequence.names)))
        self._recent = {k: before[k] if k in before else seen_in(self._forward(k)) for k in near}
        frame, ahead = sequence.frame(number), sequences.expected_in(self._followed, self._recent, number)
        if len(ahead.light):
            return _made(sequence, number, frame, *_next(sequence, number, frame, ahead, progress))
        points, task = self._forward(number), of_particles.task_for(bench, frame)
        rows = _rows(bench, points.position_mm, points.arrays["intensity"])
        residual = rebuilt(task, blank(task), rows).residual.reshape(frame.image.shape)
        return points, np.where(frame.unusable, 0.0, residual).astype(np.float32), []


def _next(
    sequence: Recorded, number: int, frame: Frame, ahead: Prediction, progress: Progress | None
) -> tuple[Particles, list[Notice]]:
    """Return the particles of a frame where they are ahead of those before it, and of the rest; what is said of it."""
    bench, task = sequence.bench, of_particles.task_for(sequence.bench, frame)
    known = np.isfinite(ahead.sigma_mm).all(axis=1)
    sigma = np.abs(bench.content.camera.to_image_axes(ahead.sigma_mm[known]))
    rows = _rows(bench, ahead.position_mm[known], ahead.light[known])
    state = find_predicted(task, Predicted(rows, sigma, ahead.light_sigma), progress)
    if state is not None:
        return result(task, state), []
    text = "hardly any particle is where those of the frames before let expect it: it was searched from nothing"
    name, remedy = sequence.names[number], "check the order of the frames, and whether one between them is missing"
    return result(task, first_pass(task)), [Notice("frame-apart", name, text, remedy, None, "a sequence")]


def _rows(bench: Bench, position_mm: Floats, light_counts: Floats) -> Floats:
    """Return particles in the coordinates of files as rows (n, 4) in image axes."""
    from_focal_point = bench.content.reference.points_to_focal_point(position_mm)
    return np.column_stack([bench.content.camera.to_image_axes(from_focal_point), light_counts])


def _made(sequence: Recorded, number: int, frame: Frame, found: Particles, notices: list[Notice]) -> Found:
    """Return what was found in a frame as it is kept."""
    points = of_particles.points_of(sequence.bench, frame, found, sequence.size, sequence.provenance)
    notices = [*notices, *light_notices(points, sequence.names[number])]
    return points, np.asarray(of_particles.what_is_left(frame, found), np.float32), notices
