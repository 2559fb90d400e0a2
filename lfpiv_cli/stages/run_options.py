"""What `run` is given."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from lfpiv_cli.names import Kept, RunMethod
from lfpiv_cli.stages.batches import WorkOptions
from lfpiv_cli.stages.pairs import PairOptions


@dataclass(frozen=True, kw_only=True)
class RunOptions(PairOptions, WorkOptions):
    """What `run` is given besides the config; it resumes by itself.

    Attributes
    ----------
    images : of the flow
    white, dark, board, depth_mm : as of `calibrate_snapshot`; the dark image also of the flow
    background, mask : as of `reconstruct`
    method : by volumes, particles or both; `auto`: by how many tracers there are
    dt_s : time from one image to the next, in place of the config's
    combine : of both methods, also one field that weights their vectors by their uncertainties
    follow : find and track the particles of a time-resolved sequence together, as `follow_particles` does
    keep : `results`: volumes, and particles of separate pairs, are dropped as soon as their vectors stand
    report : make the page of all that the folder holds, too
    """

    images: Sequence[Path]
    white: Sequence[Path] = ()
    dark: Path | None = None
    board: Sequence[Path] = ()
    depth_mm: Sequence[float] = ()
    background: str | None = None
    mask: str | Path | None = None
    method: RunMethod = "auto"
    dt_s: float | None = None
    combine: bool = False
    follow: bool = False
    keep: Kept = "all"
    report: bool = True
