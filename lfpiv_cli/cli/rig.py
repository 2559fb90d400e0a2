"""Commands of a rig: a configuration to begin with, what to expect of it, its calibration and its weights."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from lfpiv_cli.cli import options
from lfpiv_cli.cli.options import CONFIGS, FILE, POSITIVE, command, option
from lfpiv_cli.console import Console
from lfpiv_cli.errors import UsageError
from lfpiv_cli.names import KnownCamera, Method, Refraction, Sampling

if TYPE_CHECKING:
    from lfpiv_cli.verbs.init import RigNumbers


@command("build-weights")
@options.config_argument
@option("--calibration", FILE, "From calibrate-snapshot; without it the data sheet holds.")
@option("--method", Method, "Equivalent, traced or fitted rays.", show_default=CONFIGS)
@option("--refraction", Refraction, "Snell's law.", show_default=CONFIGS)
@option("--sampling", Sampling, "Integrals or rays.", show_default=CONFIGS)
@option("--dry-run", bool, "Check everything and estimate time and memory; write nothing.")
@options.output_option("Weights file to write (.h5).")
@options.common_options
@options.calls("build_weights.build_weights_file", "BuildWeightsOptions", "config", "output")
def build_weights() -> None:
    """Calculate how every voxel lights every pixel: its point-spread function behind main lens and microlenses.

    \b
    Example: lfpiv build-weights rig.yaml --calibration calibration.h5 -o weights.h5
             lfpiv build-weights rig.yaml --calibration calibration.h5 -o weights.h5 --dry-run
    """


@command("calibrate-snapshot")
@options.config_argument
@options.white_option
@options.dark_option
@options.board_option
@options.depth_option
@options.output_option("Calibration file to write (.h5).")
@option("--picture", FILE, "Picture of the fitted lattice and board to write (.png).")
@option("--views", FILE, "Picture of views and refocused depths to write (.png).")
@options.common_options
@options.raw_option
@options.calls("calibrate.calibrate_snapshot", "CalibrateOptions", "config", "output")
def calibrate_snapshot() -> None:
    """Find microlenses and focal plane from a white image and one snapshot of a calibration target.

    \b
    Example: lfpiv calibrate-snapshot rig.yaml --white white.tif --dark dark.tif --board board.tif \\
                 -o calibration.h5 --picture calibration.png
    for `build-weights --method dlfc`, with targets at several depths in the fluid:
             lfpiv calibrate-snapshot rig.yaml --white white.tif --board b1.tif --depth-mm -8 \\
                 --board b2.tif --depth-mm 0 --board b3.tif --depth-mm 8 -o calibration.h5
    without a target, with a camera known to be focused on the channel's mid plane:
             lfpiv calibrate-snapshot rig.yaml --white white.tif --depth-mm 0 -o calibration.h5
    """


@command("refine-calibration")
@options.config_argument
@click.argument("images", type=FILE, nargs=-1, required=True)
@option("--calibration", FILE, "From calibrate-snapshot.", required=True)
@options.dark_option
@option("--background", FILE, "Image without tracers to subtract, in place of the dark one.")
@options.output_option("Corrected calibration to write (.h5); without it, only report.", required=False)
@option("--picture", FILE, "Picture of the particles and the walls they end at to write (.png).")
@options.common_options
@options.raw_option
@options.calls("refine.refine_calibration", "RefineOptions", "config", "images", "calibration")
def refine_calibration() -> None:
    """Correct a calibration by the tracers of a flow: volume self-calibration.

    The particles end at the channel's walls, which gives the mid plane, and their images say how far the lens images
    have moved since the white image. Behind the curved faces of a scene they tell where the pipe's axis lies and how it
    is tilted; build-weights moves the scene so.

    \b
    Example: lfpiv refine-calibration rig.yaml a.tif b.tif --calibration calibration.h5 --dark dark.tif \\
                 -o refined.h5 --picture walls.png
    """


RIG = Path("rig.yaml")
# What a length may be answered in.
UNITS_MM = {"m": 1e3, "cm": 10.0, "mm": 1.0, "nm": 1e-6, "um": 1e-3, "µm": 1e-3, "μm": 1e-3}
Answer = TypeVar("Answer")


@command("init")
@click.argument("config", type=FILE, required=False)
@click.option("-o", "--output", type=FILE, help="File to write, in place of CONFIG; default rig.yaml.")
@option("--camera", KnownCamera, "A published camera, nothing is asked.")
@option("--from", FILE, "A calibration (.h5), whose configuration is written again.", "calibration")
@option("--schema", bool, "Write the JSON schema of rig files instead, for editors.")
@options.common_options
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

    An answer of nothing takes the default in brackets; defaults follow from the answers before. Lengths may have a
    unit, as 10.5 cm or 5.5 um. The file can be simulated and run as it is. It names the schema where rig.schema.json
    lies beside it.

    \b
    Example: lfpiv init rig.yaml
             lfpiv init --camera table2 -o table2.yaml
             lfpiv init --from calibration.h5 -o again.yaml
             lfpiv init --schema -o rig.schema.json
    """
    from lfpiv_cli.files.atomic import ensure_writable
    from lfpiv_cli.verbs import init as stage

    if config is not None and output is not None:
        raise UsageError(f"init writes one file, and {config} and -o {output} were given")
    if schema:
        return stage.write_schema(output or config or Path(stage.SCHEMA_NAME), overwrite=overwrite)
    target = output or config or RIG
    ensure_writable(target, overwrite)
    if not chosen:
        try:
            chosen["numbers"] = _asked()
        except click.Abort as error:
            if sys.stdin.isatty():
                raise
            raise UsageError("the answers end before all is asked; --camera and --from ask nothing") from error
    return stage.init(target, stage.InitOptions(**chosen), overwrite=overwrite, console=console)


@command("check")
@options.config_argument
@click.argument("images", type=FILE, nargs=-1)
@option("--white", FILE, "White image, which tells where the lens images lie.")
@options.dark_option
@option("--calibration", FILE, "From calibrate-snapshot, in place of the data sheet.")
@option("--velocity-m-s", POSITIVE, "Velocity to expect; default that of the configured flow.")
@option("--picture", FILE, "Picture of errors and field of view by depth to write (.png).")
@options.common_options
@options.raw_option
@options.calls("check.check", "CheckOptions", "config", "images")
def check() -> None:
    """Tell what a rig and its images are good for, in seconds, before any work.

    Each line has its verdict: good; look, worth a look; no, it cannot work so; or unknown, where nobody can tell. The
    verdict on the whole is the worst of them. Errors are the smallest that the light allows. The exit code is 0
    whatever the verdict, which --json has as `verdict`.

    \b
    Example: lfpiv check rig.yaml --velocity-m-s 0.2 --picture rig.png
             lfpiv check rig.yaml a.tif b.tif --white white.tif --dark dark.tif
             lfpiv check rig.yaml a.tif b.tif --calibration calibration.h5 --dark dark.tif
    """


def _asked() -> RigNumbers:
    """Ask for the numbers of a rig; each default follows from the answers before it."""
    from lfpiv_cli.verbs.init import RigNumbers

    plain = RigNumbers()
    answers: dict[str, Any] = {
        "magnification": _asked_for(
            "magnification, image over object, negative because the image is inverted", plain.magnification, _inverted
        ),
        "focal_length_mm": _length("focal length of the main lens, mm", plain.focal_length_mm),
        "pitch_mm": (pitch := _length("pitch of the microlenses, mm", plain.pitch_mm)),
    }
    guess = RigNumbers(**answers).complete()
    focal = _asked_for(
        "focal length of the microlenses, mm, or their f-number as f/8",
        f"{guess.microlens_focal_length_mm:g}",
        _length_or_f_number,
    )
    answers["microlens_focal_length_mm"] = focal[0] or focal[1] * pitch
    guess = RigNumbers(**answers).complete()
    text = "f-number of the main lens as f/4, or its aperture, mm"
    aperture = _asked_for(text, f"f/{guess.f_number:g}", _length_or_f_number)
    answers["f_number"] = aperture[1] or answers["focal_length_mm"] / aperture[0]
    answers |= {
        "pixel_um": _length("size of the pixels, um", plain.pixel_um, "um"),
        "columns": click.prompt("columns of the images", plain.columns, type=click.IntRange(min=1), err=True),
        "rows": click.prompt("rows of the images", plain.rows, type=click.IntRange(min=1), err=True),
        "fluid": (fluid := _asked_for("refractive index of the fluid", plain.fluid, _index)),
    }
    if fluid != 1.0:
        answers["wall"] = _asked_for("refractive index of the wall or window", plain.wall, _index)
        answers["wall_mm"] = _length("its thickness, mm", plain.wall_mm, may_be_0=True)
        text = "inner width of the channel along the optical axis, mm, 0 without one"
        answers["channel_mm"] = _length(text, 0.0, may_be_0=True) or None
    guess = RigNumbers(**answers).complete()
    sides = " ".join(f"{side:g}" for side in guess.size_mm or (1.0, 1.0, 1.0))
    answers["size_mm"] = _asked_for("size of the volume, mm", sides, _sides)
    answers["velocity_m_s"] = _asked_for(
        "velocity to expect, m/s", plain.velocity_m_s, lambda answer: _in_unit(answer.removesuffix("/s"), "m")
    )
    text = "wavelength of the light, nm, 0 for rays, with which no camera's images agree"
    answers["wavelength_nm"] = _length(text, 532.0, "nm", may_be_0=True) or None
    return RigNumbers(**answers)


def _asked_for(text: str, default: float | str, parse: Callable[[str], Answer]) -> Answer:
    """Ask for what a function makes of an answer; where it raises click asks again."""
    shown = default if isinstance(default, str) else f"{default:g}"
    return click.prompt(text, shown, value_proc=lambda answer: parse(answer.strip()), err=True)


def _index(answer: str) -> float:
    """Return a refractive index, which config files have from 1 to 5."""
    value = _above_zero(answer)
    if not 1.0 <= value <= 5.0:
        raise click.UsageError(f"{answer}: expected a refractive index, from 1 to 5")
    return value


def _length(text: str, default: float, unit: str = "mm", may_be_0: bool = False) -> float:
    """Ask for a length."""
    return _asked_for(
        text, default, lambda answer: 0.0 if may_be_0 and _split_unit(answer)[0] == "0" else _in_unit(answer, unit)
    )


def _inverted(answer: str) -> float:
    """Return a magnification; images are inverted, whether the answer has its minus or not, and that is said."""
    value = -_above_zero(answer.removeprefix("-"))
    if not answer.startswith("-"):
        click.echo(f"magnification: taken as {value:g}, because the image is inverted", err=True)
    return value


def _length_or_f_number(answer: str) -> tuple[float, float]:
    """Return a length or an f-number; the other one of the two is 0."""
    word = answer.lower()
    return (0.0, _above_zero(word.removeprefix("f/"))) if word.startswith("f/") else (_in_unit(word, "mm"), 0.0)


def _sides(answer: str) -> tuple[float, float, float]:
    """Return three lengths; a unit behind the last one alone is that of all."""
    apart = re.sub(r"[,x×]", " ", answer)
    words = re.sub(rf"\s+(?=({'|'.join(UNITS_MM)})\b)", "", apart).split()
    units = [_split_unit(word)[1] for word in words]
    if len(words) == 3 and not any(units[:2]):
        words = [f"{_split_unit(word)[0]}{units[2]}" for word in words]
    if len(words) != 3:
        raise click.UsageError(f"{answer}: expected three lengths, x y z")
    x, y, z = (_in_unit(word, "mm") for word in words)
    return x, y, z


def _split_unit(word: str) -> tuple[str, str]:
    """Return the number of an answer, and the unit of length behind it, or nothing."""
    found = re.fullmatch(rf"(.*?)\s*({'|'.join(UNITS_MM)})?", word, re.DOTALL)
    return (word, "") if found is None else (found[1], found[2] or "")


def _in_unit(answer: str, unit: str) -> float:
    """Return a length in a unit, which the answer is in where it names no other one.

    Raises
    ------
    UsageError : it says none above 0
    """
    number, named = _split_unit(answer)
    value = _above_zero(number)
    # Not 0.0055 mm as 5.499999999999999 um.
    return value if named in ("", unit) else float(f"{value * UNITS_MM[named] / UNITS_MM[unit]:.12g}")


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
