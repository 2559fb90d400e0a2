"""The documents: each command in them is understood, and (slow) run on the sample; what they name exists.

Each page runs in a folder of its own that holds the sample under the names that pages use (`rig.yaml`, `a.tif`, ...),
and what the chain makes of it, so that a page can begin anywhere. Small configs stand in for those of the paper's size.
"""

import contextlib
import csv
import glob
import itertools
import re
import runpy
import shlex
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import click
import imagecodecs
import numpy as np
import pytest
import tifffile
from click.testing import CliRunner

import lfpiv_cli
from benchmarks.__main__ import BENCHMARKS
from lfpiv_cli.cli.main import cli
from lfpiv_cli.errors import LimitMissedError
from lfpiv_cli.files import calibration_file, particle_file, vtkhdf, weights_file
from lfpiv_cli.files.export_vtk import PLAYBACK_FORMAT, PLAYBACK_VERSION, SERIES_FORMAT, SERIES_VERSION
from lfpiv_cli.files.particle_file import PARTICLES_FORMAT, TRACKS_FORMAT, TRAJECTORIES_FORMAT, read_points
from lfpiv_cli.files.vtkhdf import VECTORS_FORMAT, VOLUME_FORMAT
from tests import camera_files
from tests.commands import ROOT, SAMPLE, changed

PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
MAKEFILE = (ROOT / "Makefile").read_text()

# Of the sample's config.
DT_S = 0.002

CODE_LINE = re.compile(r"^    (?=\S)(.*)$", re.MULTILINE)
INLINE = re.compile(r"`((?:lfpiv|make|python -m benchmarks)(?: [^`]*)?)`")


def commands_of(page: Path) -> list[str]:
    """Return what a page tells to type: lines of indented code, and inline code that is more than a command's name."""
    text = page.read_text(encoding="utf-8")
    found = [match.group(1) for match in CODE_LINE.finditer(text)]
    # `lfpiv info` alone speaks of the command
    found += [command for command in INLINE.findall(text) if len(command.split()) > 2 or command.startswith("make")]
    return [command.split("#")[0].strip() for command in found]


def commands_that_begin_with(program: str) -> Iterator[tuple[Path, str]]:
    """Yield the pages and their commands that begin with a program's name."""
    for page in PAGES:
        for command in commands_of(page):
            if command == program or command.startswith(f"{program} "):
                yield page, command


LFPIV = list(commands_that_begin_with("lfpiv"))


def test_there_are_commands_to_test() -> None:
    assert len(LFPIV) > 40
    assert {page.name for page, _ in LFPIV} >= {"README.md", "start.md", "your-rig.md", "batches.md"}


@pytest.mark.thorough
@pytest.mark.parametrize("command", sorted({command for _, command in LFPIV}))
def test_every_command_is_understood(command) -> None:
    # As a shell does: what follows a pipe, or a file that is written, is not the command's.
    words = list(itertools.takewhile(lambda word: word not in "|>", shlex.split(command)[1:]))
    before = list(itertools.takewhile(lambda word: word.startswith("-"), words))
    name, *arguments = words[len(before) :]
    found = cli.get_command(cli.make_context("lfpiv", [*before, name]), name)
    assert found is not None
    assert isinstance(found.make_context(name, arguments), click.Context)


@pytest.mark.parametrize("command", sorted({command for _, command in commands_that_begin_with("make")}))
def test_every_make_is_understood(command) -> None:
    _, *words = shlex.split(command)
    targets = [word for word in words if "=" not in word]
    phony = re.search(r"^\.PHONY: (.+)$", MAKEFILE, re.MULTILINE)
    assert phony is not None
    assert set(targets) <= set(phony.group(1).split())
    for variable in (word.split("=")[0] for word in words if "=" in word):
        assert re.search(rf"^{variable} \?=", MAKEFILE, re.MULTILINE), variable


def test_every_benchmark_exists() -> None:
    for _, command in commands_that_begin_with("python -m benchmarks"):
        assert set(command.split()[3:]) - {"NAME"} <= set(BENCHMARKS), command


PLACE = re.compile(r"`((?:lfpiv_cli|tests|configs|benchmarks)/[\w/.-]*)`")
PRIVATE = re.compile(r"told apart|untold|foretold|glance|\bdoubts\b|jumping", re.IGNORECASE)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_and_files_that_are_named_exist_and_words_are_plain(page) -> None:
    text = page.read_text(encoding="utf-8")
    for target in re.findall(r"\]\((?!https?:)([^)#]+)\)", text):
        assert (page.parent / target).exists(), target
    for place in PLACE.findall(text):
        assert (ROOT / place).exists(), place
    assert not PRIVATE.search(text)


def test_architecture_and_glossary_name_parts_of_the_package() -> None:
    parts_of, walks = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8").split("## Walks", 1)
    package = ROOT / "lfpiv_cli"
    parts = {path.stem for path in package.glob("*.py")} | {path.parent.name for path in package.glob("*/__init__.py")}
    assert {part for part in parts if f"`{part}`" not in parts_of} == {"__init__", "__main__"}
    named = set(re.findall(r"`(\w+/[\w/]+)`", walks))
    assert len(named) > 40
    assert {name for name in named if not (package / f"{name}.py").exists()} == set()
    rows = [line.split(" | ") for line in (ROOT / "docs" / "glossary.md").read_text().splitlines() if line[:2] == "| "]
    named = {name for row in rows for name in re.findall(r"`(\w+)`", row[-1])}
    assert len(named) > 10
    assert {name for name in named if not list(package.glob(f"{name}*"))} == set()
    assert len((ROOT / "README.md").read_text().splitlines()) <= 80


def test_equations_name_what_computes_and_what_holds_them() -> None:
    text = (ROOT / "docs" / "equations.md").read_text(encoding="utf-8")
    paper = text.split("## The paper's", 1)[1].split("\n## ", 1)[0]
    numbers = {
        int(number) for row in re.findall(r"^\| ([\d, ]+) \|", paper, re.MULTILINE) for number in row.split(", ")
    }
    assert numbers == set(range(1, 22))
    rows = [line.split(" | ")[-2:] for line in text.splitlines() if line.startswith("| ") and "`" in line]
    for computed, held in rows:
        for folder, cell in (("lfpiv_cli", computed), ("tests", held)):
            named = re.findall(r"`([\w/]+\.py)(?::(\w+))?`", cell)
            assert named, cell
            for file, name in named:
                source = (ROOT / folder / file).read_text(encoding="utf-8")
                assert not name or re.search(rf"^\s*(def|class) {name}\b", source, re.MULTILINE), f"{file}: {name}"


# What a reader who knows the field searches for, and the command whose help has to say it.
TERMS = {
    "particle tracking velocimetry": "track",
    "iterative particle reconstruction": "reconstruct",
    "ghost particles": "reconstruct",
    "volume self-calibration": "refine-calibration",
    "point-spread function": "build-weights",
    "calibration target": "calibrate-snapshot",
    "interrogation windows": "correlate",
    "multi-pass": "correlate",
    "false vectors": "correlate",
    "seeding density": "simulate",
}


def help_of(name: str) -> str:
    """Return a command's whole help on one line."""
    command = cli.get_command(click.Context(cli), name)
    assert command is not None
    return " ".join(command.get_help(click.Context(command, info_name=name)).split())


@pytest.mark.parametrize("term", TERMS)
def test_help_and_documents_use_the_term_of_the_field(term) -> None:
    assert term in help_of(TERMS[term])
    assert any(term in " ".join(page.read_text(encoding="utf-8").split()) for page in PAGES)


@pytest.mark.parametrize("name", cli.list_commands(click.Context(cli)))
def test_help_uses_plain_words(name) -> None:
    assert not PRIVATE.search(help_of(name))


# --- what is longer: the commands themselves


def run(command: str) -> None:
    """Run a command of this program in the current folder, with wildcards as a shell would have them.

    A limit that the small stand-ins miss is no fault of the page.
    """
    arguments = []
    for word in shlex.split(command)[1:]:
        arguments += sorted(glob.glob(word)) or [word] if "*" in word else [word]
    if "--resume" not in arguments:
        arguments.append("--overwrite")
    if arguments[:2] == ["init", "rig.yaml"]:
        # It asks, and Enter takes every default; pages go on with the sample's rig.
        arguments[1] = "asked.yaml"
        assert CliRunner().invoke(cli, arguments, input=20 * "\n").exit_code == 0
        return
    with contextlib.suppress(LimitMissedError):
        cli.main([*arguments, "--quiet"], standalone_mode=False)


def write_images(folder: Path) -> None:
    """Write the sample's images under the names of the pages."""
    for name, source in {"a": "pair_a", "b": "pair_b", "white": "white", "dark": "dark", "board": "board"}.items():
        shutil.copyfile(SAMPLE / f"{source}.tif", folder / f"{name}.tif")
    shutil.copyfile(SAMPLE / "particles.npz", folder / "true.npz")
    (folder / "pairs.txt").write_text("run_0000 run_0001\nrun_0003, run_0002 # the other way round\n")
    pages = [tifffile.imread(folder / f"{name}.tif") for name in "abab"]
    (folder / "images").mkdir()
    for number, name in enumerate("abab"):
        shutil.copyfile(folder / f"{name}.tif", folder / "images" / f"{1 + number // 2}{name}.tif")
    tifffile.imwrite(folder / "run.tif", np.stack(pages), photometric="minisblack")
    imagecodecs.imwrite(folder / "mask.png", np.full(pages[0].shape, 255, np.uint8))
    camera_files.write_cine(folder / "shot.cine", np.stack(pages[:2]))
    np.stack(pages[:2]).tofile(folder / "shot.raw")
    (folder / "frames.txt").write_text("a.tif\nb.tif\n")


def write_configs(folder: Path) -> None:
    """Write the sample's config as `rig.yaml`, and small ones in place of those of the paper's size."""
    sample = changed("sample")
    (folder / "rig.yaml").write_text(sample)
    (folder / "configs").mkdir()
    for source in (ROOT / "configs").glob("*.yaml"):
        (folder / "configs" / source.name).write_text(f"{sample}  flow_methods: [volumes]\n")
    small = changed(
        "table2",
        ("columns: 2352", "columns: 520"),
        ("rows: 1768", "rows: 520"),
        ("shape_xyz: [80, 80, 240]", "shape_xyz: [24, 24, 30]"),
        ("voxel_mm: 0.1 ", "voxel_mm: [0.1, 0.1, 0.2] "),
        ("dots: [7, 7]", "dots: [3, 3]"),
        ("spacing_mm: 1.0", "spacing_mm: 0.7"),
        ("iterations: 200", "iterations: 8"),
        ("methods: [ert, dlfc]", "methods: [ert]"),
    )
    for name in ("table2", "board"):
        (folder / "configs" / f"{name}.yaml").write_text(small)
    pipe = changed(
        "pipe",
        ("columns: 2352, rows: 1768", "columns: 600, rows: 500"),
        ("shape_xyz: [100, 100, 100]", "shape_xyz: [20, 24, 24]"),
        ("windows: [32, 16]", "windows: [8]"),
        ("particles: 5000 ", "particles: 80\n  rays: 2000 "),
        ("iterations: 24", "iterations: 4"),
    )
    (folder / "configs" / "pipe.yaml").write_text(pipe)


def write_third_frame(folder: Path) -> None:
    """Write a sequence of three frames of particles, the third one where the sample's shear takes the second's."""
    particles = folder / "particles"
    for number, name in enumerate("ab"):
        shutil.copyfile(particles / f"{name}.vtkhdf", particles / f"frame_{number}.vtkhdf")
    last = read_points(particles / "b.vtkhdf", PARTICLES_FORMAT)
    moved = last.position_mm.copy()
    moved[:, 0] += DT_S * (1e3 * 0.12 + 30.0 * moved[:, 2])
    particle_file.write_points(
        particles / "frame_2.vtkhdf", PARTICLES_FORMAT, replace(last, position_mm=moved), overwrite=False
    )


def chain_of(page: Path) -> list[str]:
    """Return the commands of a page, those that write what others read first.

    The paper's report takes an hour: tests of its own make it at a tiny size.
    """
    return [each for each in commands_of(page) if each.startswith("lfpiv ") and "validate paper" not in each]


def run_on_the_sample(commands: list[str], folder: Path) -> Path:
    """Run commands in a folder of the sample and of configs; return the folder."""
    write_images(folder)
    write_configs(folder)
    with contextlib.chdir(folder):
        for command in commands:
            run(command)
    return folder


@pytest.fixture(scope="module")
def furnished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder in which a page begins: the sample, and what the README's chain makes of it."""
    folder = run_on_the_sample(chain_of(ROOT / "README.md"), tmp_path_factory.mktemp("furnished"))
    write_third_frame(folder)
    return folder


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder in which scripts of the gallery run: the sample, and its volumes, vectors, particles and tracks."""
    chain = [command for command in chain_of(ROOT / "README.md") if command.split()[1] not in ("run", "validate")]
    last = next(number for number, command in enumerate(chain) if command.split()[1] == "track")
    return run_on_the_sample(chain[: last + 1], tmp_path_factory.mktemp("measured"))


GALLERY = sorted((ROOT / "examples" / "gallery").glob("*.py"))


@pytest.mark.thorough
@pytest.mark.parametrize("script", GALLERY, ids=lambda script: script.stem)
def test_every_script_of_the_gallery_runs_and_draws(script, measured, tmp_path, monkeypatch) -> None:
    plt = pytest.importorskip("matplotlib.pyplot")
    monkeypatch.setenv("MPLBACKEND", "Agg")
    plt.switch_backend("Agg")
    shutil.copytree(measured, tmp_path, dirs_exist_ok=True)
    with contextlib.chdir(tmp_path):
        runpy.run_path(str(script))
    plt.close("all")
    assert (tmp_path / f"{script.stem}.png").stat().st_size > 10_000


def test_tables_of_accuracy_stand_in_one_place() -> None:
    page, drawn = ((ROOT / "docs" / name).read_text() for name in ("accuracy.md", "figures.py"))
    for file in (ROOT / "docs" / "accuracy").iterdir():
        assert f":file: accuracy/{file.name}" in page
        assert f'"{file.stem}"' in drawn
        with open(file, newline="") as rows:
            assert len({len(row) for row in csv.reader(rows)}) == 1, file


def test_the_gallery_is_of_short_scripts_which_the_page_shows() -> None:
    page = (ROOT / "docs" / "generate.py").read_text()
    assert len(GALLERY) >= 10
    for script in GALLERY:
        lines = script.read_text().splitlines()
        assert len(lines) <= 42, script
        assert re.fullmatch(r'"""[A-Z].*\.', lines[0]), script
        assert f'"{script.stem}"' in page, script


@pytest.mark.slow
@pytest.mark.parametrize("page", [page for page in PAGES if chain_of(page)], ids=lambda page: page.name)
def test_every_command_runs(page, furnished, tmp_path) -> None:
    shutil.copytree(furnished, tmp_path, dirs_exist_ok=True)
    with contextlib.chdir(tmp_path):
        for command in chain_of(page):
            run(command)


@pytest.mark.slow
def test_the_python_page_runs(furnished, tmp_path, capsys) -> None:
    shutil.copytree(furnished, tmp_path, dirs_exist_ok=True)
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "python.md").read_text(), re.DOTALL)
    with contextlib.chdir(tmp_path):
        exec(compile("\n".join(blocks), "docs/python.md", "exec"), {})
    printed = capsys.readouterr().out
    assert "u = 0.1" in printed
    assert "valid vectors" in printed
    assert "Combined: 5 x 3 x 6 vectors" in printed
    assert (tmp_path / "profiles.png").stat().st_size > 10_000


def test_the_python_page_uses_what_is_promised() -> None:
    page = (ROOT / "docs" / "python.md").read_text()
    assert set(re.findall(r"\blf\.(\w+)", page)) <= set(lfpiv_cli.__all__)


# The formats with the version that is written, and those that are read.
VERSIONS = {
    calibration_file.FORMAT: (calibration_file.VERSION,),
    weights_file.FORMAT: (weights_file.VERSION,),
    **dict.fromkeys((VOLUME_FORMAT, VECTORS_FORMAT), (vtkhdf.FORMAT_VERSION,)),
    **dict.fromkeys((PARTICLES_FORMAT, TRACKS_FORMAT, TRAJECTORIES_FORMAT), (particle_file.FORMAT_VERSION,)),
    PLAYBACK_FORMAT: (PLAYBACK_VERSION,),
    SERIES_FORMAT: (SERIES_VERSION,),
}


def test_versions_of_formats_are_those_that_are_written_and_read() -> None:
    page = (ROOT / "docs" / "files.md").read_text(encoding="utf-8")
    found = re.findall(r"`(lfpiv-\w+)`, version (\d+)(?: \(([\d, and]+) are read\))?", page)
    named = {name: [int(number), *map(int, re.findall(r"\d+", others))] for name, number, others in found}
    # Of several the written one comes first.
    assert named.keys() == VERSIONS.keys()
    for name, versions in VERSIONS.items():
        assert (named[name][0], set(named[name])) == (versions[0], set(versions)), name
