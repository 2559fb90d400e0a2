"""Tracking particles in memory (particle tracking velocimetry)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.errors import InputError, UsageError
from lfpiv_cli.files.config import Config, carried_config
from lfpiv_cli.files.particle_file import POSITION, TRACKS_FORMAT, TRAJECTORIES_FORMAT, PointRows, Points
from lfpiv_cli.files.provenance import OF_FRAMES, ensure_agreement, even_step_s, record
from lfpiv_cli.flow.field import MM_TO_M, VectorField
from lfpiv_cli.flow.from_tracks import Paths, WindowGrid, vectors_from_paths
from lfpiv_cli.interface.notices import warn_of
from lfpiv_cli.interface.sequence_tracks import SequenceTracks
from lfpiv_cli.notice import Notice
from lfpiv_cli.reference import Reference
from lfpiv_cli.scale import Scale
from lfpiv_cli.tracks.candidates import Seen
from lfpiv_cli.tracks.light import Light
from lfpiv_cli.tracks.sequences import SHORTEST, follow
from lfpiv_cli.tracks.tracking import FEWEST_OF_FIT, SEARCH_LENSES, Tracks, wrong_link_variance
from lfpiv_cli.tracks.tracking import track as match
from lfpiv_cli.tracks.trajectories import Trajectories, long_ones

# A frame with less than this share of the fullest one's particles leaves most of those without a partner.
ONE_SIDED = 0.5
# With fewer particles than this no local linear fit tells which links are wrong.
FEW = FEWEST_OF_FIT + 2
# Of good pairs four in five particles or more are linked; of unrelated images chance links three in ten.
LEAST_LINKED = 0.5
# The share of probably wrong links above which vectors of single tracks are in doubt.
MOST_WRONG = 0.05
# Particles' places scatter by one to two stated errors about smooth paths; what is more is the flow's.
LARGEST_NOISE = 3.0
# Displacements of still particles differ from 0 by a standard error along one axis or another, by chance.
STILL_SIGMAS = 0.05


def track(
    *particles: Points,
    dt_s: float | None = None,
    search_voxel: float | None = None,
    shortest: int | None = None,
) -> Tracked:
    """Follow particles from one frame to the next, or over a sequence of frames.

    Parameters
    ----------
    *particles : Points
        Of two or more frames in the order of time, from `find_particles` or `open_particles`.
    dt_s : float, optional
        Time from one frame to the next, s, in place of the rig's `correlation.dt_s`.
    search_voxel : float, optional
        Displacements are sought up to so many voxels along each axis; six microlenses in the scene when not given.
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
    settings = settings_of([each.provenance for each in particles], names, dt_s)
    counts = [len(each.position_mm) for each in particles]
    ensure_particles(counts, names)
    chosen = tracking_of(settings, search_voxel, shortest, len(particles), names[0])
    found = tracked(particles, settings, chosen, record("track", settings.resolved() | chosen.told(), {}))
    warn_of(few_notices(counts, names, found))
    return found


@dataclass(frozen=True)
class Tracking:
    """How particles are tracked.

    Attributes
    ----------
    dt_s : time from one frame to the next
    search_mm : displacements are sought up to this along each axis
    shortest : fewest frames of a track, None where there are only two
    scale : of the camera
    """

    dt_s: float
    search_mm: float
    shortest: int | None
    scale: Scale

    def told(self) -> dict[str, Any]:
        """Return what a record says of it beside the config."""
        told: dict[str, Any] = {"search_mm": self.search_mm}
        return told if self.shortest is None else told | {"shortest": self.shortest}

    def attributes(self, reference: Reference) -> dict[str, Any]:
        """Return what a file of tracks says of itself besides its provenance."""
        return reference.attributes() | {"dt_s": self.dt_s}


Rows = TypeVar("Rows", bound=PointRows)


@dataclass(frozen=True, eq=False)
class TracksOf(Generic[Rows]):
    """Tracks, in memory or not, and what is told of them.

    Attributes
    ----------
    points : one for each link of two frames, or for each place of a track in a sequence
    format_name : of the file that holds such points
    paths : tracks that pass from each frame to the next
    summary : counts and figures, units in their names
    settings : the resolved config
    """

    points: Rows
    format_name: str
    paths: Sequence[Paths]
    summary: dict[str, Any]
    settings: Config

    def vectors(self) -> list[VectorField]:
        """Return the field of each interval between frames, on the grid of the interrogation windows."""
        return list(self.fields())

    def fields(self) -> Iterator[VectorField]:
        """Yield what `vectors` returns, one at a time."""
        settings, volume = self.settings, self.settings.grid()
        windows = WindowGrid(
            volume,
            settings.windows_voxel(volume.spacing_mm)[-1],
            settings.overlap(volume.spacing_mm),
            settings.masking_walls(),
        )
        return (vectors_from_paths(paths, windows, settings.correlation.dt_s) for paths in self.paths)


class Tracked(TracksOf[Points]):
    """Tracks in memory."""


def ensure_frames(frames: int, shortest: int | None) -> None:
    """Refuse what makes no tracks.

    Raises
    ------
    UsageError
    """
    if frames < 2:
        raise UsageError("track needs the particles of two frames at least")
    if frames == 2 and shortest is not None:
        raise UsageError("--shortest is for sequences: two frames make tracks of two")


def ensure_particles(counts: Sequence[int], names: Sequence[str]) -> None:
    """Refuse frames of which not even two hold particles.

    Raises
    ------
    InputError
    """
    if np.count_nonzero(counts) < 2:
        empty = [name for name, count in zip(names, counts, strict=True) if not count]
        raise InputError(f"{', '.join(empty)}: no particles; tracks need some in two frames at least")


def few_notices(counts: Sequence[int], names: Sequence[str], found: TracksOf[Any]) -> list[Notice]:
    """Return which frames hold few particles or none, and whether any could be followed."""
    fullest, named = max(counts), list(zip(names, counts, strict=True))
    notices = [
        Notice(
            "frame-without-particles",
            name,
            "there are no particles in it: no track passes there",
            "compare exposure, mask and background of the images, or leave the frame out",
            0.0,
            "some",
        )
        for name, count in named
        if not count
    ]
    notices += [
        Notice(
            "frame-with-few-particles",
            name,
            f"holds {count} particles, another frame {fullest}, most of which have no partner",
            "compare exposure, mask and background of the images",
            float(count),
            f"at least {ONE_SIDED * fullest:g}",
        )
        for name, count in named
        if 0 < count < ONE_SIDED * fullest
    ]
    if fullest < FEW:
        notices.append(
            Notice(
                "few-particles",
                names[0],
                f"{fullest} particles at most in a frame: below {FEW} neighbours do not tell wrong links",
                "judge the links by themselves, or find more particles",
                float(fullest),
                f"at least {FEW}",
            )
        )
    linked, fewest = found.summary["tracks"], min(counts)
    if len(counts) == 2 and fewest >= FEW and 0 < linked < LEAST_LINKED * fewest:
        notices.append(
            Notice(
                "few-links",
                names[0],
                f"{linked} of {fewest} particles have a partner in the other frame, as many as in unrelated images",
                "check that both images are of one pair, the time between them, and how far is sought (--search)",
                linked / fewest,
                f"at least {LEAST_LINKED:g}",
            )
        )
    if not linked:
        notices.append(
            Notice(
                "no-tracks",
                names[0],
                "no tracks were found from it to the next frame",
                "check the order of the frames and how far particles are sought (--search)",
                0.0,
                "some",
            )
        )
    return notices + doubt_notices(found.summary, names[0]) + still_notices(found.points, names[0])


def doubt_notices(summary: Mapping[str, Any], name: str) -> list[Notice]:
    """Return what is said where many links are probably wrong, and where tracks bend more than fits in time follow."""
    notices, links = [], summary["tracks"]
    if "tracked" in summary:
        links = summary["tracked"] - summary["tracks"]
    wrong = summary["expected_wrong_links"] / links if links else 0.0
    if wrong > MOST_WRONG:
        notices.append(
            Notice(
                "wrong-links",
                name,
                f"{wrong:.0%} of the links are probably wrong, by their alternatives",
                "a shorter time between the images, fewer tracers, or larger windows and correlate",
                wrong,
                f"at most {MOST_WRONG:g}",
            )
        )
    noise = summary.get("noise_over_stated")
    if noise is not None and max(noise) > LARGEST_NOISE:
        notices.append(
            Notice(
                "tracks-bend",
                name,
                f"places lie {max(noise):.1f} times their stated errors off cubics in time, which velocities are of",
                "a shorter time between the frames; or believe stated errors of velocities only where tracks are long",
                max(noise),
                f"at most {LARGEST_NOISE:g}",
            )
        )
    return notices


def still_notices(tracks: PointRows, name: str) -> list[Notice]:
    """Return what is said where nothing moves, not even by the errors of the particles' places: of one image twice."""
    ratio, count = np.empty(tracks.count), 0
    for velocity, sigma in zip(tracks.rows("velocity"), tracks.rows("velocity_sigma"), strict=True):
        known = (sigma > 0.0).all(axis=1)
        begin, count = count, count + int(np.count_nonzero(known))
        ratio[begin:count] = (np.abs(velocity[known]) / sigma[known]).max(axis=1)
    moved = float(np.median(ratio[:count], overwrite_input=True)) if count else STILL_SIGMAS
    if moved >= STILL_SIGMAS:
        return []
    return [
        Notice(
            "frames-alike",
            name,
            "nothing moves from it to the next frame, not even by chance: both are one and the same image",
            "check that the images are two",
            moved,
            f"above {STILL_SIGMAS:g} standard errors",
        )
    ]


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
        settings = settings.overridden("correlation", dt_s=even_step_s(records, names))
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
    search_mm = SEARCH_LENSES * scale.lens_mm
    if search_voxel is not None:
        search_mm = search_voxel * max(settings.grid().spacing_mm)
    return Tracking(settings.correlation.dt_s, search_mm, fewest, scale)


def tracked(
    frames: Sequence[Points],
    settings: Config,
    chosen: Tracking,
    provenance: dict[str, Any],
    found: Trajectories | None = None,
) -> Tracked:
    """Follow particles from frame to frame; where a sequence has been followed already, `found` says how."""
    reference, told = frames[0].reference, chosen.attributes(frames[0].reference)
    paths: Sequence[Paths]
    if chosen.shortest is None:
        position, arrays, summary, paths = _pair(frames[0], frames[1], chosen)
        name = TRACKS_FORMAT
    else:
        sequence = sequence_of([seen_in(frame) for frame in frames], chosen, found)
        arrays, summary, paths = sequence.by_track(), sequence.summary(), sequence.paths
        position, name = arrays.pop(POSITION), TRAJECTORIES_FORMAT
    return Tracked(Points(position, arrays, reference, told, provenance), name, paths, summary, settings)


Found = tuple[NDArray[np.float64], dict[str, NDArray[Any]], dict[str, Any], list[Paths]]


def _pair(first: Points, second: Points, chosen: Tracking) -> Found:
    """Return places, arrays, summary and paths of particles followed from one frame to the next."""
    found = match(seen_in(first), seen_in(second), chosen.search_mm, chosen.scale)
    covariance = _covariance(first, second, found, chosen.scale)
    start, end = first.position_mm[found.first], second.position_mm[found.second]
    paths = Paths(0.5 * (start + end), end - start, np.sqrt(covariance[:, :3]))
    arrays = {
        "velocity": paths.displacement_mm * MM_TO_M / chosen.dt_s,
        "velocity_sigma": paths.sigma_mm * MM_TO_M / chosen.dt_s,
        "displacement_mm": paths.displacement_mm,
        "displacement_covariance_mm2": covariance,
        "particle_a": found.first,
        "particle_b": found.second,
        "link_probability": found.probability,
    }
    summary = {
        "particles_a": len(first.position_mm),
        "particles_b": len(second.position_mm),
        "tracks": len(found.first),
        "expected_wrong_links": float(np.sum(1.0 - found.probability)),
    }
    return paths.middle_mm, arrays, summary, [paths]


def sequence_of(frames: Sequence[Seen], chosen: Tracking, found: Trajectories | None) -> SequenceTracks:
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


def _covariance(first: Points, second: Points, tracks: Tracks, scale: Scale) -> NDArray[np.float64]:
    """Return the covariances (n, 6) of a pair's displacements, mm^2: xx, yy, zz, xy, yz, xz."""
    covariance = first.arrays["covariance_mm2"][tracks.first] + second.arrays["covariance_mm2"][tracks.second]
    covariance[:, :3] += wrong_link_variance(tracks.probability, scale)
    return np.asarray(covariance)
