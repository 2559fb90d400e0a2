"""`init`: a configuration to begin with, or the JSON schema that editors check one by.

A few numbers make a rig. What nobody has an opinion on at first follows from the rest, so that the file can be
simulated and run as it is: the volume from the field of view, the board and the windows from the microlenses, the
tracers and the time between the images from both.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from lfpiv_cli.console import CONSOLE, Console
from lfpiv_cli.errors import ConfigError, UsageError
from lfpiv_cli.files import atomic, calibration_file, hdf5
from lfpiv_cli.files.config import Config, carried_config
from lfpiv_cli.files.sections import LATERAL_VOXELS_PER_MICROLENS, UM_TO_MM
from lfpiv_cli.files.sections_work import CorrelationSection, Sections
from lfpiv_cli.names import KnownCamera
from lfpiv_cli.notice import written
from lfpiv_cli.optics.camera import Camera, Lattice
from lfpiv_cli.optics.line_responses import USUAL_DIFFUSION_PX
from lfpiv_cli.optics.media import Media, Window, channel_window
from lfpiv_cli.optics.tracing import LARGEST_ERROR_PX, refraction_error_mm
from lfpiv_cli.validation import planning
from lfpiv_cli.validation.planning import half_view_mm
from lfpiv_cli.verbs.planning import bench_of, windows_line

# A configuration as text: a short YAML file with a comment on each key that a newcomer meets, and its JSON schema.

Tree = Mapping[str, Any]

DIALECT = "https://json-schema.org/draft/2020-12/schema"
# Editors with the YAML language server (VS Code, Neovim, Emacs) read which schema a file follows from this line.
SCHEMA_LINE = "# yaml-language-server: $schema={}"
HEADING = """# {}
# Lengths are in the unit that a name ends in, lists are [x, y] or [x, y, z]. See also: lfpiv check."""
# Comments begin in this column, where the line leaves room.
COMMENT_COLUMN = 36
# What is said of a section or a key, by its path.
COMMENTS = {
    "camera.main_lens.magnification": "negative: the image is inverted",
    "camera.main_lens.focal_length_mm": "F_m",
    "camera.main_lens.aperture_mm": "diameter of the entrance pupil; or f_number in its place",
    "camera.main_lens.f_number": "focal length over aperture, as engraved; or aperture_mm in its place",
    "camera.microlenses.focal_length_mm": "or f_number, focal length over pitch",
    "camera.microlenses.f_number": "focal length over pitch",
    "camera.microlenses.pitch_mm": "from lens to lens",
    "camera.microlenses.layout": "or hexagonal; without it as the white image shows",
    "camera.sensor.pixel_um": "binned pixels are as large as they are together",
    "camera.sensor.columns": "of the images",
    "camera.sensor.diffusion_px": "of charge, a standard deviation; only what is simulated has it",
    "camera.sensor.column_axis": "world axis that the image's columns follow",
    "media": "refractive indices",
    "media.window": "acrylic 1.49, glass 1.46 to 1.52",
    "media.fluid": "water 1.33",
    "window": "the wall between camera and fluid, where there is no channel",
    "window.distance_mm": "from the main lens",
    "channel": "along the optical axis",
    "channel.width_mm": "from wall to wall, inside",
    "channel.wall_mm": "thickness of the wall on the camera's side",
    "volume.size_mm": "the program chooses the voxels",
    "volume.reference": "origin: focal_point, or mid_plane of the channel, which a calibration finds",
    "weights.refraction": "by Snell's law: paraxial rays would be off by more than half a pixel",
    "board": "calibration target",
    "board.dots": "along x and y",
    "board.medium": "air, on the channel's outer wall; or fluid",
    "reconstruction.wavelength_nm": "of the light, which lenses diffract: tracers are fitted by waves",
    "correlation.window_mm": "final interrogation window",
    "correlation.dt_s": "time between the two images of a pair",
    "simulation": "for `lfpiv simulate` and `lfpiv validate` alone",
    "simulation.particles": "tracers in the volume",
    "simulation.light": "a tracer takes 0.1 s of a core in each image",
}


def rig_text(tree: Tree, title: str, schema: str | None = None) -> str:
    """Return a configuration as YAML.

    Parameters
    ----------
    tree : sections by name, plain data
    title : first comment
    schema : file name of the JSON schema beside it
    """
    lines = [] if schema is None else [SCHEMA_LINE.format(schema)]
    lines += HEADING.format(title).splitlines()
    for name, section in tree.items():
        lines += ["", *_lines(name, section, name, 0)]
    return "\n".join(lines) + "\n"


def schema() -> dict[str, Any]:
    """Return the JSON schema of a configuration, as it is written."""
    made = Sections.model_json_schema(mode="validation")
    return {"$schema": DIALECT} | made | {"title": "Configuration of lfpiv"}


def _lines(name: str, value: Any, path: str, depth: int) -> Iterator[str]:
    """Yield a key and what stands below it; a mapping with a `kind` stays on one line."""
    nested = isinstance(value, Mapping) and "kind" not in value
    line = "  " * depth + (f"{name}:" if nested else f"{name}: {_flow(value)}")
    comment = COMMENTS.get(path)
    yield line if comment is None else f"{line:<{COMMENT_COLUMN - 2}}  # {comment}"
    if nested:
        for key, below in value.items():
            yield from _lines(key, below, f"{path}.{key}", depth + 1)


def _flow(value: Any) -> str:
    """Return plain data on one line of YAML."""
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{key}: {_flow(each)}" for key, each in value.items()) + "}"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(map(_flow, value)) + "]"
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    return repr(value) if isinstance(value, float) else str(value)


Sides = tuple[float, float, float]

# Of the depths over which light spreads by one lens a volume has ten, as the paper's channel; less where points cannot
# be refocused as far, or the focal plane lies within five times as much of the lens.
DEPTHS_IN_VOLUME, SHARE_OF_DISTANCE = 10.0, 0.2
# Of the full field of view a volume takes so much, and a board.
SHARE_OF_VIEW, BOARD_SHARE = 0.98, 0.8
# Dots three microlenses wide and five times that apart are found and placed best; five by four of them are enough. A
# small sensor needs smaller ones, nearer to each other, as the sample's.
DOT_LENSES, DOTS_APART, FEWEST_DOTS, MOST_DOTS = 3.0, 5.0, 4, 7
LEAST_DOT_LENSES, LEAST_APART = 1.5, 3.0
# What lies between window and volume where nobody says: a share of the volume's depth.
BEHIND_WINDOW = 0.1
# Lengths that nobody measured are written with so many digits.
DIGITS = 3


@dataclass(frozen=True, kw_only=True)
class RigNumbers:
    """A rig in a few numbers; what is None follows from the others.

    Attributes
    ----------
    magnification : negative
    focal_length_mm, f_number : of the main lens, f_number as engraved
    pitch_mm, microlens_focal_length_mm : of the microlens array
    pixel_um, columns, rows : of the sensor
    fluid, wall : refractive indices
    wall_mm : thickness of the wall or window
    channel_mm : inner width of the channel along the optical axis; None where there is none
    size_mm : of the volume
    velocity_m_s : expected
    wavelength_nm : of the light, which lenses diffract; None: all is by rays
    """

    magnification: float = -1.0
    focal_length_mm: float = 100.0
    f_number: float | None = None
    pitch_mm: float = 0.1
    microlens_focal_length_mm: float | None = None
    pixel_um: float = 5.5
    columns: int = 2352
    rows: int = 1768
    fluid: float = 1.33
    wall: float = 1.49
    wall_mm: float = 2.0
    channel_mm: float | None = None
    size_mm: Sides | None = None
    velocity_m_s: float = 0.1
    wavelength_nm: float | None = None

    def complete(self) -> RigNumbers:
        """Return the numbers with what follows from others filled in.

        A volume is in full view: as deep as the channel, else as depths are told best.

        Raises
        ------
        ConfigError : the sensor sees no such volume
        """
        microlens = self.microlens_focal_length_mm or 8.0 * self.pitch_mm
        # with this F_m / p_m lens images just touch: the main lens's cone is that of the microlenses
        f_number = self.f_number or _rounded(microlens / self.pitch_mm / (1.0 - self.magnification))
        filled = replace(self, microlens_focal_length_mm=microlens, f_number=f_number)
        if self.size_mm is not None:
            return filled
        camera, media = filled.camera(), filled.media()
        depth = self.channel_mm or min(
            DEPTHS_IN_VOLUME * camera.scale(media).depth_mm,
            2.0 * planning.depth_of_field_mm(camera, media),
            SHARE_OF_DISTANCE * camera.focus_distance_mm * self.fluid,
        )
        half = half_view_mm(camera, media, [-0.5 * depth, 0.5 * depth]).min(axis=0)
        if half.min() <= 0.0:
            raise ConfigError(
                f"the sensor ({self.columns} x {self.rows} pixels of {self.pixel_um:g} um) sees no point of a volume "
                f"{written(depth)} mm deep with all of its light; check pixels, pitch, f-numbers and the channel's "
                "width"
            )
        sides = []
        for side in (2.0 * SHARE_OF_VIEW * float(each) for each in half):  # rounded down, to stay in view
            step = 10.0 ** (math.floor(math.log10(side)) - DIGITS + 2)
            sides.append(float(f"{math.floor(side / step) * step:.{DIGITS}g}"))
        return replace(filled, size_mm=(sides[0], sides[1], depth if self.channel_mm else _rounded(depth)))

    def camera(self) -> Camera:
        """Return the camera of numbers that are complete but for the volume."""
        if self.f_number is None or self.microlens_focal_length_mm is None:
            raise ValueError("the numbers are not complete")
        return Camera(
            self.magnification,
            self.focal_length_mm,
            self.focal_length_mm / self.f_number,
            self.microlens_focal_length_mm,
            self.microlens_focal_length_mm,
            Lattice.regular(self.pitch_mm),
            self.pixel_um * UM_TO_MM,
            self.columns,
            self.rows,
        )

    def media(self) -> Media:
        """Return the refractive indices."""
        return Media(1.0, self.wall, self.fluid)


def tree_of(numbers: RigNumbers) -> dict[str, Any]:
    """Return the configuration, as plain data."""
    known = numbers.complete()
    size, has_channel = known.size_mm, known.channel_mm is not None
    if size is None:
        raise ValueError("the numbers are not complete")
    camera, media = known.camera(), known.media()
    scale = camera.scale(media)
    overlap = CorrelationSection().overlap
    window_mm = [float(side) for side in planning.proposed_window_mm(camera, media, size, overlap)]
    tree: dict[str, Any] = {
        "camera": {
            "main_lens": {
                "magnification": known.magnification,
                "focal_length_mm": known.focal_length_mm,
                "f_number": known.f_number,
            },
            "microlenses": {"focal_length_mm": known.microlens_focal_length_mm, "pitch_mm": known.pitch_mm},
            "sensor": {"pixel_um": known.pixel_um, "columns": known.columns, "rows": known.rows, "column_axis": "x"},
        },
        "media": {"air": 1.0, "window": known.wall, "fluid": known.fluid},
    }
    if has_channel:
        tree["channel"] = {"width_mm": known.channel_mm, "wall_mm": known.wall_mm}
    elif known.fluid != media.air:
        tree["window"] = {"distance_mm": _window_distance_mm(known, size[2]), "thickness_mm": known.wall_mm}
    tree["volume"] = {"size_mm": list(size), "reference": "mid_plane" if has_channel else "focal_point"}
    if media != media.in_air():
        if known.channel_mm is not None:
            window = channel_window(camera.focus_distance_mm, media, known.channel_mm, known.wall_mm, 0.0)
        else:
            window = Window(_window_distance_mm(known, size[2]), known.wall_mm)
        depths = np.linspace(-0.5 * size[2], 0.5 * size[2], 9)
        # Where Snell's law moves the light of the volume by more than paraxial refraction may be off.
        if refraction_error_mm(camera, media, window, depths) > LARGEST_ERROR_PX * camera.pixel_mm:
            tree["weights"] = {"refraction": "exact"}
    tree["board"] = _board(known, scale.lens_mm)
    if known.wavelength_nm is not None:
        tree["reconstruction"] = {"wavelength_nm": known.wavelength_nm}
    voxel_mm = scale.lens_mm / LATERAL_VOXELS_PER_MICROLENS
    tree["correlation"] = {"window_mm": window_mm, "dt_s": _rounded(planning.time_step_s(known.velocity_m_s, voxel_mm))}
    tree["simulation"] = {
        "flow": {
            "kind": "shear",
            "along": "x",
            "across": "z",
            "rate_per_s": _rounded(1e3 * known.velocity_m_s / size[2]),
            "velocity_m_s": [known.velocity_m_s, 0.0, 0.0],
        },
        "particles": round(planning.tracers_in(camera, planning.BEST_PER_LENS, size)),
    }
    if known.wavelength_nm is not None:
        tree["camera"]["sensor"]["diffusion_px"] = USUAL_DIFFUSION_PX
        tree["simulation"]["light"] = {"kind": "waves", "wavelength_nm": known.wavelength_nm}
    return tree


def _window_distance_mm(numbers: RigNumbers, depth_mm: float) -> float:
    """Return d1 that leaves some fluid between the wall and the volume."""
    media, path = numbers.media(), (0.5 + BEHIND_WINDOW) * depth_mm
    before = path * media.depth_ratio + numbers.wall_mm * media.air / media.window
    return _rounded(numbers.camera().focus_distance_mm - before)


def _board(numbers: RigNumbers, lens_mm: float) -> dict[str, Any]:
    """Return a board of dots that suits the microlenses and is in view."""
    view = 2.0 * BOARD_SHARE * half_view_mm(numbers.camera(), numbers.media(), [0.0])[0]
    spacing = min(DOT_LENSES * DOTS_APART * lens_mm, float(view.min()) / FEWEST_DOTS)
    dot = max(min(DOT_LENSES * lens_mm, spacing / DOTS_APART), min(LEAST_DOT_LENSES * lens_mm, spacing / LEAST_APART))
    spacing, dot = _rounded(spacing), _rounded(dot)
    dots = [int(min((side - dot) // spacing + 1, MOST_DOTS)) for side in view]
    medium = "air" if numbers.channel_mm is not None else "fluid"
    return {"dots": dots, "spacing_mm": spacing, "dot_diameter_mm": dot, "medium": medium}


def _rounded(value: float) -> float:
    """Return a number of a few digits."""
    return float(f"{value:.{DIGITS}g}")


# Table 2 of the paper.
TABLE2 = RigNumbers(f_number=4.0, microlens_focal_length_mm=0.8, size_mm=(8.0, 8.0, 24.0))
# Microscopes of napari-LF's examples.
LATTICES: dict[str, dict[str, Any]] = {
    "guv": {
        "microlenses": {"pitch_mm": 0.1, "layout": "square"},
        "sensor": {"pixel_um": 6.5, "columns": 436, "rows": 436},
    },
    "seaurchin": {
        "microlenses": {"pitch_mm": 0.125, "layout": "square"},
        "sensor": {"pixel_um": 7.4, "columns": 2048, "rows": 2048},
    },
}


SCHEMA_NAME = "rig.schema.json"


@dataclass(frozen=True, kw_only=True)
class InitOptions:
    """Where a configuration comes from, one of three.

    Attributes
    ----------
    numbers : of one's own rig
    camera : a published one
    calibration : a file of `calibrate_snapshot`, which carries the configuration it was made with
    """

    numbers: RigNumbers | None = None
    camera: KnownCamera | None = None
    calibration: Path | None = None


def init(output: Path, options: InitOptions, *, overwrite: bool = False, console: Console = CONSOLE) -> dict[str, Any]:
    """Write a configuration, once it has been found to be without contradictions."""
    inputs = [] if options.calibration is None else [options.calibration]
    atomic.ensure_writable(output, overwrite, inputs)
    given = [each for each in (options.numbers, options.camera, options.calibration) if each is not None]
    if len(given) != 1:
        raise UsageError(f"a configuration is from numbers, a camera or a calibration; {len(given)} of them were given")
    tree: Mapping[str, Any]
    if options.calibration is not None:
        _, made = hdf5.read_tree(options.calibration, calibration_file.FORMAT, calibration_file.VERSION)
        sections = carried_config(made, options.calibration).sections
        title = f"The rig that {options.calibration.name} was made with, by `lfpiv init`."
        tree = sections.model_dump(mode="json", exclude_defaults=True)
    elif options.camera is not None:
        title = f"The camera {options.camera}, by `lfpiv init`."
        tree = tree_of(TABLE2) if options.camera == "table2" else {"camera": LATTICES[options.camera]}
    elif options.numbers is not None:
        title, tree = "A rig, by `lfpiv init`.", tree_of(options.numbers)
    settings = Config.from_resolved(tree, "the numbers given")
    beside = SCHEMA_NAME if (output.parent / SCHEMA_NAME).exists() else None
    atomic.write_text(output, rig_text(tree, title, beside), overwrite)
    if options.numbers is not None and (windows := windows_line(bench_of(settings, None))).verdict != "good":
        console.say(f"windows: {windows.reason}")
    console.say(f"next: lfpiv check {output}")
    return {"config": output.name, "sections": list(tree)} | ({"schema": beside} if beside else {})


def write_schema(output: Path, *, overwrite: bool = False) -> dict[str, Any]:
    """Write the JSON schema of configurations."""
    atomic.ensure_writable(output, overwrite)
    content = schema()
    atomic.write_text(output, json.dumps(content, indent=2) + "\n", overwrite)
    return {"schema": output.name, "sections": list(content["properties"])}
