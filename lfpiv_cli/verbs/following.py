"""Finding and following the particles of a time-resolved sequence together, in memory (as in Shake-The-Box)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

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
from lfpiv_cli.particles.search import Particles, blank, rebuilt, result
from lfpiv_cli.reconstruction.images import Image, light
from lfpiv_cli.tracks.candidates import Seen, Trajectories, long_ones
from lfpiv_cli.tracks.sequences import PAST_FRAMES, REACH_FRAMES, Ahead, SoFar, begun, expected_in, followed_further
from lfpiv_cli.verbs.checks import few_notices
from lfpiv_cli.verbs.frames import Bench, Progress, bench_of, check_frame, frame_notices, given_picture, picture_for
from lfpiv_cli.verbs.particles import (
    Frame,
    find_beside,
    find_first,
    frame_of,
    points_of,
    searchable,
    sized,
    task_for,
    what_is_left,
)
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

    particles: list[Points]
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
    bench = bench_of(searchable(weights, chosen), chosen, given_picture(weights, dark), given_picture(weights, mask))
    level = given_picture(weights, background)
    names = [f"image {number}" for number in range(len(images))]
    pictures = [picture_for(weights, image) for image in images]

    def frame(number: int) -> Frame:
        return frame_of(bench, pictures[number], light(pictures[number], bench.dark, level))

    for name, raw in zip(names, pictures, strict=True):
        check_frame(bench, raw, name)
        warn_of(frame_notices(bench, raw, light(raw, bench.dark, level), name))
    bench, size = sized(bench, (frame(number) for number in range(len(images))))
    warn_of(size_notices(chosen, size))
    provenance = record("follow", chosen.resolved() | tracking.told(), {})
    sequence = Recorded(bench, size, tracking, frame, names, provenance)
    store = Memory()
    forward = forwards(sequence, store)
    found: Trajectories | None = forward
    if both_ways:
        before, store, found = store, Memory(), None
        go_both_ways(sequence, forward, before.particles.__getitem__, store)
    warn_of(store.notices)
    particles = [store.particles[number] for number in range(len(images))]
    tracks = tracked(particles, chosen, tracking, provenance, found)
    warn_of(few_notices([len(points.position_mm) for points in particles], names, tracks.summary, tracks.points))
    return Followed(particles, tracks)


class Store(Protocol):
    """Where the particles of frames are put as they are found."""

    def made(self, number: int) -> Points | None:
        """Return the particles of a frame that were found before, None where they were not."""

    def put(self, number: int, points: Points, left: Image, notices: list[Notice]) -> None:
        """Take the particles of a frame, what they leave of its image, and what is said of it."""


@dataclass(eq=False)
class Memory:
    """A store that forgets what is left of images."""

    particles: dict[int, Points] = field(default_factory=dict)
    notices: list[Notice] = field(default_factory=list)

    def made(self, number: int) -> Points | None:
        """Return the particles of a frame that were put here."""
        return self.particles.get(number)

    def put(self, number: int, points: Points, left: Image, notices: list[Notice]) -> None:
        """Keep particles and notices."""
        self.particles[number] = points
        self.notices += notices


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


def forwards(sequence: Recorded, store: Store, progress: Progress | None = None) -> Trajectories:
    """Find the particles of each frame with those of the frames before it; return how they belong together.

    The first two frames help each other. Only the last few frames are held in memory.
    """
    bench, tracking = sequence.bench, sequence.tracking
    recent: dict[int, Seen] = {}
    so_far: SoFar | None = None
    first_two: list[Particles] = []
    for number in range(len(sequence.names)):
        points = store.made(number)
        if points is None:
            frame = sequence.frame(number)
            notices: list[Notice] = []
            if so_far is None or number < 2:
                if not first_two:
                    two = [sequence.frame(k) for k in range(2)]
                    own = [find_first(bench, each, progress) for each in two]
                    first_two = [find_beside(bench, two[k], own[k], [own[1 - k]]) for k in range(2)]
                found = first_two[number]
            else:
                found, notices = _next(sequence, number, frame, so_far.ahead, progress)
            points = _put(sequence, store, number, frame, found, notices)
        recent[number] = seen_in(points)
        recent.pop(number - LOOKED_BACK, None)
        if so_far is None:
            so_far = begun(recent)
        else:
            so_far = followed_further(so_far, recent, tracking.search_mm, tracking.scale)
    if so_far is None:
        raise ValueError("a sequence has frames")
    return so_far.found


def go_both_ways(
    sequence: Recorded,
    found: Trajectories,
    forward: Callable[[int], Points],
    store: Store,
    progress: Progress | None = None,
) -> None:
    """Find the particles of each frame again, where their tracks before and after it let expect them.

    Only the frames about the one that is made are held in memory.

    Parameters
    ----------
    found : how particles belong together on the way forwards
    forward : gives the particles that were found in a frame then; those of a frame that no track comes near stay
    store : takes those that are found now
    """
    confirmed = long_ones(found, sequence.tracking.shortest or SHORTEST)
    recent: dict[int, Seen] = {}
    count = len(sequence.names)
    for number in range(count):
        recent.pop(number - REACH_FRAMES - 1, None)
        if store.made(number) is not None:
            continue
        for near in range(max(number - REACH_FRAMES, 0), min(number + REACH_FRAMES + 1, count)):
            if near not in recent:
                recent[near] = seen_in(forward(near))
        frame, ahead = sequence.frame(number), expected_in(confirmed, recent, number)
        if len(ahead.light):
            particles, notices = _next(sequence, number, frame, ahead, progress)
            _put(sequence, store, number, frame, particles, notices)
        else:
            points = forward(number)
            task = task_for(sequence.bench, frame)
            rows = _rows(sequence.bench, points.position_mm, points.arrays["intensity"])
            residual = rebuilt(task, blank(task), rows).residual.reshape(frame.image.shape)
            store.put(number, points, np.where(frame.unusable, 0.0, residual).astype(np.float32), [])


def _next(
    sequence: Recorded, number: int, frame: Frame, ahead: Ahead, progress: Progress | None
) -> tuple[Particles, list[Notice]]:
    """Return the particles of a frame where they are ahead of those before it, and of the rest; what is said of it."""
    bench, task = sequence.bench, task_for(sequence.bench, frame)
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


def _put(
    sequence: Recorded, store: Store, number: int, frame: Frame, found: Particles, notices: list[Notice]
) -> Points:
    """Return the particles found in a frame, after they were put into the store."""
    points = points_of(sequence.bench, frame, found, sequence.size, sequence.provenance)
    notices = [*notices, *light_notices(points, sequence.names[number])]
    store.put(number, points, np.asarray(what_is_left(frame, found), np.float32), notices)
    return points
