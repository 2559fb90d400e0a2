"""Tracking particles in memory (particle tracking velocimetry)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.errors import InputError, UsageError
from lfpiv_cli.files.config import Config, carried_config
from lfpiv_cli.files.particle_file import POSITION, TRACKS_FORMAT, TRAJECTORIES_FORMAT, PointRows, Points
from lfpiv_cli.files.provenance import OF_FRAMES, ensure_agreement, even_step_s, record, seconds_between
from lfpiv_cli.flow.combining import Paths, WindowGrid, vectors_from_paths
from lfpiv_cli.flow.field import MM_TO_M, VectorField
from lfpiv_cli.flow.windows import Walls
from lfpiv_cli.grid import Reference, Scale
from lfpiv_cli.notice import warn_of
from lfpiv_cli.results import ArrayResult
from lfpiv_cli.tracks.candidates import Light, Seen, Trajectories, long_ones
from lfpiv_cli.tracks.in_time import Scatter
from lfpiv_cli.tracks.sequences import SHORTEST, follow, scatter_in, states_at
from lfpiv_cli.tracks.tracking import track as match
from lfpiv_cli.tracks.tracking import wrong_link_variance
from lfpiv_cli.verbs.checks import few_notices


@dataclass(frozen=True, eq=False)
class SequenceTracks:
    """Tracks through frames, whose states are computed when they are asked for.

    Attributes
    ----------
    found : which particles belong together
    frames : the particles
    dt_s : time from one frame to the next
    scatter, half_frames : what all tracks have in common, and how many frames on either side of a time tell a state
    """

    found: Trajectories
    frames: Sequence[Seen]
    dt_s: float
    scatter: Scatter
    half_frames: int

    @classmethod
    def of(cls, found: Trajectories, frames: Sequence[Seen], dt_s: float) -> SequenceTracks:
        """Return the tracks that were found in frames."""
        return cls(found, frames, dt_s, *scatter_in(found, frames))

    def at(self, number: int) -> dict[str, NDArray[Any]]:
        """Return the places of tracks in a frame, in the order of tracks, as the arrays of a file by name."""
        tracks, state = states_at(self.found, self.frames, float(number), self.scatter, self.half_frames)
        particle = self.found.particles(number, tracks)
        return {
            POSITION: state.position_mm,
            "velocity": state.velocity * MM_TO_M / self.dt_s,
            "velocity_sigma": state.velocity_sigma * MM_TO_M / self.dt_s,
            "track": tracks,
            "frame": np.full(len(tracks), number),
            "particle": particle,
            "link_probability": self.found.probability[number][particle],
        }

    def by_track(self) -> dict[str, NDArray[Any]]:
        """Return the places in all frames, by track, then by frame; no array is held twice."""
        lengths = self.found.lengths()
        following, count = np.cumsum(lengths) - lengths, int(lengths.sum())
        arrays: dict[str, NDArray[Any]] = {}
        for number in range(len(self.frames)):
            places = self.at(number)
            rows = following[places["track"]]
            following[places["track"]] += 1
            for name, array in places.items():
                if name not in arrays:
                    arrays[name] = np.empty((count, *array.shape[1:]), array.dtype)
                arrays[name][rows] = array
        return arrays

    def paths(self) -> Iterator[Paths]:
        """Yield the tracks that pass from each frame to the next, half-way between the two."""
        for number in range(len(self.frames) - 1):
            state = states_at(self.found, self.frames, number + 0.5, self.scatter, self.half_frames)[1]
            yield Paths(state.position_mm, state.velocity, state.velocity_sigma)

    def summary(self) -> dict[str, Any]:
        """Return counts and figures, units in their names."""
        scatter = self.scatter
        acceleration = np.sqrt(scatter.bending) * MM_TO_M / self.dt_s**2
        return {
            "frames": len(self.frames),
            "particles": sum(len(labels) for labels in self.found.labels),
            "tracked": int(self.found.lengths().sum()),
            "tracks": self.found.count,
            "expected_wrong_links": self.found.expected_wrong_links(),
            "noise_over_stated": scatter.noise.tolist() if scatter.noise_known else None,
            "acceleration_m_s2": acceleration.tolist() if scatter.bending_known else None,
        }


def track(
    *particles: Points, dt_s: float | None = None, search_voxel: float | None = None, shortest: int | None = None
) -> Tracked:
    """Follow particles from one frame to the next, or over a sequence of frames.

    Parameters
    ----------
    *particles : Points
        Of two or more frames in the order of time, from `find_particles` or `open_particles`.
    dt_s : float, optional
        Time from one frame to the next, s, in place of the rig's `correlation.dt_s`.
    search_voxel : float, optional
        Largest displacement, in voxels by their longest side; when not given, it is found from the particles.
    shortest : int, optional
        Fewest frames of a track in a sequence of more than two; 3 when not given.

    Returns
    -------
    Tracked
        `points` with `position_mm` (n, 3) and `arrays`: of two frames, for each link, `velocity` and `velocity_sigma`
        (n, 3) m/s, `displacement_mm` (n, 3), its `displacement_covariance_mm2` (n, 6),
        `particle_a`, `particle_b` (n,) row numbers and `link_probability` (n,);
        of a sequence, for each place of a track, `velocity`, `velocity_sigma`, `track`, `frame`, `particle` and the
        `link_probability` (n,) by which the track has come there, NaN where it begins. `summary` has the counts;
        `vectors()` gives the fields on the grid of the interrogation windows, one for each interval.

    Raises
    ------
    UsageError
        Fewer than two frames, or `shortest` with two.
    InputError
        The frames were made with different configs, the time is not known, or all but one are empty.
    """
    ensure_frames(len(particles), shortest)
    names = [f"frame {number}" for number in range(len(particles))]
    records = [each.provenance for each in particles]
    settings = settings_of(records, names, dt_s)
    counts = [len(each.position_mm) for each in particles]
    ensure_particles(counts, names, records)
    chosen = tracking_of(settings, search_voxel, shortest, len(particles), names[0])
    found = tracked(particles, settings, chosen, record("track", settings.resolved() | chosen.reported(), {}))
    warn_of(few_notices(counts, names, found.summary, found.points))
    return found


@dataclass(frozen=True)
class Tracking:
    """How particles are tracked.

    Attributes
    ----------
    dt_s : time from one frame to the next
    search_mm : largest displacement; None: found from the particles
    shortest : fewest frames of a track, None where there are only two
    scale : of the camera
    """

    dt_s: float
    search_mm: float | None
    shortest: int | None
    scale: Scale

    def reported(self) -> dict[str, Any]:
        """Return what a record says of it beside the config."""
        reported: dict[str, Any] = {"search_mm": self.search_mm}
        return reported if self.shortest is None else reported | {"shortest": self.shortest}

    def attributes(self, reference: Reference) -> dict[str, Any]:
        """Return what a file of tracks says of itself besides its provenance."""
        return reference.attributes() | {"dt_s": self.dt_s}


Rows = TypeVar("Rows", bound=PointRows)


@dataclass(frozen=True, eq=False, repr=False)
class TracksOf(Generic[Rows]):
    """Tracks, in memory or not, and what is told of them.

    Attributes
    ----------
    points : one for each link of two frames, or for each place of a track in a sequence
    format_name : of the file that holds such points
    paths : yields the tracks that pass from each frame to the next
    summary : counts and figures, units in their names
    settings : the resolved config
    """

    points: Rows
    format_name: str
    paths: Callable[[], Iterator[Paths]]
    summary: dict[str, Any]
    settings: Config

    def vectors(self) -> list[VectorField]:
        """Return the field of each interval between frames, on the grid of the interrogation windows."""
        return list(self.fields())

    def fields(self) -> Iterator[VectorField]:
        """Yield what `vectors` returns, one at a time."""
        settings = self.settings
        windows = windows_of(settings, settings.masking_walls())
        for paths in self.paths():
            found = vectors_from_paths(paths, windows, settings.correlation.dt_s)
            yield replace(found, reference=self.points.reference, provenance=self.points.provenance)


class Tracked(ArrayResult, TracksOf[Points]):
    """Tracks in memory."""


def windows_of(settings: Config, walls: Walls | None) -> WindowGrid:
    """Return the final interrogation windows of a config, masked beyond walls."""
    volume = settings.grid()
    size, overlap = settings.windows_voxel(volume.spacing_mm)[-1], settings.overlap(volume.spacing_mm)
    return WindowGrid(volume, size, overlap, walls)


def ensure_frames(frames: int, shortest: int | None) -> None:
    """Refuse what makes no tracks (UsageError)."""
    if frames < 2:
        raise UsageError("track needs the particles of two frames at least")
    if frames == 2 and shortest is not None:
        raise UsageError("--shortest is for sequences: two frames make tracks of two")


def ensure_particles(counts: Sequence[int], names: Sequence[str], records: Sequence[Mapping[str, Any]]) -> None:
    """Refuse frames of which not even two hold particles (InputError), with what was warned of when they were made."""
    if np.count_nonzero(counts) < 2:
        empty = [number for number, count in enumerate(counts) if not count]
        said = [each for number in empty for each in records[number].get("warnings", ()) if each["code"] != "haze"]
        why = "".join(dict.fromkeys("; {text}; {remedy} [{code}]".format_map(each) for each in said))
        files = ", ".join(names[number] for number in empty)
        raise InputError(f"{files}: no particles; tracks need some in two frames at least{why}")


def settings_of(
    records: Sequence[Mapping[str, Any]],
    names: Sequence[str],
    dt_s: float | None = None,
    agreeing: Sequence[str] = OF_FRAMES,
) -> Config:
    """Return the first one's config, by the records that frames, or results of one flow, carry.

    The time between frames is the one given here, else the config's, else what the recording of the frames tells.

    Parameters
    ----------
    agreeing : what of their configs has to agree, see `ensure_agreement`

    Raises
    ------
    InputError
        Their configs differ there, or frames were not taken at an even rate.
    """
    ensure_agreement(records, names, agreeing)
    settings = carried_config(records[0], names[0]).overridden("correlation", dt_s=dt_s)
    if settings.correlation.dt_s is None:
        steps = [seconds_between(*pair) for pair in pairwise(records)]
        settings = settings.overridden("correlation", dt_s=even_step_s(steps, names))
    return settings


def tracking_of(settings: Config, search_voxel: float | None, shortest: int | None, frames: int, name: str) -> Tracking:
    """Return how so many frames are tracked; `name` is the first one's.

    Raises
    ------
    InputError
        The time between frames is not known.
    """
    if settings.correlation.dt_s is None:
        raise InputError(f"{name}: its config has no correlation.dt_s; give --dt-s")
    fewest = None if frames == 2 else SHORTEST if shortest is None else shortest
    scale = settings.camera_model().scale(settings.media_model())
    search_mm = None if search_voxel is None else search_voxel * max(settings.grid().spacing_mm)
    return Tracking(settings.correlation.dt_s, search_mm, fewest, scale)


def tracked(
    frames: Sequence[Points],
    settings: Config,
    chosen: Tracking,
    provenance: dict[str, Any],
    found: Trajectories | None = None,
) -> Tracked:
    """Follow particles from frame to frame; where a sequence has been followed already, `found` says how."""
    reference, reported = frames[0].reference, chosen.attributes(frames[0].reference)
    if chosen.shortest is not None:
        sequence = tracks_through([seen_in(frame) for frame in frames], chosen, found)
        arrays, summary, paths = sequence.by_track(), sequence.summary(), sequence.paths
        points = Points(arrays.pop(POSITION), arrays, reference, reported, provenance)
        return Tracked(points, TRAJECTORIES_FORMAT, paths, summary, settings)
    first, second = frames
    links = match(seen_in(first), seen_in(second), chosen.scale, chosen.search_mm)
    # (n, 6) of displacements, mm^2: xx, yy, zz, xy, yz, xz.
    covariance = first.arrays["covariance_mm2"][links.first] + second.arrays["covariance_mm2"][links.second]
    covariance[:, :3] += wrong_link_variance(links.probability, chosen.scale)
    start, end = first.position_mm[links.first], second.position_mm[links.second]
    path = Paths(0.5 * (start + end), end - start, np.sqrt(covariance[:, :3]))
    arrays = {
        "velocity": path.displacement_mm * MM_TO_M / chosen.dt_s,
        "velocity_sigma": path.sigma_mm * MM_TO_M / chosen.dt_s,
        "displacement_mm": path.displacement_mm,
        "displacement_covariance_mm2": covariance,
        "particle_a": links.first,
        "particle_b": links.second,
        "link_probability": links.probability,
    }
    summary = {
        "particles_a": len(first.position_mm),
        "particles_b": len(second.position_mm),
        "tracks": len(links.first),
        "expected_wrong_links": float(np.sum(1.0 - links.probability)),
    }
    if len(links.first):
        # Of those that the links' motion takes to where the other frame has particles.
        moved = np.median(path.displacement_mm, axis=0)
        places = ((first.position_mm + moved, second.position_mm), (second.position_mm - moved, first.position_mm))
        staying = [np.all((at >= to.min(axis=0)) & (at <= to.max(axis=0)), axis=1).sum() for at, to in places]
        summary["particles_staying"] = int(min(staying))
        before, after = first.arrays["intensity"][links.first], second.arrays["intensity"][links.second]
        summary["light_b_over_a"] = float(np.median(after / before))
    points = Points(path.middle_mm, arrays, reference, reported, provenance)
    return Tracked(points, TRACKS_FORMAT, lambda: iter([path]), summary, settings)


def tracks_through(frames: Sequence[Seen], chosen: Tracking, found: Trajectories | None) -> SequenceTracks:
    """Return the tracks of particles over many frames; `found`, where they have been followed already.

    Raises
    ------
    ValueError : these are two frames
    """
    if chosen.shortest is None:
        raise ValueError("two frames are no sequence")
    if found is None:
        found = follow(frames, chosen.search_mm, chosen.shortest, chosen.scale)
    else:
        found = long_ones(found, chosen.shortest)
    return SequenceTracks.of(found, frames, chosen.dt_s)


def seen_in(frame: Points) -> Seen:
    """Return the particles of a file as tracking takes them."""
    light = Light(frame.arrays["intensity"], frame.arrays.get("intensity_sigma"))
    return Seen(frame.position_mm, frame.arrays["covariance_mm2"], light)
