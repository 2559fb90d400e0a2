"""What speaks against vectors and tracks, and whether a result can be relied on: good, look, or no, with reasons.

Windows may not fit the volumes or hold too few tracers, links be wrong. For the verdict three parts of the chain are
judged: the calibration, the images and what was found in them, and the vectors. What was warned of when files were made
counts, and for vectors what the flow says against them (`flow.field`).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter

from lfpiv_cli.arrays import Floats
from lfpiv_cli.calibration.light_checks import MOST_SATURATED
from lfpiv_cli.files.atomic import without_nan
from lfpiv_cli.files.particle_file import PointRows
from lfpiv_cli.files.provenance import calibrated_with
from lfpiv_cli.files.vtkhdf import Volume, open_vectors
from lfpiv_cli.flow.field import (
    MASKED,
    MM_TO_M,
    REJECTED,
    VALID,
    VectorField,
    difference_over_stated,
    divergence_over_stated,
)
from lfpiv_cli.flow.sums import margins, valid_shares
from lfpiv_cli.flow.windows import CorrelationSettings, WindowLayout
from lfpiv_cli.notice import Notice, written
from lfpiv_cli.robust import of_half_the_sum
from lfpiv_cli.tracks.tracking import FEWEST_OF_FIT

# A frame with less than this share of the fullest one's particles leaves most of those without a partner.
ONE_SIDED = 0.5
# With fewer particles than this no local linear fit tells which links are wrong.
FEW = FEWEST_OF_FIT + 2
# Of good pairs four in five particles or more are linked; of unrelated images chance links three in ten. Of so many or
# more, linked four in five, fewer than half are in one good pair of seventeen at most.
LEAST_LINKED, FEWEST_TO_LINK = 0.5, 4
# The share of probably wrong links above which vectors of single tracks are in doubt, of a whole link at least.
MOST_WRONG, LEAST_WRONG_LINKS = 0.05, 1.0
# Pulses of one laser differ by less; where they do not, the fainter image has markedly larger errors.
MOST_UNEQUAL = 1.25
# Particles' places scatter by one to two stated errors about smooth paths; what is more is the flow's.
LARGEST_NOISE = 3.0
# Displacements of still particles differ from 0 by a standard error along one axis or another, by chance.
STILL_SIGMAS = 0.05

# Two vectors along an axis show no profile, and each is half about the volume's face.
FEWEST_ALONG_AXIS = 3
# Below five tracers a window the share of false vectors rises steeply; peaks of a volume are fewer than tracers where
# these are dense, and more where ghosts stand between them: a third of those of the sample's windows.
FEWEST_TRACERS = 3.0
# A voxel brighter than those around it and than this share of those that most of the light comes from is a tracer.
TRACER_SHARE = 0.1
# Of the vectors.
MOST_WITHOUT, MOST_IN_DOUBT = 0.5, 0.5
# Voxels: volumes that have no tracers in common leave more than this sideways, poor ones of a pair a quarter of it.
LARGEST_MEDIAN_SIGMA = 0.5
# Only a volume and itself correlate so well and lie so still: two images of the same tracers have different noise.
SAME_CORRELATION, STILL_VOXEL = 0.9999, 1e-3
# A range of displacements leaves out so many percent at either end, where a few are false.
LEFT_OUT_PERCENT = 5.0


@dataclass(frozen=True, eq=False)
class Quality:
    """How good the vectors of one or several fields are.

    Attributes
    ----------
    vectors, used, in_doubt, without : how many there are in all, inside the mask, of these not as the highest peak gave
        them, and finite ones without an uncertainty
    finite : how many have a displacement
    sigma : (fields, 3) median standard deviations, NaN where none is known
    """

    vectors: int
    used: int
    in_doubt: int
    finite: int
    without: int
    sigma: Floats

    def summary(self) -> dict[str, Any]:
        """Return the figures, units in their names; None where there are no vectors, or none with an uncertainty."""
        known = np.isfinite(self.sigma).all(axis=1)
        return {
            "uncertainty_voxel_median": np.median(self.sigma[known], axis=0).tolist() if known.any() else None,
            "without_uncertainty_share": self.without / self.finite if self.finite else None,
            "in_doubt_share": self.in_doubt / self.used if self.used else None,
        }


def quality_of(field: VectorField) -> Quality:
    """Return how good the vectors of a field are."""
    finite, used = field.flag < REJECTED, field.flag < MASKED
    sigma = np.full(field.displacement_voxel.shape, np.nan)
    if field.uncertainty_voxel is not None:
        sigma = field.uncertainty_voxel
    known = finite & np.isfinite(sigma).all(axis=-1)
    median = np.median(sigma[known], axis=0) if known.any() else np.full(3, np.nan)
    in_doubt, without = (int(np.count_nonzero(each)) for each in (used & (field.flag != VALID), finite & ~known))
    return Quality(field.flag.size, int(used.sum()), in_doubt, int(finite.sum()), without, median[np.newaxis])


def quality_of_all(parts: Sequence[Quality]) -> Quality:
    """Return how good the vectors of several fields are."""
    names = ("vectors", "used", "in_doubt", "finite", "without")
    sums = {name: sum(getattr(part, name) for part in parts) for name in names}
    return Quality(**sums, sigma=np.concatenate([np.zeros((0, 3)), *(part.sigma for part in parts)]))


def figures_of(fields: Mapping[str, Sequence[Path]]) -> dict[str, dict[str, float | int | None]]:
    """Return how many vectors each method gives, how good they are and what they range over: figures by method.

    Files are read one after the other.
    """
    reported: dict[str, dict[str, float | int | None]] = {}
    for method, paths in fields.items():
        if not paths:
            continue
        qualities, displacements, valid = [], [], 0
        for path in paths:
            field = open_vectors(path)
            qualities.append(quality_of(field))
            displacements.append(field.displacement_voxel[field.flag < REJECTED])
            valid += int(np.count_nonzero(field.flag == VALID))
        quality, moved = quality_of_all(qualities), np.concatenate(displacements)
        ends = LEFT_OUT_PERCENT, 100.0 - LEFT_OUT_PERCENT
        low, high = np.percentile(moved, ends, axis=0) if len(moved) else np.full((2, 3), np.nan)
        sigma = np.median(quality.sigma, axis=0) if len(quality.sigma) else np.full(3, np.nan)
        figures: dict[str, float | int | None] = {"vectors": quality.vectors, "valid": valid}
        for k, name in enumerate("uvw"):
            ranges = {"from": low[k], "to": high[k], "sigma": sigma[k]}
            figures |= {f"{name}_{what}_voxel": without_nan(value) for what, value in ranges.items()}
        for name, value in figures.items():
            reported.setdefault(name, {})[method] = value
    return reported


def velocity_of(field: VectorField) -> tuple[Floats, Floats]:
    """Return the mean velocity (3,) of the valid vectors of a field and the median stated error of one, m/s.

    NaN where there are none, or no time is known.
    """
    valid = field.flag == VALID
    if field.dt_s is None or not valid.any():
        return np.full(3, np.nan), np.full(3, np.nan)
    scale = np.asarray(field.voxel_mm) * MM_TO_M / field.dt_s
    return field.velocity[valid].mean(axis=0), scale * quality_of(field).sigma[0]


def field_notices(quality: Quality, name: str) -> Iterator[Notice]:
    """Yield what speaks against the vectors of a field."""
    if quality.finite and quality.without > MOST_WITHOUT * quality.finite:
        share = quality.without / quality.finite
        text = f"{share:.0%} of the vectors have no uncertainty: their windows hold too little to tell one"
        yield Notice("no-uncertainty", name, text, "larger correlation.windows", share, f"at most {MOST_WITHOUT:g}")
    if quality.used and quality.in_doubt > MOST_IN_DOUBT * quality.used:
        share = quality.in_doubt / quality.used
        text = f"{share:.0%} of the vectors are rejected, replaced or of a second peak"
        remedy = (
            "larger correlation.windows, a shorter time between the images, more tracers; or leave out where there are "
            "none (--mask)"
        )
        yield Notice("vectors-in-doubt", name, text, remedy, share, f"at most {MOST_IN_DOUBT:g}")


def pair_notices(field: VectorField, quality: Quality, name: str) -> Iterator[Notice]:
    """Yield what speaks against the two images that one field of vectors is of."""
    finite = field.flag < REJECTED
    correlation = float(np.median(field.correlation[finite])) if finite.any() else 0.0
    if correlation > SAME_CORRELATION and np.abs(field.displacement_voxel[finite]).max() < STILL_VOXEL:
        text = "both volumes are one and the same: nothing has moved, and no noise differs"
        remedy = "check that the two images of the pair are two"
        yield Notice("volumes-alike", name, text, remedy, correlation, f"at most {SAME_CORRELATION:g}")
    largest = float(quality.sigma[0, :2].max())
    if largest > LARGEST_MEDIAN_SIGMA:
        text = (
            f"half of the vectors have an uncertainty above {written(largest, 2)} voxels sideways: the volumes have "
            "few tracers in common"
        )
        remedy = "check that both images are of one pair, and the time between them; larger windows, more tracers"
        yield Notice("volumes-unlike", name, text, remedy, largest, f"at most {LARGEST_MEDIAN_SIGMA:g}")


def window_notices(volume: Volume, settings: CorrelationSettings, name: str) -> Iterator[Notice]:
    """Yield what speaks against correlating a volume in such windows."""
    size, shape = settings.windows[-1], volume.grid.shape_xyz
    layout = settings.layout(shape)
    few = [axis for axis in range(3) if layout.count[axis] < FEWEST_ALONG_AXIS and shape[axis] > 1]
    if few:
        fewest = min(few, key=lambda axis: layout.count[axis])
        axis, length = "xyz"[fewest], size[fewest] * volume.grid.spacing_mm[fewest]
        text = (
            f"the final windows are {size[fewest]} voxels ({written(length)} mm) along {axis}, where the volume has "
            f"{shape[fewest]}: vectors along that axis: {layout.count[fewest]}"
        )
        remedy = f"windows as [x, y, z] with fewer voxels along {axis}, or window_mm"
        expected = f"at least {FEWEST_ALONG_AXIS} vectors"
        yield Notice("windows-too-large", "correlation.windows", text, remedy, float(layout.count[fewest]), expected)
    tracers = tracers_per_window(volume.array, layout)
    if tracers < FEWEST_TRACERS:
        text = (
            f"half of the final windows hold {written(tracers, 2)} bright spots or fewer: below {FEWEST_TRACERS:g} "
            "vectors are often false"
        )
        remedy = (
            "larger correlation.windows, more tracers, or particle tracking (reconstruct --solver particles, track)"
        )
        yield Notice("few-tracers", name, text, remedy, tracers, f"at least {FEWEST_TRACERS:g}")


def tracers_per_window(volume: NDArray[np.float32], layout: WindowLayout) -> float:
    """Return the median number of bright spots of a volume (z, y, x) in windows."""
    peaks = (volume == maximum_filter(volume, 3)) & (volume > 0.0)
    if not peaks.any():
        return 0.0
    peaks &= volume > TRACER_SHARE * of_half_the_sum(volume[peaks])
    before, after = margins(layout, (volume.shape[0], volume.shape[1], volume.shape[2]), 0)
    padded = np.pad(peaks.astype(np.uint8), list(zip(before, after, strict=True)))
    return float(np.median(valid_shares(padded, layout, before)) * np.prod(layout.size))


def calibration_notices(records: Mapping[str, Mapping[str, Any]]) -> list[Notice]:
    """Return whether results, given as their records by name, were made with different calibrations."""
    known = [(name, calibrated_with(made)) for name, made in records.items()]
    known = [(name, calibration) for name, calibration in known if calibration is not None]
    if not known:
        return []
    text = f"was made with another calibration than {known[0][0]}: what moved between the two counts as motion"
    remedy, others = "reconstruct all with one calibration", [name for name, each in known if each != known[0][1]]
    return [Notice("other-calibration", name, text, remedy) for name in others]


def few_notices(
    counts: Sequence[int], names: Sequence[str], summary: Mapping[str, Any], tracks: PointRows
) -> list[Notice]:
    """Return which frames hold few particles or none, and whether any could be followed."""
    fullest, named = max(counts), list(zip(names, counts, strict=True))
    text = "there are no particles in it: no track passes there"
    remedy = "compare exposure, mask and background of the images, or leave the frame out"
    empty = [name for name, count in named if not count]
    notices = [Notice("frame-without-particles", name, text, remedy, 0.0, "some") for name in empty]
    remedy, expected = "compare exposure, mask and background of the images", f"at least {ONE_SIDED * fullest:g}"
    for name, count in named:
        if 0 < count < ONE_SIDED * fullest:
            text = f"holds {count} particles, another frame {fullest}, most of which have no partner"
            notices.append(Notice("frame-with-few-particles", name, text, remedy, float(count), expected))
    if fullest < FEW:
        text = f"{fullest} particles at most in a frame: below {FEW} neighbours do not tell wrong links"
        remedy = "judge the links by themselves, or find more particles"
        notices.append(Notice("few-particles", names[0], text, remedy, float(fullest), f"at least {FEW}"))
    linked, fewest = summary["tracks"], summary.get("particles_staying", min(counts))
    if len(counts) == 2 and fewest >= FEWEST_TO_LINK and 0 < linked < LEAST_LINKED * fewest:
        text = f"{linked} of {fewest} particles that stay in view have a partner, as many as in unrelated images"
        remedy = "check that both images are of one pair, the time between them, and how far is sought (--search)"
        notices.append(Notice("few-links", names[0], text, remedy, linked / fewest, f"at least {LEAST_LINKED:g}"))
    if not linked:
        text = "no tracks to the next frame: particles have no motion in common beyond chance, nor partners close by"
        remedy = "check the order of the frames; a shorter time between them, or say how far tracers move (--search)"
        notices.append(Notice("no-tracks", names[0], text, remedy, 0.0, "some"))
    return notices + doubt_notices(summary, names[0]) + still_notices(tracks, names[0])


def doubt_notices(summary: Mapping[str, Any], name: str) -> list[Notice]:
    """Return what is said where many links are probably wrong, and where tracks bend more than fits in time follow."""
    notices, links = [], summary["tracks"]
    if "tracked" in summary:
        links = summary["tracked"] - summary["tracks"]
    wrong = summary["expected_wrong_links"] / links if links else 0.0
    if wrong > MOST_WRONG and summary["expected_wrong_links"] >= LEAST_WRONG_LINKS:
        text = f"{wrong:.0%} of the links are probably wrong, by their alternatives"
        remedy = "a shorter time between the images, fewer tracers, or larger windows and correlate"
        notices.append(Notice("wrong-links", name, text, remedy, wrong, f"at most {MOST_WRONG:g}"))
    light = summary.get("light_b_over_a", 1.0)
    if max(light, 1.0 / light) > MOST_UNEQUAL:
        text = f"particles of the second image are {light:.2f} times as bright as in the first: of unequal pulses"
        remedy = "balance the energies of the two pulses, or the exposures: the fainter image has the larger errors"
        notices.append(Notice("light-unequal", name, text, remedy, light, f"{1 / MOST_UNEQUAL:g} to {MOST_UNEQUAL:g}"))
    noise = summary.get("noise_over_stated")
    if noise is not None and max(noise) > LARGEST_NOISE:
        text = f"places lie {max(noise):.1f} times their stated errors off cubics in time, which velocities are of"
        remedy = "a shorter time between the frames; or believe stated errors of velocities only where tracks are long"
        notices.append(Notice("tracks-bend", name, text, remedy, max(noise), f"at most {LARGEST_NOISE:g}"))
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
    text = "nothing moves from it to the next frame, not even by chance: both are one and the same image"
    remedy = "check that the images are two"
    return [Notice("frames-alike", name, text, remedy, moved, f"above {STILL_SIGMAS:g} standard errors")]


Verdict = Literal["unknown", "good", "look", "no"]
# From the best to the worst; what is not known counts for nothing.
ORDER: tuple[Verdict, ...] = ("unknown", "good", "look", "no")
Part = Literal["calibration", "images", "vectors"]

# What makes a result worthless, and what is said for information.
WORTHLESS = {
    "light-off-lens-images",
    "dark-lit",
    "frame-uniform",
    "frame-dark",
    "light-unexplained",
    "no-particles",
    "no-tracks",
    "frames-alike",
    "other-calibration",
    "volumes-alike",
    "volumes-unlike",
}
FOR_INFORMATION = {"heavy-work", "particle-diameter-limit"}
# What does so where it measures more than this: of four tracers for each microlens one in seven is found by tracks, of
# six hardly any, however much of the light is explained.
WORTHLESS_BEYOND = {"frame-saturated": MOST_SATURATED, "particles-crowded": 6.0}
# The commands whose warnings are of the calibration, and of the images; those of all others are of the vectors.
CALIBRATES = ("calibrate-snapshot", "refine-calibration")
OF_CALIBRATION = (*CALIBRATES, "build-weights")
OF_IMAGES = ("reconstruct", "find_particles", "follow")
# Errors are taken for larger than stated from here on: the ratios scatter by some tenths where windows share tracers.
LARGEST_OVER_STATED = 3.0
# Vectors that are shorter than so many standard deviations on every axis show no flow.
SHORTEST_SIGMAS = 3.0
# A component tells little whose usual stated error is a larger share of the usual displacement.
LARGEST_SHARE = 0.25


@dataclass(frozen=True)
class Line:
    """One thing that speaks for or against something: what it is about, the verdict, and why."""

    about: str
    verdict: Verdict
    reason: str


def worst(lines: Iterable[Line], unsaid: Verdict = "unknown") -> Verdict:
    """Return the verdict on the whole; `unsaid` where there are no lines."""
    return max((line.verdict for line in lines), key=ORDER.index, default=unsaid)


def of_warnings(records: Mapping[str, Mapping[str, Any]]) -> list[Line]:
    """Return what the warnings say that the records of files hold, by the files' names; each once, with its count."""
    seen: dict[tuple[Part, str], list[tuple[str, Mapping[str, Any]]]] = {}
    for name, made in records.items():
        verb = verb_of(made)
        part: Part = "calibration" if verb in OF_CALIBRATION else "images" if verb in OF_IMAGES else "vectors"
        for warning in made.get("warnings", ()):
            seen.setdefault((part, warning["code"]), []).append((name, warning))
    reasons = []
    for (part, _), those in seen.items():
        first, files = those[0][1], len({name for name, _ in those})
        more = f" (and {files - 1} more)" if files > 1 else ""
        word = max((word_of(warning) for _, warning in those), key=ORDER.index)
        reasons.append(Line(part, word, f"{first['about']}: {first['text']}{more}; {first['remedy']}"))
    return reasons


def verb_of(made: Mapping[str, Any]) -> str:
    """Return the command of a record without its options."""
    return str(made.get("command")).split(" ")[0]


def word_of(warning: Mapping[str, Any]) -> Verdict:
    """Return what is thought of a result by one warning's record alone."""
    code, measured = warning["code"], warning.get("measured")
    if code in WORTHLESS or (code in WORTHLESS_BEYOND and measured is not None and measured > WORTHLESS_BEYOND[code]):
        return "no"
    return "good" if code in FOR_INFORMATION else "look"


def of_vectors(field: VectorField, name: str) -> list[Line]:
    """Return what a field says of itself."""
    used, there = field.flag < MASKED, field.flag < REJECTED
    if not there.any():
        return [Line("vectors", "no", f"{name}: no vector is left")]
    share = np.count_nonzero(there) / np.count_nonzero(used)
    reasons = [Line("vectors", "good", f"{name}: {np.count_nonzero(there)} vectors, {share:.0%} of the grid points")]
    if field.uncertainty_voxel is not None:
        long = np.abs(field.displacement_voxel[there]) > SHORTEST_SIGMAS * field.uncertainty_voxel[there]
        if np.mean(long.any(axis=1)) < 0.5:
            text = f"{name}: most displacements are within {SHORTEST_SIGMAS:g} standard deviations of zero"
            reasons.append(Line("vectors", "look", f"{text}; a longer time between the images would show the flow"))
        else:
            # Components that are known too badly to tell much of the flow.
            usual_mm = float(np.median(np.linalg.norm(field.displacement_voxel[there] * field.voxel_mm, axis=1)))
            sigma_voxel = field.uncertainty_voxel[there]
            known = sigma_voxel[np.isfinite(sigma_voxel).all(axis=1)]
            sigma_mm = np.median(known, axis=0) * field.voxel_mm if len(known) else np.zeros(3)
            for component, sigma in zip("uvw", sigma_mm, strict=True):
                if sigma > LARGEST_SHARE * usual_mm > 0.0:
                    text = (
                        f"{name}: {component} is known to {written(sigma, 2)} mm, {sigma / usual_mm:.0%} of the usual "
                        "displacement; particles in place of volumes, or a longer time between the images, tell more"
                    )
                    reasons.append(Line("vectors", "look", text))
    sizes = zip("xyz", field.grid.shape_xyz, field.window_voxel, strict=True)
    # A single one of windows that are a voxel wide is a plane by intent.
    few = {axis: count for axis, count, width in sizes if count < FEWEST_ALONG_AXIS and (count > 1 or width > 1)}
    for axis, count in few.items():
        text = f"{name}: planes of vectors along {axis}: {count}, which show no profile"
        reasons.append(Line("vectors", "look", f"{text}; smaller windows along it, or a deeper volume"))
    ratio = divergence_over_stated(field)
    if ratio is not None and ratio > LARGEST_OVER_STATED:
        text = f"{name}: the divergence is {ratio:.1f} times what the stated errors make, and a liquid has none"
        reasons.append(
            Line("vectors", "look", f"{text}: errors are larger than stated, or the flow finer than windows")
        )
    return reasons


def of_two_ways(one: VectorField, other: VectorField, names: tuple[str, str]) -> list[Line]:
    """Return what two measurements of one flow say of each other."""
    ratios = difference_over_stated(one, other)
    if ratios is None:
        return []
    reported = ", ".join(f"{ratio:.1f}" for ratio in ratios)
    text = f"{names[0]} and {names[1]} differ by {reported} (u, v, w) times what their stated errors let expect"
    return [Line("vectors", "look" if max(ratios) > LARGEST_OVER_STATED else "good", text)]
