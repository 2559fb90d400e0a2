"""The correlation of volumes with a known flow: accuracy, and speed against OpenPIV where it is installed.

OpenPIV (GPL) is no dependency: `pip install --target F --no-deps openpiv==0.26.1` and `PYTHONPATH=F` bring it.
"""

from __future__ import annotations

import contextlib
import io
import time
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

import numba
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from benchmarks.timing import interleaved_medians_s
from benchmarks.volumes import FLOWS, Flow, Seeding, Triple, volume_pair
from lfpiv_cli.flow.correlation import correlate
from lfpiv_cli.flow.field import VALID, VectorField
from lfpiv_cli.flow.windows import CorrelationSettings
from lfpiv_cli.grid import Grid

SHAPE = (100, 130, 100)
WINDOWS = [(32, 32, 32), (16, 16, 16)]
HALF = (0.5, 0.5, 0.5)
# An error beyond this in any component is an outlier; a vector flagged with a smaller raw error is a false alarm.
OUTLIER_VOXEL = 0.5
NORMAL_SPREAD = 1.96
LENGTHS = {"A": (1.0, 1.0, 1.0), "B": (1.0, 1.0, 8.0)}
NOISE, LOST = 0.05, 0.1


def bench_correlation_accuracy() -> None:
    """Print the accuracy for both particle shapes, two seedings, three flows, clean and noisy."""
    print("rms u v w, inside u v w, largest bias (voxel); outliers, false alarms, coverage u v w inside (per cent)")
    for name, figures in accuracy_series(SHAPE, WINDOWS, per_window=(8.0, 82.0), flows=tuple(FLOWS)).items():
        rms, inside = (" ".join(f"{value:.3f}" for value in figures[key]) for key in ("rms", "rms_inside"))
        coverage = " ".join(f"{100 * value:.0f}" for value in figures["coverage"])
        print(
            f"{name:28s} {rms} | {inside} | {max(abs(figures['bias'])):.3f} | "
            f"{100 * figures['outliers']:.2f} {100 * figures['false_alarms']:.2f} | {coverage}",
            flush=True,
        )


def accuracy_series(
    shape_xyz: Triple, windows: Sequence[Triple], per_window: Sequence[float], flows: Sequence[str]
) -> dict[str, dict]:
    """Return the figures of every case by its name."""
    results = {}
    for shape_name, sigma in LENGTHS.items():
        for count in per_window:
            for noise, lost in ((0.0, 0.0), (NOISE, LOST)):
                for flow_name in flows:
                    flow = FLOWS[flow_name](shape_xyz)
                    rng = np.random.default_rng(20261121)
                    a, b = volume_pair(flow, shape_xyz, Seeding(count, sigma, noise, lost), rng)
                    field = correlate([(a, b)], voxel_grid(shape_xyz), CorrelationSettings(windows, HALF))
                    name = f"{shape_name} {count:g} {'noisy' if noise else 'clean'} {flow_name}"
                    results[name] = accuracy(field, flow)
    return results


def bench_correlation() -> None:
    """Print times against OpenPIV's one pass and four passes made of its pieces, the second core, and the memory."""
    rng = np.random.default_rng(20261121)
    a, b = volume_pair(FLOWS["ring"](SHAPE), SHAPE, Seeding(82.0, LENGTHS["A"]), rng)
    threads = numba.get_num_threads()
    numba.set_num_threads(1)
    if find_spec("openpiv") is None:
        print("OpenPIV is not installed: nothing to compare the speed with")
    else:
        ratios = against_openpiv(a, b, WINDOWS, repeats=5)
        print(
            f"one core, {'x'.join(map(str, SHAPE))}: {ratios['ours_s']:.2f} s; OpenPIV's one pass takes "
            f"{ratios['one_pass']:.1f} times as long, four passes of its pieces and scipy {ratios['four_passes']:.1f}"
        )
    if threads > 1:
        print(f"two threads: {second_core(a, b, WINDOWS, repeats=7):.2f} times faster than one")
    numba.set_num_threads(threads)
    large = (300, 300, 200)
    seconds, memory = time_and_memory(large, WINDOWS)
    rise = "unknown here" if memory is None else f"{memory:.1f} times the bytes of the two volumes"
    print(f"{'x'.join(map(str, large))}: {seconds:.1f} s; memory rises by {rise}")


def against_openpiv(
    a: NDArray[np.float32], b: NDArray[np.float32], windows: Sequence[Triple], repeats: int
) -> dict[str, float]:
    """Return our time, and those of OpenPIV's one pass and of four passes made of its pieces in units of it."""
    size = windows[-1][0]
    grid = voxel_grid((a.shape[2], a.shape[1], a.shape[0]))
    medians = interleaved_medians_s(
        {
            "ours": lambda: correlate([(a, b)], grid, CorrelationSettings(windows, HALF)),
            "one_pass": lambda: openpiv_pass(a, b, size),
            "four_passes": lambda: openpiv_passes(a, b, size, passes=4),
        },
        repeats,
    )
    ours = medians.pop("ours")
    return {"ours_s": ours} | {name: taken / ours for name, taken in medians.items()}


def openpiv_pass(a: NDArray[np.float32], b: NDArray[np.float32], size: int) -> NDArray[np.float64]:
    """Return OpenPIV's displacements (windows z, y, x, 3) along (z, y, x), at half overlap.

    Its components along axes 0, 1, 2 are (v, -u, w); this turns them round.
    """
    from openpiv.pyprocess3D import extended_search_area_piv3D

    window, overlap = (size,) * 3, (size // 2,) * 3
    with contextlib.redirect_stderr(io.StringIO()):
        u, v, w = extended_search_area_piv3D(a, b, window, overlap, search_area_size=window)
    return np.stack([v, -u, w], axis=-1)


def openpiv_passes(a: NDArray[np.float32], b: NDArray[np.float32], size: int, passes: int) -> NDArray[np.float64]:
    """Return the displacements after passes over volumes that scipy deforms symmetrically by cubic splines."""
    total = openpiv_pass(a, b, size)
    step = size // 2
    places = np.indices(a.shape, dtype=np.float32)
    for _ in range(passes - 1):
        margin = [(n - (count - 1) * step) / 2 for n, count in zip(a.shape, total.shape[:3], strict=True)]
        at = [(places[axis] - margin[axis]) / step for axis in range(3)]
        half = [0.5 * ndimage.map_coordinates(total[..., axis], at, order=1, mode="nearest") for axis in range(3)]
        first = ndimage.map_coordinates(a, [p - h for p, h in zip(places, half, strict=True)], order=3)
        second = ndimage.map_coordinates(b, [p + h for p, h in zip(places, half, strict=True)], order=3)
        total = ndimage.median_filter(total + openpiv_pass(first, second, size), size=(3, 3, 3, 1))
    return total


def second_core(a: NDArray[np.float32], b: NDArray[np.float32], windows: Sequence[Triple], repeats: int) -> float:
    """Return how many times faster two threads are than one."""
    grid = voxel_grid((a.shape[2], a.shape[1], a.shape[0]))

    def run(threads: int) -> None:
        numba.set_num_threads(threads)
        correlate([(a, b)], grid, CorrelationSettings(windows, HALF))

    medians = interleaved_medians_s({"one": lambda: run(1), "two": lambda: run(2)}, repeats)
    return medians["one"] / medians["two"]


def time_and_memory(shape_xyz: Triple, windows: Sequence[Triple]) -> tuple[float, float | None]:
    """Return the seconds a pair takes, and how far memory rises meanwhile in units of the two volumes' bytes."""
    rng = np.random.default_rng(1)
    a, b = volume_pair(FLOWS["ring"](shape_xyz), shape_xyz, Seeding(4.0, LENGTHS["A"]), rng)
    before = memory_bytes("VmRSS", reset_peak=True)
    start = time.perf_counter()
    correlate([(a, b)], voxel_grid(shape_xyz), CorrelationSettings(windows, HALF))
    seconds = time.perf_counter() - start
    peak = memory_bytes("VmHWM")
    return seconds, None if before is None or peak is None else (peak - before) / (a.nbytes + b.nbytes)


def memory_bytes(name: str, reset_peak: bool = False) -> int | None:
    """Return the resident memory (VmRSS) or its peak (VmHWM) of this process; None where Linux does not tell."""
    try:
        if reset_peak:
            Path("/proc/self/clear_refs").write_text("5")
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        return None
    return next(1024 * int(line.split()[1]) for line in lines if line.startswith(name))


def voxel_grid(shape_xyz: Triple) -> Grid:
    """Return a grid whose mm are voxel indices."""
    return Grid(shape_xyz, (1.0, 1.0, 1.0), (0.0, 0.0, 0.0))


def accuracy(field: VectorField, flow: Flow) -> dict:
    """Return rms, rms without the outermost windows, bias, outliers, false alarms and the coverage at 1.96 sigma."""
    error = field.displacement_voxel - true_displacements(field, flow)
    raw_error = field.displacement_raw_voxel - true_displacements(field, flow)
    inner = (slice(1, -1),) * 3
    flagged = field.flag != VALID
    uncertainty = field.uncertainty_voxel
    assert uncertainty is not None
    known = np.isfinite(uncertainty[inner])
    covered = np.abs(error[inner]) < NORMAL_SPREAD * uncertainty[inner]
    return {
        "rms": _rms(error),
        "rms_inside": _rms(error[inner]),
        "bias": np.nanmean(error, axis=(0, 1, 2)),
        "outliers": float(np.mean(~np.all(np.abs(error) <= OUTLIER_VOXEL, axis=-1))),
        "false_alarms": float(np.mean(flagged & np.all(np.abs(raw_error) <= OUTLIER_VOXEL, axis=-1))),
        "coverage": covered.sum(axis=(0, 1, 2)) / np.maximum(1, known.sum(axis=(0, 1, 2))),
    }


def true_displacements(field: VectorField, flow: Flow) -> NDArray[np.float64]:
    """Return the flow at the window centres, (nz, ny, nx, 3)."""
    z, y, x = np.meshgrid(*(field.grid.axis_mm(axis) for axis in (2, 1, 0)), indexing="ij")
    points = np.stack([x, y, z], axis=-1)
    return flow(points.reshape(-1, 3)).reshape(points.shape)


def _rms(error: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.sqrt(np.nanmean(error**2, axis=(0, 1, 2)))
