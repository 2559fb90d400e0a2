"""A configuration as text: a short YAML file with a comment on each key that a newcomer meets, and its JSON schema."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from lfpiv_cli.files.sections import Sections

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
