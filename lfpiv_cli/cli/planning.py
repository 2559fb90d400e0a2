"""Commands before an experiment: a configuration to begin with, and what to expect of it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from lfpiv_cli.cli.options import FILE, POSITIVE, common_options, config_argument, dark_option, raw_option
from lfpiv_cli.console import Console
from lfpiv_cli.names import KnownCamera, names_in

if TYPE_CHECKING:
    from lfpiv_cli.files.rig_numbers import RigNumbers

RIG = Path("rig.yaml")


@click.command("init")
@click.argument("config", type=FILE, required=False)
@click.option("-o", "--output", type=FILE, help="File to write, in place of CONFIG; default rig.yaml.")
@click.option("--camera", type=click.Choice(names_in(KnownCamera)), help="A published camera, nothing is asked.")
@click.option("--from", "calibration", type=FILE, help="A calibration (.h5), whose configuration is written again.")
@click.option("--schema", is_flag=True, help="Write the JSON schema of rig files instead, for editors.")
@common_options
def init(
    config: Path | None = None,
    output: Path | None = None,
    schema: bool = False,
    *,
    overwrite: bool,
    console: Console,
    **chosen: Any,
) -> dict[str, Any]:
    """Write a rig file to begin with, from a few numbers that are asked for.

    An answer of nothing takes the default in brackets; defaults follow from the answers before. The file can be
    simulated and run as it is. It names the schema where rig.schema.json lies beside it.

    \b
    Example: lfpiv init rig.yaml
             lfpiv init --camera table2 -o table2.yaml
             lfpiv init --from calibration.h5 -o again.yaml
             lfpiv init --schema -o rig.schema.json
    """
    from lfpiv_cli.errors import UsageError
    from lfpiv_cli.files.atomic import ensure_writable
    from lfpiv_cli.stages import init as stage

    if config is not None and output is not None:
        raise UsageError(f"init writes one file, and {config} and -o {output} were given")
    if schema:
        return stage.write_schema(output or config or Path(stage.SCHEMA_NAME), overwrite=overwrite)
    target = output or config or RIG
    ensure_writable(target, overwrite)
    if not chosen:
        chosen["numbers"] = _asked()
    return stage.init(target, stage.InitOptions(**chosen), overwrite=overwrite, console=console)


@click.command("check")
@config_argument
@click.argument("images", type=FILE, nargs=-1)
@click.option("--white", type=FILE, help="White image, which tells where the lens images lie.")
@dark_option
@click.option("--calibration", type=FILE, help="From calibrate-snapshot, in place of the data sheet.")
@click.option("--velocity-m-s", type=POSITIVE, help="Velocity to expect; default that of the configured flow.")
@click.option("--picture", type=FILE, help="Picture of errors and field of view by depth to write (.png).")
@common_options
@raw_option
def check(config: Path, images: tuple[Path, ...], overwrite: bool, console: Console, **chosen: Any) -> dict[str, Any]:
    """Tell what a rig and its images are good for, in seconds, before any work.

    Each line has its verdict: good; look, worth a look; no, it cannot work so; or unknown, where nobody can tell. The
    verdict on the whole is the worst of them. Errors are the smallest that the light allows. The exit code is 0
    whatever the verdict, which --json has as `verdict`.

    \b
    Example: lfpiv check rig.yaml --velocity-m-s 0.2 --picture rig.png
             lfpiv check rig.yaml a.tif b.tif --white white.tif --dark dark.tif
             lfpiv check rig.yaml a.tif b.tif --calibration calibration.h5 --dark dark.tif
    """
    from lfpiv_cli.stages import check as stage

    return stage.check(config, images, stage.CheckOptions(**chosen), overwrite=overwrite, console=console)


def _asked() -> RigNumbers:
    """Ask for the numbers of a rig; each default follows from the answers before it."""
    from lfpiv_cli.files.rig_numbers import RigNumbers

    plain = RigNumbers()
    answers: dict[str, Any] = {
        "magnification": _magnification(plain.magnification),
        "focal_length_mm": _number("focal length of the main lens, mm", plain.focal_length_mm),
        "pitch_mm": (pitch := _number("pitch of the microlenses, mm", plain.pitch_mm)),
    }
    guess = RigNumbers(**answers).complete()
    focal = _length(
        "focal length of the microlenses, mm, or their f-number as f/8", f"{guess.microlens_focal_length_mm:g}"
    )
    answers["microlens_focal_length_mm"] = focal[0] or focal[1] * pitch
    guess = RigNumbers(**answers).complete()
    aperture = _length("f-number of the main lens as f/4, or its aperture, mm", f"f/{guess.f_number:g}")
    answers["f_number"] = aperture[1] or answers["focal_length_mm"] / aperture[0]
    answers |= {
        "pixel_um": _number("size of the pixels, um", plain.pixel_um),
        "columns": _count("columns of the images", plain.columns),
        "rows": _count("rows of the images", plain.rows),
        "fluid": (fluid := _number("refractive index of the fluid", plain.fluid)),
    }
    if fluid != 1.0:
        answers["wall"] = _number("refractive index of the wall or window", plain.wall)
        answers["wall_mm"] = click.prompt("its thickness, mm", plain.wall_mm, type=click.FloatRange(min=0.0), err=True)
        width = click.prompt(
            "inner width of the channel along the optical axis, mm, 0 without one",
            0.0,
            type=click.FloatRange(min=0.0),
            err=True,
        )
        answers["channel_mm"] = width or None
    guess = RigNumbers(**answers).complete()
    answers["size_mm"] = _sides("size of the volume, mm", guess.size_mm or (1.0, 1.0, 1.0))
    answers["velocity_m_s"] = _number("velocity to expect, m/s", plain.velocity_m_s)
    return RigNumbers(**answers)


def _magnification(default: float) -> float:
    """Ask for the magnification; images are inverted, whether the answer has its minus or not."""

    def parsed(answer: str) -> float:
        return -_above_zero(answer.strip().removeprefix("-"))

    text = "magnification, image over object, negative because the image is inverted"
    return float(click.prompt(text, f"{default:g}", value_proc=parsed, err=True))


def _number(text: str, default: float) -> float:
    return float(click.prompt(text, default, type=click.FloatRange(min=0.0, min_open=True), err=True))


def _count(text: str, default: int) -> int:
    return int(click.prompt(text, default, type=click.IntRange(min=1), err=True))


def _length(text: str, default: str) -> tuple[float, float]:
    """Ask for a length or an f-number; the other one of the two is 0."""

    def parsed(answer: str) -> tuple[float, float]:
        word = answer.lower().removesuffix("mm").strip()
        value = _above_zero(word.removeprefix("f/"))
        return (0.0, value) if word.startswith("f/") else (value, 0.0)

    length, f_number = click.prompt(text, default, value_proc=parsed, err=True)
    return length, f_number


def _sides(text: str, default: tuple[float, float, float]) -> tuple[float, float, float]:
    """Ask for three lengths."""

    def parsed(answer: str) -> list[float]:
        sides = [_above_zero(word) for word in answer.replace(",", " ").split()]
        if len(sides) != 3:
            raise click.UsageError(f"{answer}: expected three lengths, x y z")
        return sides

    x, y, z = click.prompt(text, " ".join(f"{side:g}" for side in default), value_proc=parsed, err=True)
    return x, y, z


def _above_zero(word: str) -> float:
    """Return the number that a word says.

    Raises
    ------
    UsageError : it says none, or none above 0; click asks again
    """
    try:
        value = float(word)
    except ValueError as error:
        raise click.UsageError(f"{word}: is no number") from error
    if not 0.0 < value < float("inf"):
        raise click.UsageError(f"{word}: expected a number above 0")
    return value
