"""Run the benchmarks that are named, or all of them: `python -m benchmarks [NAME ...]`.

To add one: a function that takes no arguments, prints its figures, and has a line in `BENCHMARKS`; it lives in a
function of its own with a size, which the tests call with a tiny one. `rigs`, `faults`, `batches` and `fields` have
options of their own, and so has `fuzz`, which takes hours and is run by its name alone.
"""

from __future__ import annotations

import sys
from collections.abc import Callable

from benchmarks.batches import bench_batches
from benchmarks.calibration import bench_calibration
from benchmarks.correlation import bench_correlation, bench_correlation_accuracy
from benchmarks.depth import bench_depth
from benchmarks.faults import bench_faults
from benchmarks.fields import bench_fields
from benchmarks.fuzz import bench_fuzz
from benchmarks.links import bench_links
from benchmarks.particles import bench_particles, bench_particles_thrice
from benchmarks.pressure import bench_pressure
from benchmarks.rigs import bench_rigs
from benchmarks.sequences import bench_sequences
from benchmarks.simd import bench_simd
from benchmarks.solvers import bench_solvers
from benchmarks.surfaces import bench_surfaces
from benchmarks.tracer_sizes import bench_tracer_sizes
from benchmarks.weights import bench_weights

BENCHMARKS: dict[str, Callable[[], None]] = {
    "batches": bench_batches,
    "calibration": bench_calibration,
    "correlation": bench_correlation,
    "correlation-accuracy": bench_correlation_accuracy,
    "depth": bench_depth,
    "faults": bench_faults,
    "fields": bench_fields,
    "links": bench_links,
    "particles": bench_particles,
    "particles-thrice": bench_particles_thrice,
    "pressure": bench_pressure,
    "rigs": bench_rigs,
    "sequences": bench_sequences,
    "simd": bench_simd,
    "solvers": bench_solvers,
    "surfaces": bench_surfaces,
    "tracer-sizes": bench_tracer_sizes,
    "weights": bench_weights,
}


def main(names: list[str]) -> None:
    with_options = {
        "rigs": bench_rigs,
        "faults": bench_faults,
        "batches": bench_batches,
        "fields": bench_fields,
        "fuzz": bench_fuzz,
    }
    for name, bench in with_options.items():
        if names[:1] == [name]:
            bench(names[1:])
            return
    unknown = [name for name in names if name not in BENCHMARKS]
    if unknown:
        sys.exit(f"no benchmark is called {unknown[0]!r}; there are {', '.join(BENCHMARKS)}")
    for name in names or BENCHMARKS:
        print(f"== {name}", flush=True)
        BENCHMARKS[name]()


if __name__ == "__main__":
    main(sys.argv[1:])
