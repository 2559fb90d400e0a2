"""What stands at the door: version, citation, the guide for contributors, the workflow."""

import ast
import re
import tomllib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import yaml
from pydantic import ValidationError

import lfpiv_cli
from lfpiv_cli.files import images
from lfpiv_cli.files.recording import Recording
from lfpiv_cli.files.sections_work import flow_of, flow_section
from lfpiv_cli.flow.correlation import correlate
from lfpiv_cli.flow.windows import WEIGHTINGS, CorrelationSettings
from lfpiv_cli.grid import Grid, Reference
from lfpiv_cli.reconstruction.registry import SOLVERS, Solver
from lfpiv_cli.reconstruction.solvers import SolverSettings, reconstruct
from lfpiv_cli.synthetic.flows import FLOWS, Flow
from tests.commands import ROOT

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
GUIDE = (ROOT / "CONTRIBUTING.md").read_text()
WORKFLOW = yaml.safe_load((ROOT / ".github" / "workflows" / "ci.yml").read_text())

# Paths of this repository that stand in backticks, and what is named in them: `file::name`.
PLACE = re.compile(r"`((?:lfpiv_cli|tests|configs|benchmarks|docs)/[\w/.-]+)(?:::(\w+))?`")
PLACES = sorted({match.groups() for match in PLACE.finditer(GUIDE)}, key=str)


def names_in(module: Path) -> set[str]:
    """Return the functions, classes and constants at the top of a module."""
    names = set()
    for node in ast.parse(module.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            names.add(node.name)
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names |= {target.id for target in targets if isinstance(target, ast.Name)}
    return names


def test_version_stands_in_one_place() -> None:
    assert "version" not in PROJECT["project"]
    assert PROJECT["tool"]["setuptools"]["dynamic"]["version"] == {"attr": "lfpiv_cli.__version__"}
    # a literal: setuptools then reads it without importing the package, whose dependencies a build does not have
    tree = ast.parse(Path(lfpiv_cli.__file__).read_text(encoding="utf-8"))
    assigned = [node for node in tree.body if isinstance(node, ast.Assign)]
    values = [node.value for node in assigned if ast.unparse(node.targets[0]) == "__version__"]
    assert [ast.literal_eval(value) for value in values] == [lfpiv_cli.__version__]
    assert "version" not in yaml.safe_load((ROOT / "CITATION.cff").read_text())


def test_citation_names_program_and_method_and_the_changelog_what_is_not_released() -> None:
    headings = re.findall(r"^## \[(.+?)\]", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert headings[0] == "Unreleased"
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert {"cff-version", "message", "title", "authors"} <= citation.keys()
    assert citation["license"] == PROJECT["project"]["license"]
    (paper,) = citation["references"]
    assert re.fullmatch(r"10\.\d{4,}/\S+", paper["doi"])
    assert paper["authors"][0]["family-names"] == "Zhu"


def test_guide_names_what_exists() -> None:
    for path, name in PLACES:  # of which test_documents.py asks that they exist
        assert name is None or name in names_in(ROOT / path), (path, name)


def test_guide_lists_files_and_tests_for_each_addition() -> None:
    sections = GUIDE.split("## How to add", 1)[1].split("\n### ")[1:]
    assert len(sections) >= 4
    most = (
        "A solver",
        "A kind of surface",
        "A window weighting",
        "A format of a camera's frames",
        "A figure in a report",
    )
    touched = {}
    for section in sections:
        title, paths = section.splitlines()[0], {match.group(1) for match in PLACE.finditer(section)}
        touched[title] = {path for path in paths if path.startswith("lfpiv_cli/")}
        assert touched[title], title
        assert any(path.startswith("tests/") for path in paths), title
    # What is added most touches four files.
    assert all(1 <= len(touched[title]) <= 4 for title in most), touched


class Pixels:
    """Two voxels, each of which lights its own pixel."""

    shape = (1, 1, 2)

    def forward(self, volume: np.ndarray) -> np.ndarray:
        return volume[0]

    def adjoint(self, image: np.ndarray) -> np.ndarray:
        return image[np.newaxis]


def halve(problem, volume, projection, relaxation):
    return volume / 2


def test_a_solver_is_added_by_its_step_and_its_name(monkeypatch) -> None:
    monkeypatch.setitem(SOLVERS, "halve", Solver(f"{__name__}:{halve.__name__}"))
    result = reconstruct(Pixels(), np.array([[4.0, 2.0]], np.float32), SolverSettings("halve", 3))
    start = reconstruct(Pixels(), np.array([[4.0, 2.0]], np.float32), SolverSettings("halve", 0))
    np.testing.assert_array_equal(result.volume, start.volume / 8)
    assert result.residual.shape == (4,)


def test_a_weighting_is_added_by_its_function_and_its_name(monkeypatch) -> None:
    def triangle(offset):
        return 1.0 - 2.0 * np.abs(offset)

    monkeypatch.setitem(WEIGHTINGS, "triangle", triangle)
    a, b = np.random.default_rng(3).random((2, 12, 12, 12)).astype(np.float32)
    b[:, :, 1:] = a[:, :, :-1]
    found, grid = {}, Grid.centred((12, 12, 12), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0))
    for weighting in ("uniform", "triangle"):
        settings = CorrelationSettings(((8, 8, 8),), (0.5, 0.5, 0.5), 1.0, 1.0, weighting)
        found[weighting] = correlate([(a, b)], grid, settings).displacement_voxel
        np.testing.assert_allclose(np.nanmedian(found[weighting][..., 0]), 1.0, atol=0.05)
    assert not np.array_equal(found["uniform"], found["triangle"])


def test_a_camera_format_is_added_by_its_reader_and_its_line(monkeypatch, tmp_path) -> None:
    image = np.arange(12, dtype=np.float32).reshape(3, 4)

    def frames(path):
        return Recording(1, image.shape, 16, lambda page, shape: image)

    monkeypatch.setattr(images, "FORMATS", (images.Format("text", frames, suffixes=(".text",)), *images.FORMATS))
    (tmp_path / "a.text").write_text("an image")
    np.testing.assert_array_equal(images.read_image(tmp_path / "a.text"), image)


def expansion(rate_per_s: float, radius_mm: float = 1.0, centre_mm: Sequence[float] = (0.0, 0.0, 0.0)) -> Flow:
    """Expansion about a centre."""
    return lambda points_mm: 1e-3 * rate_per_s * (points_mm - np.asarray(centre_mm))


def test_a_flow_is_added_by_its_factory(monkeypatch) -> None:
    monkeypatch.setitem(FLOWS, "expansion", expansion)
    section = flow_section(expansion)
    assert section.__doc__ == "Expansion about a centre."
    flow = flow_of(section(kind="expansion", rate_per_s=2.0), Reference("mid_plane", -0.5))
    np.testing.assert_allclose(flow(np.array([[1.0, 0.0, -0.5]])), [[0.002, 0.0, 0.0]])
    for wrong in ({"radius_mm": 0.0}, {"centre_mm": (0.0, 0.0)}, {"kind": "shear"}, {"rate": 1.0}):
        with pytest.raises(ValidationError):
            section(**{"kind": "expansion", "rate_per_s": 2.0} | wrong)


def test_workflow_runs_make_on_what_is_promised_and_hooks_its_checks() -> None:
    job = WORKFLOW["jobs"]["make"]
    pythons = {line.rsplit(" ", 1)[1] for line in PROJECT["project"]["classifiers"] if re.search(r":: 3\.\d+$", line)}
    assert set(job["strategy"]["matrix"]["python"]) == pythons
    assert {system.split("-")[0] for system in job["strategy"]["matrix"]["system"]} == {"ubuntu", "macos", "windows"}
    commands = [step["run"].split() for step in job["steps"] if step.get("run", "").startswith("make")]
    targets = {word for command in commands for word in command[1:] if "=" not in word}
    assert targets == {"check", "test", "docs"}
    phony = re.search(r"^\.PHONY: (.+)$", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert phony is not None
    assert targets <= set(phony.group(1).split())
    hooks = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())["repos"][0]["hooks"]
    assert {hook["id"] for hook in hooks} == {"ruff-check", "ruff-format", "mypy"}
