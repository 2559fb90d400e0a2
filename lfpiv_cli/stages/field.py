"""The stage of `field`: one velocity field fitted to tracks and vectors of a flow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.console import CONSOLE, Console
from lfpiv_cli.errors import InputError, UsageError
from lfpiv_cli.fields.samples import Samples
from lfpiv_cli.files import vtkhdf
from lfpiv_cli.files.atomic import ensure_writable, write_text
from lfpiv_cli.files.config import Config
from lfpiv_cli.files.hdf5 import format_of
from lfpiv_cli.files.inputs import content_of
from lfpiv_cli.files.particle_file import PARTICLES_FORMAT, TRAJECTORIES_FORMAT, read_points, read_tracks
from lfpiv_cli.files.provenance import OF_COORDINATES, record, with_warnings
from lfpiv_cli.flow.field import MASKED, REJECTED, VectorField
from lfpiv_cli.interface.fields import (
    FittedField,
    ensure_one_time,
    fit_notices,
    fitted,
    samples_of_tracks,
    samples_of_vectors,
)
from lfpiv_cli.interface.pressure import PressureResult, pressure_of
from lfpiv_cli.interface.tracks import settings_of
from lfpiv_cli.names import Divergence
from lfpiv_cli.stages.means import Extra, arrays_of


@dataclass(frozen=True, kw_only=True)
class FieldOptions:
    """What `field` is given besides its files.

    Attributes
    ----------
    dt_s : time from one frame to the next, in place of the config's
    divergence : what is known of it
    frame : of a sequence of tracks, counted from 0; the middle one where None
    pressure : files of the particles of a sequence, by which its pressure is found, too
    derived : vorticity, divergence, strain rate, Q criterion and gradients, too
    at : file with points in mm where velocities are asked for, too, beside the output
    """

    dt_s: float | None = None
    divergence: Divergence = "penalised"
    frame: int | None = None
    pressure: Sequence[Path] = ()
    derived: bool = False
    at: Path | None = None


NO_OPTIONS = FieldOptions()


def fit_flow(
    paths: Sequence[Path],
    output: Path,
    options: FieldOptions = NO_OPTIONS,
    *,
    overwrite: bool = False,
    console: Console = CONSOLE,
) -> dict[str, Any]:
    """Fit a field to files of tracks of pairs and of vectors, and write it on the grid of the correlation windows."""
    places = output.with_name(f"{output.stem}_at.csv")
    ensure_writable(output, overwrite, paths)
    if options.at is not None:
        ensure_writable(places, overwrite, [*paths, options.at])
    points = None if options.at is None else read_places(options.at)
    headers, names = [vtkhdf.read_header(path) for path in paths], [str(path) for path in paths]
    for header, name in zip(headers, names, strict=True):
        if header.reference != headers[0].reference:
            raise InputError(f"{name}: its coordinates have another origin than those of {names[0]}")
    ensure_one_time(header.attributes.get("dt_s") for header in headers)
    settings = settings_of([header.provenance for header in headers], names, options.dt_s, OF_COORDINATES)
    pressed = _pressure(paths, settings, options)
    found = fitted(_samples(paths, options), settings, options.divergence, names[0])
    notices = fit_notices(found.summary, options.divergence, paths[0].name)
    console.warn(notices)
    inputs = {f"samples_{number:04d}": path for number, path in enumerate(paths)}
    inputs |= {f"particles_{number:04d}": path for number, path in enumerate(options.pressure)}
    chosen = {"divergence": options.divergence, "frame": options.frame, "derived": options.derived}
    made = with_warnings(record("field", settings.resolved() | {"field": chosen}, inputs), notices)
    vectors = found.vectors()
    extra = _derived(found) if options.derived else {}
    if pressed is not None:
        extra |= {"pressure": (pressed.pressure_pa, "Pa"), "pressure_sigma": (pressed.pressure_sigma_pa, "Pa")}
    vtkhdf.write_vectors(output, vectors, headers[0].reference, provenance=made, overwrite=overwrite, extra=extra)
    if points is not None:
        write_text(places, _table(points, found), overwrite)
    figures = {} if pressed is None else pressed.figures
    if options.derived:
        figures = figures | found.turbulence(_viscosity_m2_s(settings))
    return found.summary | figures | _figures(vectors)


def _viscosity_m2_s(settings: Config) -> float | None:
    """Return the kinematic viscosity, None where the config does not say it."""
    media = settings.media
    if media.fluid_density_kg_m3 is None or media.fluid_viscosity_pa_s is None:
        return None
    return media.fluid_viscosity_pa_s / media.fluid_density_kg_m3


def _samples(paths: Sequence[Path], options: FieldOptions) -> list[Samples]:
    """Return the samples of each file."""
    parts = []
    for path in paths:
        if format_of(path) == vtkhdf.VECTORS_FORMAT:
            parts.append(samples_of_vectors(vtkhdf.open_vectors(path), str(path)))
        else:
            parts.append(samples_of_tracks(read_tracks(path), options.frame))
    return parts


def _pressure(paths: Sequence[Path], settings: Config, options: FieldOptions) -> PressureResult | None:
    """Return the pressure of a sequence, if it is asked for."""
    if not options.pressure:
        return None
    if len(paths) != 1 or format_of(paths[0]) != TRAJECTORIES_FORMAT:
        raise UsageError("--pressure is for the tracks of one sequence, from follow or track")
    particles = [read_points(path, PARTICLES_FORMAT) for path in options.pressure]
    try:
        return pressure_of(read_tracks(paths[0]), particles, settings, options.frame)
    except InputError as error:
        raise InputError(f"{paths[0]} with {options.pressure[0].parent}: {error}") from error


def _derived(found: FittedField) -> Extra:
    """Return what follows from the field's gradients, and these, row by row."""
    gradients = found.gradients()
    flat = gradients.reshape(*gradients.shape[:3], 9)
    return arrays_of(found.derived()) | {
        f"gradient_{name}": (flat[..., 3 * row : 3 * row + 3], "1/s") for row, name in enumerate("uvw")
    }


def _figures(vectors: VectorField) -> dict[str, Any]:
    """Return how many vectors there are, and how well they are known."""
    kept, sigma = vectors.flag < REJECTED, vectors.uncertainty_voxel
    known = sigma is not None and kept.any()
    return {
        "vectors": vectors.flag.size,
        "rejected": int(np.count_nonzero(vectors.flag == REJECTED)),
        "masked": int(np.count_nonzero(vectors.flag == MASKED)),
        "uncertainty_voxel_median": np.median(sigma[kept], axis=0).tolist() if known and sigma is not None else None,
    }


def read_places(path: Path) -> NDArray[np.float64]:
    """Read points (n, 3), mm: x, y, z in a line, by commas; lines that begin with a letter or # are passed over.

    Raises
    ------
    InputError
    """
    rows = []
    for number, line in enumerate(content_of(path).decode("utf-8", errors="replace").splitlines(), start=1):
        if not line.strip() or line.lstrip()[0] in '#"' or line.lstrip()[0].isalpha():
            continue
        try:
            row = [float(word) for word in line.split(",")]
        except ValueError:
            row = []
        if len(row) != 3 or not np.all(np.isfinite(row)):
            raise InputError(f"{path}: line {number}: {line[:40]!r}, expected x, y, z in mm by commas")
        rows.append(row)
    if not rows:
        raise InputError(f"{path}: holds no points; expected x, y, z in mm, one point a line")
    return np.array(rows)


def _table(points: NDArray[np.float64], found: FittedField) -> str:
    """Return velocities and standard deviations at points as text."""
    rows = np.concatenate([points, found.at(points), found.sigma(points)], axis=1)
    lines = [",".join(repr(float(value)) for value in row) for row in rows]
    return "\n".join(["x_mm,y_mm,z_mm,u_m_s,v_m_s,w_m_s,u_sigma_m_s,v_sigma_m_s,w_sigma_m_s", *lines, ""])
