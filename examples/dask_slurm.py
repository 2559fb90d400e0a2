"""Volumes of thousands of frames by workers that Slurm starts as it has room, and that come and go.

    python dask_slurm.py weights.h5 run volumes --jobs 20

`run` is a folder of images, and `volumes` the folder of the results. This program runs on the login node, or in a small
job of its own; it needs `pip install "lfpiv[cluster]" dask-jobqueue`. For PBS, LSF or SGE take another class of
`dask_jobqueue`: nothing else changes.
"""

from __future__ import annotations

import argparse
import subprocess
import sys

from dask_jobqueue import SLURMCluster

WALL_TIME = "02:00:00"
# Dask has its workers give back the memory of each array at once, which takes half as long again for small frames.
# These are the values that programs have otherwise.
PROLOGUE = ["export MALLOC_MMAP_THRESHOLD_=33554432", "export MALLOC_TRIM_THRESHOLD_=67108864"]
# A worker ends by itself before Slurm ends it, and so that not all end at once; frames go to others.
WORKER_OPTIONS = ["--lifetime", "110m", "--lifetime-stagger", "5m"]


def main() -> int:
    """Start the workers, and reconstruct on them; return the exit code of lfpiv."""
    parser = argparse.ArgumentParser(description="lfpiv reconstruct on Slurm's nodes")
    parser.add_argument("weights")
    parser.add_argument("images")
    parser.add_argument("output")
    parser.add_argument("--jobs", type=int, default=20)
    parser.add_argument("--memory", default="8GB")
    given = parser.parse_args()
    # One frame at a time in each process, with one thread.
    with SLURMCluster(
        cores=1,
        processes=1,
        memory=given.memory,
        walltime=WALL_TIME,
        job_name="lfpiv",
        job_script_prologue=PROLOGUE,
        worker_extra_args=WORKER_OPTIONS,
    ) as cluster:
        cluster.scale(jobs=given.jobs)
        command = ["lfpiv", "reconstruct", given.weights, given.images, "--dask", cluster.scheduler_address]
        return subprocess.run([*command, "--resume", "--keep-going", "-o", given.output]).returncode


if __name__ == "__main__":
    sys.exit(main())
