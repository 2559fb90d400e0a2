"""The house rule: imports only point back along the way of the light and then of the data."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.commands import ROOT

PACKAGE = ROOT / "lfpiv_cli"
# From the scene to the shell; what stands on one line may not know of a later line.
LAYERS = (
    {"arrays", "errors", "grid", "kernels", "names", "neighbourhoods", "notice", "results", "robust", "threads"},
    {"simd"},
    # knows points, not images: nothing of ours beyond the grid
    {"tracks"},
    {"fields"},
    {"optics"},
    {"calibration"},
    {"weights"},
    {"reconstruction"},
    {"particles"},
    {"flow"},
    {"self_calibration"},
    {"synthetic"},
    {"pictures"},
    {"validation"},
    {"files"},
    {"console"},
    {"verbs"},
    {"paper"},
    {"cli"},
    {"__init__", "__main__"},
)
FIRST_OUTER_LAYER = next(k for k, names in enumerate(LAYERS) if "files" in names)
# What touches disks, terminals and configuration stays in files/ and beyond.
OUTER_ONLY = {"click", "yaml", "pydantic", "h5py", "tqdm", "logging", "pathlib", "os", "tifffile", "imagecodecs", "sys"}
MODULES = sorted(PACKAGE.rglob("*.py"))


def place_of(module: Path) -> str:
    """Return the folder or module at the top that this one belongs to."""
    return module.relative_to(PACKAGE).parts[0].removesuffix(".py")


def layer_of(module: Path) -> int:
    return next(k for k, names in enumerate(LAYERS) if place_of(module) in names)


def imported(module: Path) -> Iterator[str]:
    """Yield the full names that a module imports, wherever in it."""
    for node in ast.walk(ast.parse(module.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module} line {node.lineno}: imports are absolute"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def test_every_module_has_its_layer() -> None:
    assert [module for module in MODULES if not any(place_of(module) in names for names in LAYERS)] == []


def test_a_package_loads_none_of_its_modules() -> None:
    """Who needs one of them would wait for all: `export` a second and a half. `cli` is loaded as a whole anyway."""
    loading = {m.parent.name for m in MODULES if m.name == "__init__.py" and any("lfpiv_cli" in n for n in imported(m))}
    assert loading == {"lfpiv_cli", "cli"}


@pytest.mark.thorough
@pytest.mark.parametrize("module", MODULES, ids=lambda m: str(m.relative_to(PACKAGE)))
def test_imports_point_back(module: Path) -> None:
    here = layer_of(module)
    for name in imported(module):
        parts = name.split(".")
        if parts[0] == "lfpiv_cli" and len(parts) > 1 and place_of(PACKAGE / parts[1]) in set().union(*LAYERS):
            assert layer_of(PACKAGE / parts[1]) <= here, f"{module.name} imports {name}, which lies ahead of it"


@pytest.mark.thorough
@pytest.mark.parametrize("module", [m for m in MODULES if layer_of(m) < FIRST_OUTER_LAYER], ids=lambda m: m.name)
def test_the_core_touches_no_disk_and_no_terminal(module: Path) -> None:
    outer = {name.split(".")[0] for name in imported(module)} & OUTER_ONLY
    assert not outer, f"{module.name} imports {outer}"
