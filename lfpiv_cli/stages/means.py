"""The mean of a batch's vector fields, and the fields derived from vectors: what files have besides the vectors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.console import Console, Frames
from lfpiv_cli.files import vtkhdf
from lfpiv_cli.files.batch import Target
from lfpiv_cli.files.provenance import record
from lfpiv_cli.flow.derived import Derived, derived_fields
from lfpiv_cli.flow.field import MM_TO_M
from lfpiv_cli.flow.statistics import statistics_of

Extra = dict[str, tuple[NDArray[Any], str]]


def arrays_of(derived: Derived) -> Extra:
    """Return derived fields with the names and units that files give them."""
    return {
        "vorticity": (derived.vorticity, "1/s"),
        "divergence": (derived.divergence, "1/s"),
        "strain_rate": (derived.strain_rate, "1/s"),
        "q_criterion": (derived.q_criterion, "1/s2"),
    }


class Mean:
    """The mean of a batch's vectors, with their fluctuations as `velocity_rms` and `displacement_rms_voxel`."""

    label, unit = "mean", "file"
    notices, left_out = (), ()

    def __init__(
        self, path: Path, fields: Sequence[Path], resolved: Mapping[str, Any], derived: bool, overwrite: bool
    ) -> None:
        """Take where it goes, the files of vectors, and their settings."""
        self.inputs, self._resolved, self._derived, self.overwrite = fields, resolved, derived, overwrite
        self.names, self.targets, self.order = [path.stem], [Target(path, self._record)], range(1)

    @property
    def outputs(self) -> list[Path]:
        """The mean."""
        return [target.path for target in self.targets]

    def begin(self, _numbers: Sequence[int], _console: Console) -> float:
        """Do nothing: there is one."""
        return 1.0

    def make(self, number: int, _work: Frames) -> None:
        """Write it."""
        found = statistics_of(vtkhdf.open_vectors(field) for field in self.inputs)
        extra: Extra = {
            "displacement_rms_voxel": (found.rms_voxel, "voxel"),
            "samples": (found.samples, "1"),
        }
        if found.mean.dt_s is not None:
            to_velocity = np.asarray(found.mean.voxel_mm) * MM_TO_M / found.mean.dt_s
            extra["velocity_rms"] = (found.rms_voxel * to_velocity, "m/s")
        if self._derived:
            extra |= arrays_of(derived_fields(found.mean))
        vtkhdf.write_vectors(
            self.targets[number].path,
            found.mean,
            vtkhdf.read_header(self.inputs[0]).reference,
            provenance=self.targets[number].record,
            overwrite=True,
            extra=extra,
        )

    def _record(self) -> dict[str, Any]:
        inputs = {f"vectors_{number:04d}": field for number, field in enumerate(self.inputs)}
        return record("correlate mean", self._resolved, inputs)
