"""Every kind of file that commands write, in every place where a command takes a file: taken, or refused in a sentence.

A new command, or a new place for a file in one, is a line in `PLACES`; a new kind of file is one in `KINDS`, beside
what writes it; a new format of exports is one in `READERS`.
"""

import os
import re
import shutil
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory

import click
import h5py
import pytest

from lfpiv_cli.cli.main import COMMANDS
from lfpiv_cli.cli.options import FILE
from lfpiv_cli.files.export_formats import read_content
from lfpiv_cli.names import ExportFormat, names_in
from lfpiv_cli.verbs.export import FORMATS
from tests.commands import ROOT, ended, make_no_file
from tests.written_files import KINDS, READERS, WrittenFiles, by_hdf5

RIGS = {"rig", "rig by init"}
IMAGES = {"white image", "dark image", "board image", "frame", "residual image"}
CALIBRATIONS = {"calibration", "fitted rays", "refined calibration"}
WEIGHTS = {"weights", "weights without calibration", "weights on demand", "counted weights", "weights in strips"}
VECTORS = {
    *("vectors", "mean vectors", "statistics", "tracks on a grid", "combined vectors", "field", "field with pressure")
}
PARTICLES = {"particles", "followed particles"}
SEQUENCES = {"tracks of a sequence", "followed tracks"}
TRACKS = {"tracks", *SEQUENCES}
OF_FORMATS = {
    "lfpiv-calibration": CALIBRATIONS,
    "lfpiv-weights": WEIGHTS,
    "lfpiv-volume": {"volume"},
    "lfpiv-vectors": VECTORS,
    "lfpiv-particles": PARTICLES,
    "lfpiv-tracks": {"tracks"},
    "lfpiv-trajectories": SEQUENCES,
    "lfpiv-playback": {"playback"},
    "lfpiv-series": {"series"},
}
RESULTS = {"volume", *VECTORS, *PARTICLES, *TRACKS}
DRAWN = RESULTS | CALIBRATIONS | WEIGHTS

# What is no file; a folder is one to places that take files by the thousand, but holds none.
NO_FILES = ("missing", "too long a name", "empty", "folder", *(["pipe"] if hasattr(os, "mkfifo") else []))


@dataclass(frozen=True)
class Place:
    """A place for a file in a command.

    Attributes
    ----------
    words : the command, `{}` where the file stands, `{out}` an empty folder, other braces names of written files
    takes : the kinds that it takes
    may : kinds of which the command finds out whether they serve: another picture than it asks for
    refusal : exit code for all others
    in_folder : the command takes a folder, here one with the file alone in it
    """

    words: str
    takes: set[str]
    may: set[str] = field(default_factory=set)
    refusal: int = 4
    in_folder: bool = False


def rig(words: str) -> Place:
    """Return the place of a rig file, which is refused as such."""
    return Place(words, RIGS, refusal=3)


def image(words: str, kind: str) -> Place:
    """Return the place of an image of a kind; what others show, a command finds out."""
    return Place(words, {kind}, IMAGES - {kind})


RUN = "run {rig} {first frame} {frame} --white {white image} --method volumes --no-report -o {out}/run "
CALIBRATE = "calibrate-snapshot {rig} --white {white image} -o {out}/c.h5 "
REFINE = "refine-calibration {rig} {first frame} {frame} --calibration {calibration} -o {out}/c.h5 "
RECONSTRUCT = "reconstruct {weights} {frame} --iterations 1 -o {out}/v.vtkhdf "
FOLLOW = "follow {weights} {first frame} {frame} {third frame} --shortest 3 -o {out}/followed "
PLACES = {
    "init --from": Place("init --from {} -o {out}/rig.yaml", CALIBRATIONS),
    "check CONFIG": rig("check {}"),
    "check IMAGES": image("check {rig} {}", "frame"),
    "check --white": image("check {rig} --white {}", "white image"),
    "check --dark": image("check {rig} {frame} --dark {}", "dark image"),
    "check --calibration": Place("check {rig} --calibration {}", CALIBRATIONS),
    "run CONFIG": rig(RUN.replace("{rig}", "{}") + "--board {board image}"),
    "run IMAGES": image(RUN.replace("{frame}", "{}") + "--board {board image}", "frame"),
    "run --images": image(RUN.replace("{frame}", "--images {}") + "--board {board image}", "frame"),
    "run --white": image(RUN.replace("{white image}", "{}") + "--board {board image}", "white image"),
    "run --dark": image(RUN + "--board {board image} --dark {}", "dark image"),
    "run --board": image(RUN + "--board {}", "board image"),
    "run --background": image(RUN + "--board {board image} --background {}", "dark image"),
    "run --mask": image(RUN + "--board {board image} --mask {}", "white image"),
    "calibrate-snapshot CONFIG": rig(CALIBRATE.replace("{rig}", "{}")),
    "calibrate-snapshot --white": image(CALIBRATE.replace("{white image}", "{}"), "white image"),
    "calibrate-snapshot --dark": image(CALIBRATE + "--dark {}", "dark image"),
    "calibrate-snapshot --board": image(CALIBRATE + "--board {}", "board image"),
    "refine-calibration CONFIG": rig(REFINE.replace("{rig}", "{}")),
    "refine-calibration IMAGES": image(REFINE.replace("{frame}", "{}"), "frame"),
    # Boards in the fluid alone do not say where the mid plane lies, about which the walls are looked for.
    "refine-calibration --calibration": Place(
        REFINE.replace("{calibration}", "{}"), CALIBRATIONS - {"fitted rays"}, {"fitted rays"}
    ),
    "refine-calibration --dark": image(REFINE + "--dark {}", "dark image"),
    "refine-calibration --background": image(REFINE + "--background {}", "dark image"),
    "build-weights CONFIG": rig("build-weights {} --calibration {calibration} -o {out}/w.h5"),
    "build-weights --calibration": Place("build-weights {plain.yaml} --calibration {} -o {out}/w.h5", CALIBRATIONS),
    "reconstruct WEIGHTS": Place(RECONSTRUCT.replace("{weights}", "{}"), WEIGHTS),
    "reconstruct IMAGES": image(RECONSTRUCT.replace("{frame}", "{}"), "frame"),
    "reconstruct --dark": image(RECONSTRUCT + "--dark {}", "dark image"),
    "reconstruct --background": image(RECONSTRUCT + "--background {}", "dark image"),
    "reconstruct --mask": image(RECONSTRUCT + "--mask {}", "white image"),
    "correlate VOLUMES": Place("correlate {first volume} {} -o {out}/v.vtkhdf", {"volume"}),
    "correlate --config": rig("correlate {first volume} {volume} --config {} -o {out}/v.vtkhdf"),
    "correlate --mask": Place("correlate {first volume} {volume} --mask {} -o {out}/v.vtkhdf", {"volume"}),
    "combine VECTORS_A": Place("combine {} {vectors} -o {out}/v.vtkhdf", VECTORS),
    "combine VECTORS_B": Place("combine {vectors} {} -o {out}/v.vtkhdf", VECTORS),
    "statistics SAMPLES": Place("statistics {} -o {out}/s.vtkhdf", VECTORS | TRACKS),
    "track PARTICLES": Place("track {first particles} {} --grid -o {out}/t.vtkhdf", PARTICLES),
    "field SAMPLES": Place("field {} -o {out}/f.vtkhdf", VECTORS | TRACKS),
    "field --at": Place("field {tracks} --at {} -o {out}/f.vtkhdf", {"points"}),
    "field --pressure": Place("field {tracks of a sequence} --pressure {} -o {out}/f.vtkhdf", set(), in_folder=True),
    # Particles are fitted with traced rays, which these have not.
    "follow WEIGHTS": Place(FOLLOW.replace("{weights}", "{}"), WEIGHTS - {"weights on demand"}),
    "follow FRAMES": image(FOLLOW.replace("{frame}", "{}"), "frame"),
    "follow --dark": image(FOLLOW + "--dark {}", "dark image"),
    "follow --background": image(FOLLOW + "--background {}", "dark image"),
    "follow --mask": image(FOLLOW + "--mask {}", "white image"),
    "info FILE": Place("info {}", DRAWN | IMAGES | {"picture", "playback", "series"}),
    "plot FILE": Place("plot {} -o {out}/p.pdf", DRAWN),
    "plot --raw": image("plot {particles} --raw {} -o {out}/p.pdf", "frame"),
    "report FOLDER": Place("report {} -o {out}/page.html", DRAWN, in_folder=True),
    "report --raw": Place("report {followed/particles} --raw {} -o {out}/page.html", {*IMAGES, "picture"}),
    "validate CONFIG": rig("validate flow {} --vectors {vectors} -o {out}/r"),
    "validate --vectors": Place("validate flow {rig} --vectors {} -o {out}/r", VECTORS),
    "validate --volume": Place(
        "validate volume {rig} --volume {} --particles {truth} --frame middle -o {out}/r", {"volume"}
    ),
    "validate --particles": Place(
        "validate volume {rig} --volume {volume} --particles {} --frame middle -o {out}/r", {"truth"}
    ),
    "simulate CONFIG": rig("simulate white {} -o {out}/s"),
    "--files-from": Place("track --files-from {} -o {out}/t.vtkhdf", set()),
    "--pairs": Place("track {first particles} {particles} --pairs {} -o {out}/t.vtkhdf", set()),
    "--verify": Place("combine {vectors} {vectors} --verify {} -o {out}/v.vtkhdf", set()),
} | {
    f"export --to {to}": Place(
        f"export {{}} --to {to} -o {{out}}/e", set().union(*(OF_FORMATS[name] for name in FORMATS[to].takes))
    )
    for to in names_in(ExportFormat)
}
# Of these options, which many commands have, one command stands for all.
OF_ALL = ("--files-from", "--pairs", "--verify")
# Parameters that name what a command writes.
WRITTEN = {"config of init", "log", "output", "picture", "views", "failures", "cache", "mean"}
# Those that take a path or a word.
OR_WORDS = {"background", "mask"}
# The datasets in VTK's group that are ours.
OF_DATA = re.compile("VTKHDF/(Points|PointData/.*|Steps/Values)$")


def outcome(files: WrittenFiles, place: Place, kind: str) -> str:
    """Return how a command ends that is given a file of a kind: `ok`, `refused` with its exit code, or a fault."""
    with TemporaryDirectory(dir=files.folder) as folder:
        given, out = Path(folder) / "given", Path(folder) / "out"
        given.mkdir()
        out.mkdir()
        path = given / (files.path(kind).name if kind in KINDS else "x" * 300 if "long" in kind else "given")
        if kind in NO_FILES:
            make_no_file(path, kind)
        else:
            shutil.copy(files.path(kind), path)
        before = path.read_bytes() if os.path.isfile(path) else b""
        words = files.words(place.words.replace("{out}", str(out)), given if place.in_folder else path)
        code, said = ended(*words)
        if (path.read_bytes() if os.path.isfile(path) else b"") != before or len(os.listdir(given)) > 1:
            return f"changes its input ({code})"
        if code == 0:
            return "ok"
        if "a bug" in said or "\n" in said.strip():
            return f"ends with {code}: {said}"
        if kind not in place.takes | place.may and (given if place.in_folder else path).name not in said:
            return f"refused {code} without its name: {said}"
        left = [each.name for each in out.rglob("*") if not each.is_dir()]
        if left:
            return f"refused {code}, and leaves {left[0]}"
    return f"refused {code}"


def wanted(place: Place, kind: str) -> set[str]:
    """Return how a command may end."""
    if kind in place.takes:
        return {"ok"}
    if kind in NO_FILES:
        return {"refused 4", *(["ok"] if kind in place.may else [])}
    return {f"refused {place.refusal}", *(["ok"] if kind in place.may else [])}


def faults(files: WrittenFiles, name: str, kinds: Iterable[str] = (*KINDS, *NO_FILES)) -> dict[str, str]:
    """Return how the command of a place ends with kinds of files that it should treat otherwise."""
    found = {kind: outcome(files, PLACES[name], kind) for kind in kinds}
    return {kind: got for kind, got in found.items() if got not in wanted(PLACES[name], kind)}


def test_each_place_for_a_file_has_its_line() -> None:
    places = set()
    for command in COMMANDS:
        for parameter in command.params:
            is_written = parameter.name in WRITTEN or f"{parameter.name} of {command.name}" in WRITTEN
            if is_written or not (parameter.type is FILE or parameter.name in OR_WORDS):
                continue
            is_option = isinstance(parameter, click.Option)
            said = parameter.opts[-1] if is_option else parameter.human_readable_name
            places.add(said if said in OF_ALL else f"{command.name} {said}")
    assert places - {"export FILES"} == {name for name in PLACES if not name.startswith("export ")}


def test_each_format_has_its_kinds_and_its_reader() -> None:
    sources = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "lfpiv_cli").rglob("*.py"))
    assert set(re.findall(r'FORMAT\b[^=\n]*= "(lfpiv-[a-z]+)"', sources)) == set(OF_FORMATS)
    assert set().union(*OF_FORMATS.values()) <= set(KINDS)
    assert set(READERS) == set(FORMATS) == set(names_in(ExportFormat))


@pytest.mark.parametrize("name", ["init --from", "check CONFIG", "info FILE", "export --to csv"])
def test_what_is_made_in_no_time_is_taken_or_refused(tmp_path: Path, name: str) -> None:
    assert not faults(WrittenFiles(tmp_path), name, ["rig", "schema", "weights without calibration", *NO_FILES])


@pytest.mark.thorough
@pytest.mark.parametrize("name", PLACES)
def test_each_kind_is_taken_or_refused_in_a_sentence(files: WrittenFiles, name: str) -> None:
    assert not faults(files, name)


@pytest.mark.thorough
@pytest.mark.parametrize("to", READERS)
def test_what_is_exported_comes_back(files: WrittenFiles, tmp_path: Path, to: ExportFormat) -> None:
    for kind in sorted(PLACES[f"export --to {to}"].takes):
        source = files.path(kind)
        content = read_content(source)
        by_hdf5(source, content)
        paths = [tmp_path / f"{kind} {number}{FORMATS[to].ending}" for number in range(2)]
        for path in paths:
            assert ended("export", source, "--to", to, "-o", path, "-q") == (0, "")
        READERS[to](paths[0], content)
        assert paths[0].read_bytes() == paths[1].read_bytes()


@pytest.mark.thorough
@pytest.mark.parametrize("name", OF_FORMATS)
def test_each_dataset_has_its_unit_and_is_described(files: WrittenFiles, name: str) -> None:
    described = (ROOT / "docs" / "files.md").read_text(encoding="utf-8")
    for kind in sorted(OF_FORMATS[name]):
        with h5py.File(files.path(kind)) as file:
            assert file.attrs["format"].decode() == name
            found = list(datasets_of(file))
        assert found
        assert not [path for path, unit in found if not unit], kind
        words = {path.rsplit("/", 1)[-1] for path, _ in found} - {"Values"}  # of VTK's steps
        assert not [word for word in words if not re.search(rf"`(\w+/)*{word}`", described)], kind


# The sections of docs/files.md that specify a file, beside the first, which is of all.
SPECIFIED = {
    "calibration": (2,),
    "weights": (2, 3),
    "volume": (4,),
    **dict.fromkeys(("vectors", "combined vectors", "tracks on a grid"), (4, 5)),
    "particles": (6,),
    "tracks": (6, 7),
}
# What HDF5 itself keeps beside dimension scales, and the datasets of VTK's cells, are named once for all.
GENERIC = {"CLASS", "NAME", "REFERENCE_LIST", "DIMENSION_LIST", "units", "Attribute"}


@pytest.mark.thorough
@pytest.mark.parametrize("kind", SPECIFIED)
def test_a_file_holds_nothing_that_is_not_specified(files: WrittenFiles, kind: str) -> None:
    page = (ROOT / "docs" / "files.md").read_text(encoding="utf-8")
    parts = {int(part.split(".", 1)[0]): part for part in page.split("\n## ") if part[0].isdigit()}
    text = "\n".join(parts[number] for number in (1, *SPECIFIED[kind]))
    with h5py.File(files.path(kind)) as file:
        objects: list[tuple[str, h5py.Group | h5py.Dataset]] = [("", file)]
        file.visititems(lambda name, item: objects.append((name, item)))
        members = [name for name, item in objects if isinstance(item, h5py.Dataset)]
        members += [f"{name}@{attribute}" for name, item in objects for attribute in item.attrs]
    assert members
    assert not [member for member in members if not is_named(member, text)]


def is_named(member: str, text: str) -> bool:
    """Return whether a page names a member, by its whole path or as one of several that are alike."""
    member = member.removeprefix("calibration/").removeprefix("VTKHDF/PointData/")
    place, _, attribute = member.rpartition("@")
    if attribute in GENERIC and place:
        return f"`{attribute}`" in text
    if member.startswith("VTKHDF/") and "/" in member.removeprefix("VTKHDF/"):
        group, _, name = member.rpartition("/")
        return f"`{group}`" in text and f"`{name}`" in text
    return f"`{member.removeprefix('calibration')}`" in text or f"`{member}`" in text


def datasets_of(file: h5py.File) -> Iterator[tuple[str, str]]:
    """Yield the path and the unit of each dataset but VTK's own tables, which say how its points and cells lie."""
    paths: list[str] = []
    file.visit(paths.append)
    for path in paths:
        if isinstance(file[path], h5py.Dataset) and (OF_DATA.match(path) or not path.startswith("VTKHDF/")):
            yield path, file[path].attrs.get("units", b"").decode()
