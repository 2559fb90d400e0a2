"""What speaks against vectors: windows that do not fit the volumes or hold too few tracers, and vectors in doubt."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter

from lfpiv_cli.files.provenance import calibrated_with
from lfpiv_cli.files.vtkhdf import Volume
from lfpiv_cli.flow.correlation import CorrelationSettings
from lfpiv_cli.flow.field import MASKED, REJECTED, VALID, VectorField
from lfpiv_cli.flow.maps import margins, valid_shares
from lfpiv_cli.flow.windows import WindowLayout
from lfpiv_cli.notice import Notice, written
from lfpiv_cli.robust import of_half_the_sum

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
WINDOWS = "correlation.windows"


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
    sigma: NDArray[np.float64]

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
    return Quality(
        field.flag.size,
        int(used.sum()),
        int(np.count_nonzero(used & (field.flag != VALID))),
        int(finite.sum()),
        int(np.count_nonzero(finite & ~known)),
        median[np.newaxis],
    )


def quality_of_all(parts: Sequence[Quality]) -> Quality:
    """Return how good the vectors of several fields are."""
    names = ("vectors", "used", "in_doubt", "finite", "without")
    sums = {name: sum(getattr(part, name) for part in parts) for name in names}
    return Quality(**sums, sigma=np.concatenate([np.zeros((0, 3)), *(part.sigma for part in parts)]))


def field_notices(quality: Quality, name: str) -> Iterator[Notice]:
    """Yield what speaks against the vectors of a field."""
    if quality.finite and quality.without > MOST_WITHOUT * quality.finite:
        share = quality.without / quality.finite
        yield Notice(
            "no-uncertainty",
            name,
            f"{share:.0%} of the vectors have no uncertainty: their windows hold too little to tell one",
            "larger correlation.windows",
            share,
            f"at most {MOST_WITHOUT:g}",
        )
    if quality.used and quality.in_doubt > MOST_IN_DOUBT * quality.used:
        share = quality.in_doubt / quality.used
        yield Notice(
            "vectors-in-doubt",
            name,
            f"{share:.0%} of the vectors are rejected, replaced or of a second peak",
            "larger correlation.windows, a shorter time between the images, more tracers; or leave out where there are "
            "none (--mask)",
            share,
            f"at most {MOST_IN_DOUBT:g}",
        )


def pair_notices(field: VectorField, quality: Quality, name: str) -> Iterator[Notice]:
    """Yield what speaks against the two images that one field of vectors is of."""
    finite = field.flag < REJECTED
    correlation = float(np.median(field.correlation[finite])) if finite.any() else 0.0
    if correlation > SAME_CORRELATION and np.abs(field.displacement_voxel[finite]).max() < STILL_VOXEL:
        yield Notice(
            "volumes-alike",
            name,
            "both volumes are one and the same: nothing has moved, and no noise differs",
            "check that the two images of the pair are two",
            correlation,
            f"at most {SAME_CORRELATION:g}",
        )
    largest = float(quality.sigma[0, :2].max())
    if largest > LARGEST_MEDIAN_SIGMA:
        yield Notice(
            "volumes-unlike",
            name,
            f"half of the vectors have an uncertainty above {written(largest, 2)} voxels sideways: the volumes have "
            "few tracers in common",
            "check that both images are of one pair, and the time between them; larger windows, more tracers",
            largest,
            f"at most {LARGEST_MEDIAN_SIGMA:g}",
        )


def window_notices(volume: Volume, settings: CorrelationSettings, name: str) -> Iterator[Notice]:
    """Yield what speaks against correlating a volume in such windows."""
    size, shape = settings.windows[-1], volume.grid.shape_xyz
    layout = settings.layout(shape)
    few = [axis for axis in range(3) if layout.count[axis] < FEWEST_ALONG_AXIS and shape[axis] > 1]
    if few:
        fewest = min(few, key=lambda axis: layout.count[axis])
        axis, length = "xyz"[fewest], size[fewest] * volume.grid.spacing_mm[fewest]
        yield Notice(
            "windows-too-large",
            WINDOWS,
            f"the final windows are {size[fewest]} voxels ({written(length)} mm) along {axis}, where the volume has "
            f"{shape[fewest]}: vectors along that axis: {layout.count[fewest]}",
            f"windows as [x, y, z] with fewer voxels along {axis}, or window_mm",
            float(layout.count[fewest]),
            f"at least {FEWEST_ALONG_AXIS} vectors",
        )
    tracers = tracers_per_window(volume.array, layout)
    if tracers < FEWEST_TRACERS:
        yield Notice(
            "few-tracers",
            name,
            f"half of the final windows hold {written(tracers, 2)} bright spots or fewer: below {FEWEST_TRACERS:g} "
            "vectors are often false",
            "larger correlation.windows, more tracers, or particle tracking (reconstruct --solver particles, track)",
            tracers,
            f"at least {FEWEST_TRACERS:g}",
        )


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
    return [
        Notice(
            "other-calibration",
            name,
            f"was made with another calibration than {known[0][0]}: what moved between the two counts as motion",
            "reconstruct all with one calibration",
        )
        for name, calibration in known
        if calibration != known[0][1]
    ]
