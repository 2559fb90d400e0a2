"""Where compiled kernels are kept from one run to the next: where numba keeps them, but never without a place.

Numba keeps them beside the package, else in the user's folder for caches, or in the folder that `NUMBA_CACHE_DIR`
names, and refuses to work where it can write to none of these, as in a container that is read-only. There a folder
for this process alone takes their place, with a copy of what the folder that cannot be written holds.

Numba takes compiled code for current while its own file is: what that code has in it of other files may be of before.
So compiled code beside the package goes when its file, or one that this imports, directly or not, has changed.
"""

from __future__ import annotations

import ast
import atexit
import os
import shutil
import sys
import tempfile
from contextlib import suppress
from pathlib import Path

VARIABLE = "NUMBA_CACHE_DIR"
PACKAGE = Path(__file__).parents[1]
# In the package's folder for compiled code: of which files that is.
STAMP = "kernels-of"
HINT = (
    f"compiled code cannot be kept, each run compiles anew: set {VARIABLE} to a folder that can be written, or to one "
    "that `lfpiv warm-up --cache` has filled"
)


# Set where this process compiles into a folder that goes with it, and has found nothing compiled.
lost = False


def ensure_place() -> None:
    """Give this process a folder for compiled kernels where numba would find none, before any is asked for."""
    global lost
    given = os.environ.get(VARIABLE)
    if not given:
        forget_outdated(PACKAGE)
    # Where numba keeps compiled code of its own accord: beside the source, then with the user.
    places = [PACKAGE / "__pycache__", Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"))]
    if sys.platform == "win32":
        places[1] = Path(os.environ.get("LOCALAPPDATA", PACKAGE))
    elif sys.platform == "darwin":
        places[1] = Path(os.path.expanduser("~/Library/Caches"))
    if any(map(_is_writable, [Path(given)] if given else places)):
        return
    place = tempfile.mkdtemp(prefix="lfpiv-kernels-")
    atexit.register(shutil.rmtree, place, ignore_errors=True)
    lost = not given or not os.path.isdir(given)
    if given and not lost:
        shutil.copytree(given, place, dirs_exist_ok=True)
    use(Path(place))


def forget_outdated(package: Path) -> None:
    """Remove the compiled kernels beside a package's files if these, or what they import, have changed; if allowed."""
    times = {path: path.stat().st_mtime_ns for path in sorted(package.rglob("*.py"))}
    stamp = package / "__pycache__" / STAMP
    current = "".join(f"{path.relative_to(package)} {time}\n" for path, time in times.items())
    with suppress(OSError, SyntaxError):
        before = stamp.read_text(encoding="utf-8") if stamp.is_file() else ""
        if before == current:
            return
        lines = set(before.splitlines())
        changed = {path for path, time in times.items() if f"{path.relative_to(package)} {time}" not in lines}
        imports: dict[Path, set[Path]] = {}
        for path in times:
            nodes = [node for node in ast.walk(ast.parse(path.read_bytes())) if isinstance(node, ast.ImportFrom)]
            names = [f"{node.module}.{each.name}" for node in nodes for each in node.names]
            names += [node.module or "" for node in nodes]
            imports[path] = {package.parent.joinpath(*name.split(".")).with_suffix(".py") for name in names}
        # What has changed, and what imports such files.
        outdated: set[Path] = set()
        while changed:
            outdated |= changed
            changed = {path for path, imported in imports.items() if path not in outdated and imported & outdated}
        for kernel in [*package.rglob("*.nbi"), *package.rglob("*.nbc")]:
            source = kernel.parents[1] / f"{kernel.name.split('.')[0]}.py"
            if source in outdated or source not in times:
                kernel.unlink(missing_ok=True)
        stamp.parent.mkdir(exist_ok=True)
        stamp.write_text(current, encoding="utf-8")


def use(place: Path) -> None:
    """Keep compiled kernels in a folder from here on, in processes started from this one, too."""
    os.environ[VARIABLE] = str(place)
    if "numba" in sys.modules:
        sys.modules["numba"].config.CACHE_DIR = str(place)


def _is_writable(folder: Path) -> bool:
    """Return whether a folder can be written, or made."""
    there = next((path for path in (folder, *folder.parents) if path.exists()), None)
    return there is not None and there.is_dir() and os.access(there, os.W_OK | os.X_OK)
