"""The examples: each understood (quick), and each run with stand-ins for what is not here (slow).

A fake `sbatch` runs the jobs of an array one after the other, or one job in the background; make is the real one, and
Snakemake, where it is installed. Of the image's definition the commands are run that need no image.
"""

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import click
import numpy as np
import pytest
import tifffile

from lfpiv_cli.cli.main import cli
from lfpiv_cli.files.images import read_image
from tests.commands import ROOT, SAMPLE, sample_weights

EXAMPLES = ROOT / "examples"
SMALL = (
    ("shape_xyz: [30, 22, 40]", "shape_xyz: [8, 6, 12]"),
    ("windows: [24, 12]", "windows: [6]"),
    ("iterations: 16", "iterations: 2"),
)
LFPIV = f"""#!/bin/sh
exec {shlex.quote(sys.executable)} -m lfpiv_cli "$@"
"""
# Runs an array's jobs, each with what Slurm tells it, one job after them, or one in the background.
SBATCH = """#!/bin/bash
if [[ $1 == --array=* ]]; then
    range=${1#--array=}; shift; first=${range%-*}; last=${range#*-}
    for ((task = first; task <= last; task++)); do
        SLURM_ARRAY_JOB_ID=7 SLURM_ARRAY_TASK_ID=$task SLURM_ARRAY_TASK_MIN=$first SLURM_ARRAY_TASK_MAX=$last \\
            SLURM_ARRAY_TASK_COUNT=$((last - first + 1)) SLURM_ARRAY_TASK_STEP=1 SLURM_CPUS_PER_TASK=1 bash "$@" || exit
    done
elif [[ $1 == --dependency=singleton ]]; then
    shift; SLURM_JOB_ID=8 SLURM_CPUS_PER_TASK=1 bash "$@" || exit
else
    bash "$@" >> "$STANDINS/jobs.out" 2>&1 &
    echo $! >> "$STANDINS/jobs"
fi
echo "Submitted batch job 7"
"""
SCONTROL = """#!/bin/sh
echo "$@" >> "$STANDINS/requeued"
"""


def script(folder: Path, name: str, text: str) -> None:
    (folder / name).write_text(text)
    (folder / name).chmod(0o755)


@pytest.fixture
def experiment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with weights and the images of two pairs, where `lfpiv` and stand-ins of Slurm's commands are found."""
    standins = tmp_path / "standins"
    standins.mkdir()
    for name, text in {"lfpiv": LFPIV, "sbatch": SBATCH, "scontrol": SCONTROL, "scancel": "#!/bin/sh\n"}.items():
        script(standins, name, text)
    monkeypatch.setenv("PATH", f"{standins}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.setenv("STANDINS", str(standins))
    work = tmp_path / "work"
    (work / "run").mkdir(parents=True)
    sample_weights(work, *SMALL)
    image, rng = read_image(SAMPLE / "pair_a.tif"), np.random.default_rng(1)
    for name in ("1_a", "1_b", "2_a", "2_b"):
        tifffile.imwrite(work / "run" / f"{name}.tif", (image + rng.uniform(0.0, 9.0, image.shape)).astype(np.uint16))
    return work


def run(command: str, folder: Path, expected: int = 0) -> subprocess.CompletedProcess[str]:
    done = subprocess.run(shlex.split(command), cwd=folder, capture_output=True, text=True, timeout=300)
    assert done.returncode == expected, done.stdout + done.stderr
    return done


def results(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir() if path.suffix == ".vtkhdf")


VOLUMES = [f"{name}.vtkhdf" for name in ("1_a", "1_b", "2_a", "2_b")]


def lfpiv_commands(text: str) -> Iterator[list[str]]:
    """Yield the commands of lfpiv in a script, what a shell or Snakemake or make would put in place by a word."""
    joined = text.replace("\\\n", " ")
    for found in re.finditer(r"^\s*(?:exec )?(\"?)lfpiv (.*)\1$", joined, re.MULTILINE):
        words = re.sub(r"\{[\w.]+\}|\$\(\w+\)|\$\{?\w+\}?|\$[*@]", "1", found[2])
        yield shlex.split(words)


def test_the_commands_of_the_examples_are_understood() -> None:
    seen = set()
    for path in sorted(filter(Path.is_file, EXAMPLES.iterdir())):
        for name, *arguments in lfpiv_commands(path.read_text()):
            if name in ("1", "--version"):
                continue
            command = cli.get_command(click.Context(cli), name)
            assert command is not None, f"{path.name}: {name}"
            if arguments != ["--help"]:
                arguments = ["1/1" if part.startswith("1/") else part for part in arguments]
                command.make_context(name, arguments, resilient_parsing="slurm" in arguments)
            seen.add(path.name)
    assert seen == {"array.sbatch", "lfpiv.def", "Makefile", "Snakefile"}


def test_the_documents_name_every_example() -> None:
    page = (ROOT / "docs" / "clusters.md").read_text()
    assert {
        path.name for path in filter(Path.is_file, EXAMPLES.iterdir()) if f"examples/{path.name}" not in page
    } == set()


@pytest.mark.slow
def test_an_array_of_jobs_and_one_that_stops_early(experiment: Path) -> None:
    job, given = shlex.quote(str(EXAMPLES / "array.sbatch")), "rig.yaml photographs run results --method volumes"
    (experiment / "photographs").mkdir()
    for name in ("white.tif", "dark.tif", "board.tif"):
        shutil.copyfile(SAMPLE / name, experiment / "photographs" / name)
    run(f"sbatch --array=1-2 {job} {given}", experiment)
    assert results(experiment / "results" / "vectors") == ["1_a.vtkhdf", "2_a.vtkhdf"]
    assert not (experiment / "results" / "report.html").exists()
    run(f"sbatch --dependency=singleton {job} {given}", experiment)
    assert (experiment / "results" / "report.html").exists()
    assert json.loads((experiment / "results" / "run.json").read_text())["figures"]["vectors"]["volumes"] > 0
    assert not (experiment.parent / "standins" / "requeued").exists()
    # A job that stops early is queued again.
    job = (EXAMPLES / "array.sbatch").read_text()
    assert "--time-limit 01:55:00" in job
    script(experiment, "short.sbatch", job.replace("--time-limit 01:55:00", "--time-limit 0.001s"))
    run(f"sbatch --array=1-2 short.sbatch {given}", experiment)
    run(f"sbatch --dependency=singleton short.sbatch {given}", experiment)
    assert (experiment.parent / "standins" / "requeued").read_text() == "requeue 7_1\nrequeue 7_2\nrequeue 8\n"


@pytest.mark.slow
def test_workers_that_slurm_starts(experiment: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("dask_jobqueue")
    run(f"{sys.executable} {EXAMPLES / 'dask_slurm.py'} weights.h5 run volumes --jobs 2 --memory 1GB", experiment)
    assert results(experiment / "volumes") == VOLUMES
    assert len((experiment.parent / "standins" / "jobs").read_text().split()) == 2


@pytest.mark.slow
def test_the_makefile(experiment: Path) -> None:
    if shutil.which("make") is None:
        pytest.skip("make is not installed")
    command = f"make -f {EXAMPLES / 'Makefile'} PARTS=2"
    run(command, experiment)
    assert results(experiment / "results" / "volumes") == VOLUMES
    assert results(experiment / "results" / "vectors") == ["1_a.vtkhdf", "2_a.vtkhdf"]
    assert "Nothing to be done" in run(command, experiment).stdout


@pytest.mark.slow
def test_the_snakefile(experiment: Path) -> None:
    if shutil.which("snakemake") is None:
        pytest.skip("Snakemake is not installed")
    run(f"snakemake --cores 1 --quiet --snakefile {EXAMPLES / 'Snakefile'}", experiment)
    assert results(experiment / "vectors") == ["1.vtkhdf", "2.vtkhdf"]


def sections(definition: str) -> dict[str, list[str]]:
    """Return the commands of each section of an Apptainer definition, and its header's fields."""
    found: dict[str, list[str]] = {"header": []}
    section = "header"
    for line in definition.splitlines():
        if line.startswith("%"):
            section = line[1:]
            found[section] = []
        elif line.strip() and not line.strip().startswith("#"):
            found[section].append(line.strip())
    return found


def test_the_definition_of_an_image_has_what_apptainer_asks_for() -> None:
    found = sections((EXAMPLES / "lfpiv.def").read_text())
    header = dict(line.split(": ", 1) for line in found.pop("header"))
    assert set(header) == {"Bootstrap", "From"}
    assert set(found) <= {"files", "post", "environment", "test", "runscript", "help"}
    # The cache that is filled is the one that is read.
    filled = re.search(r"warm-up --cache (\S+)", "\n".join(found["post"]))
    assert filled is not None
    assert found["environment"] == [f"export NUMBA_CACHE_DIR={filled[1]}"]
    installed = re.search(r"lfpiv\[([\w,]+)\]", "\n".join(found["post"]))
    assert installed is not None
    extras = (ROOT / "pyproject.toml").read_text()
    assert all(re.search(rf"^{extra} = \[", extras, re.MULTILINE) for extra in installed[1].split(","))


@pytest.mark.slow
def test_the_image_tests_itself_and_runs_commands(experiment: Path) -> None:
    found = sections((EXAMPLES / "lfpiv.def").read_text())
    for command in found["test"]:
        run(command, experiment)
    script(experiment, "runscript", "#!/bin/sh\n" + "\n".join(found["runscript"]) + "\n")
    assert "lfpiv-weights" in run("./runscript info weights.h5", experiment).stdout
