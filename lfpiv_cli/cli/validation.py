"""The command that judges results."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any, cast

import click

from lfpiv_cli.cli.options import FILE, common_options, output_option, resume_option
from lfpiv_cli.console import Console
from lfpiv_cli.names import Moment, PaperPart, names_in

# The options that each kind of validation takes, and those that it cannot do without.
TAKEN: dict[str, set[str]] = {
    "flow": {"vectors", "particles"},
    "weights": set(),
    "board": set(),
    "volume": {"volume", "particles", "frame"},
    "all": set(),
    "paper": {"quick", "only", "resume"},
}
NEEDED = {"volume": ("volume", "particles", "frame")}


@click.command("validate")
@click.argument("what", type=click.Choice(list(TAKEN)))
@click.argument("config", type=FILE, required=False)
@click.option("--vectors", type=FILE, help="flow: vectors to judge, not those of a simulation.")
@click.option("--volume", type=FILE, help="volume: volume to judge.")
@click.option(
    "--particles",
    type=FILE,
    help="volume, flow: true particles (.npz) to judge by; a flow that the config names comes first.",
)
@click.option("--frame", type=click.Choice(names_in(Moment)), help="volume: when in the pair it was taken.")
@click.option("--quick", is_flag=True, help="paper: reduced sizes, at most ten minutes on two cores.")
@click.option("--only", type=click.Choice(names_in(PaperPart)), multiple=True, help="paper: one part; repeatable.")
@resume_option
@output_option("Folder for the report.")
@common_options
def validate(
    what: str, output: Path, overwrite: bool, console: Console, config: Path | None = None, **chosen: Any
) -> dict[str, Any]:
    """Compare a result with what is known: figures as JSON, and pictures.

    \b
    Example: lfpiv validate flow rig.yaml --vectors vectors.vtkhdf -o report
             lfpiv validate flow rig.yaml -o report    (simulates the rig's experiment first)
             lfpiv validate weights rig.yaml -o report
             lfpiv validate board rig.yaml -o report
             lfpiv validate all rig.yaml -o report     (weights, board, and flow as it is simulated)
             lfpiv validate volume rig.yaml --volume a.vtkhdf --particles true.npz --frame a -o report
             lfpiv validate paper --quick -o report    (the paper's tables and figures on one page; takes no CONFIG)
    """
    chosen = {name: value for name, value in chosen.items() if value not in (False, ())}
    _refuse_misplaced(what, chosen)
    if what == "paper":
        return _validate_paper(config, output, overwrite, console, **chosen)
    if config is None:
        raise click.UsageError(f"validate {what} needs a CONFIG")
    stage = getattr(import_module(f"lfpiv_cli.stages.validate_{what}"), f"validate_{what}")
    return cast(dict[str, Any], stage(config, output, overwrite=overwrite, console=console, **chosen))


def _validate_paper(
    config: Path | None,
    output: Path,
    overwrite: bool,
    console: Console,
    quick: bool = False,
    only: tuple[PaperPart, ...] = (),
    resume: bool = False,
) -> dict[str, Any]:
    """Make the report on the paper."""
    from lfpiv_cli.paper.run import PaperOptions, validate_paper

    if config is not None:
        raise click.UsageError(f"validate paper takes no CONFIG, got {config}")
    options = PaperOptions(only=only, size="quick" if quick else "full", resume=resume)
    return validate_paper(output, options, overwrite=overwrite, console=console)


def _refuse_misplaced(what: str, chosen: dict[str, Any]) -> None:
    """Raise where an option is given that a validation does not take, or missing that it needs."""
    misplaced = [f"--{name}" for name in chosen if name not in TAKEN[what]]
    if misplaced:
        raise click.UsageError(f"validate {what} takes no {' and no '.join(misplaced)}")
    missing = [f"--{name}" for name in NEEDED.get(what, ()) if name not in chosen]
    if missing:
        raise click.UsageError(f"validate {what} needs {' and '.join(missing)}")
