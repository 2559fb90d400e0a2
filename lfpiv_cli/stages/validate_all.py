"""The stage of `validate all`: weights, boards and flow of one config, one after the other."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from lfpiv_cli.console import CONSOLE, Console
from lfpiv_cli.errors import LimitMissedError
from lfpiv_cli.files.config import load_config
from lfpiv_cli.stages.simulate import ensure_experiment
from lfpiv_cli.stages.validate_board import depths_in_volume, validate_board
from lfpiv_cli.stages.validate_flow import validate_flow
from lfpiv_cli.stages.validate_weights import validate_weights


def validate_all(config: Path, output: Path, *, overwrite: bool = False, console: Console = CONSOLE) -> dict[str, Any]:
    """Write every report into one folder; a limit that one of them misses does not keep the others from being made."""
    ensure_complete(config)
    stages: dict[str, Callable[..., dict[str, Any]]] = {
        "weights": validate_weights,
        "board": validate_board,
        "flow": validate_flow,
    }
    summary: dict[str, Any] = {}
    missed = []
    for name, stage in stages.items():
        try:
            found = stage(config, output, overwrite=overwrite, console=console)
        except LimitMissedError as error:
            missed.append(str(error))
            found = error.figures
        summary |= {f"{name}.{figure}": value for figure, value in found.items()}
    if missed:
        raise LimitMissedError("; ".join(missed), summary)
    return summary


def ensure_complete(config: Path) -> None:
    """Refuse a config that lacks what the last of the reports needs before the first is made.

    Raises
    ------
    ConfigError
    """
    settings = load_config(config)
    depths_in_volume(settings)
    ensure_experiment(settings)
