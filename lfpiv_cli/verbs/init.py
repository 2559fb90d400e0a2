"""`init`: a configuration to begin with, or the JSON schema that editors check one by."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lfpiv_cli.console import CONSOLE, Console
from lfpiv_cli.errors import UsageError
from lfpiv_cli.files import atomic, calibration_file, hdf5
from lfpiv_cli.files.config import Config, carried_config
from lfpiv_cli.files.rig_numbers import LATTICES, TABLE2, RigNumbers, rig_text, schema, tree_of
from lfpiv_cli.names import KnownCamera
from lfpiv_cli.verbs.planning import bench_of, windows_line

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
