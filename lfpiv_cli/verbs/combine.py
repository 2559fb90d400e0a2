"""`combine`: one vector field of two that measured the same flow in different ways."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from lfpiv_cli.console import CONSOLE, Console
from lfpiv_cli.errors import InputError
from lfpiv_cli.files import atomic, batch, vtkhdf
from lfpiv_cli.files.provenance import OF_COORDINATES, ensure_agreement, record
from lfpiv_cli.flow.combining import Combined
from lfpiv_cli.flow.combining import combine as weighted
from lfpiv_cli.flow.field import MASKED, REJECTED, VectorField


def combine(first: VectorField, second: VectorField) -> Combined:
    """Return one field of two that measured the same flow on one grid, weighted by their uncertainties.

    Parameters
    ----------
    first, second : VectorField
        From `correlate`, `fit_field`, `Tracked.vectors` or `open_vectors`.

    Returns
    -------
    Combined
        `field` is masked where either is, rejected where neither has a vector; `first_share` and `disagreement` tell
        how each vector came about.

    Raises
    ------
    InputError
        The fields differ in grid, voxels or time.
    """
    found = weighted(first, second)
    made = record("combine", first.provenance.get("config"), {})
    return replace(found, field=replace(found.field, provenance=made))


def combine_vectors(
    vectors_a: Path,
    vectors_b: Path,
    output: Path,
    *,
    resume: bool = False,
    overwrite: bool = False,
    console: Console = CONSOLE,
) -> dict[str, Any]:
    """Weight the vectors of two files by their uncertainties; with `resume`, keep what was made from the same."""
    inputs = {"vectors_a": vectors_a, "vectors_b": vectors_b}
    atomic.ensure_writable(output, overwrite or resume, inputs.values())
    headers = [vtkhdf.read_header(path) for path in inputs.values()]
    if headers[0].reference != headers[1].reference:
        raise InputError(f"{vectors_b}: its coordinates have another origin than those of {vectors_a}")
    ensure_agreement([header.provenance for header in headers], [str(path) for path in inputs.values()], OF_COORDINATES)
    made = record("combine", headers[0].provenance.get("config"), inputs)
    if resume:
        if batch.is_kept([output], made, inputs.values(), overwrite):
            return {"vectors": vtkhdf.open_vectors(output).flag.size}
        overwrite = True
    found = weighted(*(vtkhdf.open_vectors(path) for path in inputs.values()))
    vtkhdf.write_vectors(
        output, found.field, headers[0].reference, provenance=made, overwrite=overwrite, extra=found.arrays()
    )
    return {
        "vectors": found.field.flag.size,
        "weighted": int(np.count_nonzero(np.isfinite(found.disagreement) & ~found.left_out)),
        "left_out_for_disagreement": int(np.count_nonzero(found.left_out)),
        "rejected": int(np.count_nonzero(found.field.flag == REJECTED)),
        "masked": int(np.count_nonzero(found.field.flag == MASKED)),
        "uncertainty_widened_a": found.widened[0].tolist(),
        "uncertainty_widened_b": found.widened[1].tolist(),
    }
