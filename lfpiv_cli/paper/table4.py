"""The laminar channel flow (Section 4.2, Figs. 14-16 and 18, Table 4), measured as the paper did and at its best."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from lfpiv_cli.console import Console
from lfpiv_cli.files.config import load_rig
from lfpiv_cli.files.pages import Table
from lfpiv_cli.paper.parts import AS_PAPER, BOARD, MISALIGNED, Drawing, Findings, Row, Work, merged, sections
from lfpiv_cli.paper.pictures import cumulative_figure, slice_maps_figure
from lfpiv_cli.validation.flow import Duct, Measured
from lfpiv_cli.validation.methods import slices_figure
from lfpiv_cli.verbs.simulate import board_depths, simulate_boards, simulate_images
from lfpiv_cli.verbs.validate import duct_of, measure_images, measured_of

# The paper's laminar channel flow (Section 4.2) as sections of a config, at the sizes that the report has.

SEED = 7
# The mean over the channel's section, m/s: 40 L/h through 1 cm2, rounded as the paper has it.
MEAN_VELOCITY_M_S = 0.1082
# Sides of the paper's voxels.
VOXEL_MM = 0.1
# How far the board on the wall is off the focal plane, in air, and by Eq. 21 the middle of the channel, in water.
BOARD_Z_MM, MID_PLANE_Z_MM = -0.2, -0.266


@dataclass(frozen=True)
class ChannelSize:
    """How large a channel is simulated.

    Attributes
    ----------
    width_mm : D, its inner width
    length_mm : of the volume along the flow
    columns, rows : of the sensor
    windows : of the correlation in voxels, coarse to fine
    iterations : of SART
    dots : of the boards in the fluid along x and y; the one on the wall has at most seven
    spacing_mm : of the dots
    rays : of a tracer; None: as many as its noise needs
    """

    width_mm: float
    length_mm: float
    columns: int
    rows: int
    windows: tuple[int, ...]
    iterations: int
    dots: tuple[int, int]
    spacing_mm: float = 1.0
    rays: int | None = None

    @property
    def volume_mm(self) -> list[float]:
        """Size of the volume along x, y and z."""
        return [self.length_mm, self.width_mm, self.width_mm]

    @property
    def particles(self) -> int:
        """Tracers in the volume: as dense as 8300 in the paper's, 0.002 per pixel of its sensor."""
        return round(8300 * self.length_mm * self.width_mm**2 / 1300.0)

    def reported(self) -> str:
        """Return the size in words."""
        shape = " x ".join(f"{round(side / VOXEL_MM)}" for side in self.volume_mm)
        return (
            f"a channel of {self.width_mm:g} mm, {shape} voxels of {VOXEL_MM:g} mm, {self.particles} tracers, "
            f"{self.columns} x {self.rows} pixels"
        )


FULL = ChannelSize(10.0, 13.0, 2352, 1768, (32, 16), 200, (13, 9))
QUICK = ChannelSize(5.0, 4.0, 800, 900, (32, 16), 60, (5, 5))
TINY = ChannelSize(1.6, 1.6, 400, 400, (8,), 5, (3, 3), 0.5, 5_000)

# Iterations of accelerated EM, which needs no more.
EM_ITERATIONS = 24


def at_best(size: ChannelSize) -> dict[str, Any]:
    """Return how this program does."""
    iterations = min(EM_ITERATIONS, size.iterations)
    return {"solver": "em", "iterations": iterations, "accelerate": True, "particle_diameter_mm": 0.05}


def channel_sections(size: ChannelSize, **changes: Any) -> dict[str, Any]:
    """Return the sections of the channel, measured with voxels; with changes, see `rig.sections`."""
    flow = {"kind": "square_duct", "width_mm": size.width_mm, "mean_velocity_m_s": MEAN_VELOCITY_M_S, "axis": "x"}
    dots = [min(7, count) for count in size.dots]
    base = sections(
        camera={"sensor": {"columns": size.columns, "rows": size.rows}},
        window=None,
        channel={"width_mm": size.width_mm, "wall_mm": 5.0},
        board=BOARD | {"dots": dots, "spacing_mm": size.spacing_mm, "medium": "air"},
        volume={
            "shape_xyz": [round(side / VOXEL_MM) for side in size.volume_mm],
            "voxel_mm": VOXEL_MM,
            "reference": "mid_plane",
        },
        correlation={"windows": list(size.windows), "overlap": 0.5, "dt_s": 0.0018},
        simulation=MISALIGNED
        | {
            "flow": flow,
            "particles": size.particles,
            "particle_diameter_mm": 0.05,
            "board_z_mm": BOARD_Z_MM,
            "mid_plane_z_mm": MID_PLANE_Z_MM,
            "distortion_per_mm2": 1.0e-5,
            "rays": size.rays,
            "seed": SEED,
        },
    )
    return merged(base, changes)


# The paper's mean velocities, DLFC's and ERT's, m/s, and the share of vectors within a quarter of the truth, per cent.
PAPERS_MEAN_M_S = (0.1150, 0.1009)
PAPERS_WITHIN_25 = 75.0
WAYS = {
    "dlfc": "rays fitted to boards (DLFC), SART",
    "ert": "equivalent points (ERT), SART",
    "volumes": "volumes: ERT, EM, voxels as the paper's",
    "fine": "volumes: ERT, EM, voxels left to the program",
    "particles": "particles",
}
# Boards at several depths take longest, then particles and fine voxels.
TINY_WAYS = ("ert", "fine")
QUICK_WAYS = ("ert", "volumes", "fine", "particles")
# What the pictures show.
SHOWN = {
    "dlfc": "DLFC, as the paper",
    "ert": "ERT, as the paper",
    "fine": "volumes at their best",
    "particles": "particles",
}

# What the program does at its best.
BEST = "fits the tracers themselves to both images and follows them"


def table4(work: Work) -> Findings:
    """Measure one simulated flow in several ways and hold them against its analytic velocities."""
    size = work.by_size(TINY, QUICK, FULL)
    chosen = work.by_size(TINY_WAYS, QUICK_WAYS, tuple(WAYS))
    configs = {name: work.config(name, sections) for name, sections in _ways(size).items() if name in chosen}
    images = work.folder / "images"
    work.step("images", partial(_simulated, configs, images, work.console))
    found = {
        name: work.step(f"{name}_figures", partial(_measured, config, images, work.folder / name, work.console))
        for name, config in configs.items()
    }
    methods = {
        reported: _read(configs[name], work.folder / name) for name, reported in SHOWN.items() if name in configs
    }
    duct = simulated_duct(configs["ert"])
    experiment = Table(
        "The experiment (after Fig. 14)",
        ("", "paper", "here"),
        (
            ("channel's section", "10 x 10 mm", f"{size.width_mm:g} x {size.width_mm:g} mm"),
            ("wall, acrylic", "5 mm", "5 mm"),
            ("measured length", "13 mm", f"{size.length_mm:g} mm"),
            ("mean velocity", "0.1082 m/s", f"{MEAN_VELOCITY_M_S} m/s"),
            ("time between the frames", "1.8 ms", "1.8 ms"),
            ("tracers, diameter", "50 µm", "50 µm"),
            ("tracers", "0.002 per pixel", f"{size.particles / (size.columns * size.rows):.4f} per pixel"),
            ("voxels", "0.1 mm", f"{VOXEL_MM:g} mm"),
            ("interrogation windows", "16 voxels, overlap 50 %", f"{size.windows[-1]} voxels, overlap 50 %"),
            ("SART", "200 iterations, relaxation 1", f"{size.iterations} iterations, relaxation 1"),
            ("camera", "Table 2", f"Table 2, {size.columns} x {size.rows} pixels"),
            ("truth", "CFD", "series of the laminar flow"),
        ),
    )
    return Findings(
        rows=_rows(found),
        drawings=_drawings(methods, duct),
        tables=(_table(found), experiment),
        text=_text(work, size, found),
        commands=tuple(f"lfpiv validate flow work/table4/{name}.yaml -o table4-{name}" for name in configs),
        seeds=(SEED,),
    )


def _ways(size: ChannelSize) -> dict[str, dict[str, Any]]:
    """Return the sections of the config of each of `WAYS`."""
    # SART's volumes are correlated plainly
    sart = {"reconstruction": AS_PAPER | {"iterations": size.iterations}}
    best = {"reconstruction": at_best(size)}
    volumes: dict[str, Any] = {"validation": {"flow_methods": ["volumes"]}}
    # weights that are fitted to boards at several depths in the fluid
    fitted = {"board": {"dots": list(size.dots), "medium": "fluid"}, "weights": {"method": "dlfc"}}
    fine = {
        "volume": {"shape_xyz": None, "voxel_mm": None, "size_mm": size.volume_mm},
        "correlation": {"windows": None, "window_mm": size.windows[-1] * VOXEL_MM},
    }
    return {
        "dlfc": channel_sections(size, **sart, **volumes, **fitted),
        "ert": channel_sections(size, **sart, **volumes),
        "volumes": channel_sections(size, **best, **volumes),
        "fine": channel_sections(size, **best, **volumes, **fine),
        "particles": channel_sections(size, **best, validation={"flow_methods": ["particles"]}),
    }


def simulated_duct(config: Path) -> Duct:
    """Return the duct of a config that has `channel_sections`."""
    duct = duct_of(load_rig(config).simulation.flow)
    assert duct is not None
    return duct


def _simulated(configs: Mapping[str, Path], images: Path, console: Console) -> dict[str, Any]:
    """Simulate the images that all are measured from: those of the flow once, and the boards of both calibrations."""
    simulate_images(configs["ert"], images, overwrite=True, console=console)
    if "dlfc" in configs:
        settings = load_rig(configs["dlfc"])
        simulate_boards(configs["dlfc"], images, board_depths(settings), overwrite=True, console=console)
    return {"folder": images.name}


def _measured(config: Path, images: Path, folder: Path, console: Console) -> dict[str, Any]:
    """Measure the flow and return its figures."""
    measure_images(config, images, folder, overwrite=True, console=console)
    measured = _read(config, folder)
    figures = measured.figures(simulated_duct(config))
    return figures | {"voxel_mm": list(measured.field.voxel_mm)}


def _read(config: Path, folder: Path) -> Measured:
    """Return the vectors in a folder with the true flow."""
    settings = load_rig(config)
    name = "vectors" if settings.flow_methods() == ("volumes",) else "tracks_grid"
    return measured_of(folder / f"{name}.vtkhdf", settings, None, is_simulated=True)


def _rows(found: Mapping[str, Mapping[str, Any]]) -> tuple[Row, ...]:
    rows = []
    for name, paper in found["ert"]["table_4"].items():
        ours = {way: figures["table_4"][name]["ours_percent"] for way, figures in found.items()}
        rows.append(
            Row(
                "mean velocity error (%), " + ("overall" if name == "overall" else f"slice at {name}"),
                "Section 4.2" if name == "overall" else "Table 4",
                paper["paper_ert_percent"],
                paper_dlfc=paper["paper_dlfc_percent"],
                paper_ert=paper["paper_ert_percent"],
                dlfc=ours.get("dlfc"),
                ert=ours["ert"],
                best=ours.get("particles", ours["fine"]),
                reason=_reason(name, found, paper),
            )
        )
    shares = {way: 100.0 * figures["within_25_percent_streamwise"] for way, figures in found.items()}
    rows.append(
        Row(
            "vectors within 25 % of the true velocity (%)",
            "Fig. 18",
            PAPERS_WITHIN_25,
            sense="at least",
            paper_dlfc=PAPERS_WITHIN_25,
            paper_ert=PAPERS_WITHIN_25,
            dlfc=shares.get("dlfc"),
            ert=shares["ert"],
            best=shares.get("particles", shares["fine"]),
        )
    )
    return tuple(rows)


def _reason(name: str, found: Mapping[str, Mapping[str, Any]], paper: Mapping[str, float]) -> str:
    """Return by how much chance moves a slice, where ours as the paper did it errs more there than the paper's."""
    ours = {way: found[way]["table_4"][name]["ours_percent"] for way in ("dlfc", "ert") if way in found}
    worse = [way for way, error in ours.items() if error is not None and error > paper[f"paper_{way}_percent"]]
    if not worse or name == "overall":
        return ""
    axis, reported = "z" if name.startswith("z") else "y", []
    for way in worse:
        errors = np.array(found[way]["slices"][axis]["streamwise_mean_error"], dtype=np.float64)
        reported.append(f"{way.upper()}'s have an rms of {float(100.0 * np.sqrt(np.nanmean(errors**2))):.2f} %")
    scatter = f"the mean errors of single planes of windows across {axis} scatter: {', '.join(reported)}"
    return f"{scatter}; a slice of less than that is one by chance"


def _table(found: Mapping[str, Mapping[str, Any]]) -> Table:
    """Return all ways side by side."""
    rows: list[tuple[str, ...]] = [
        ("paper, DLFC", f"{PAPERS_MEAN_M_S[0]:.4f}", "6.25", "12.01", "75", "", ""),
        ("paper, ERT", f"{PAPERS_MEAN_M_S[1]:.4f}", "6.77", "12.37", "75", "", ""),
    ]
    for name, figures in found.items():
        error = figures["streamwise_mean_error"]
        pairs = zip("uvw", figures["voxel_mm"], strict=True)
        row = {
            "measured by": WAYS[name],
            "mean velocity (m/s)": f"{MEAN_VELOCITY_M_S * (1.0 + error):.4f}",
            "error of it (%)": f"{100.0 * abs(error):.3f}",
            "worst slice (%)": f"{100.0 * figures['slice_mean_error']:.3f}",
            "within 25 %, along the flow (%)": f"{100.0 * figures['within_25_percent_streamwise']:.1f}",
            "within 25 %, whole vector (%)": f"{100.0 * figures['within_25_percent_vector']:.1f}",
            "rms error of the displacement along x, y, z (µm)": ", ".join(
                f"{1e3 * voxel * figures[f'rms_{component}_voxel']:.1f}" for component, voxel in pairs
            ),
        }
        rows.append(tuple(row.values()))
    caption = f"The flow by all ways to measure it; its true mean velocity is {MEAN_VELOCITY_M_S} m/s"
    return Table(caption, tuple(row), tuple(rows))


def _drawings(methods: Mapping[str, Measured], duct: Duct) -> tuple[Drawing, ...]:
    return (
        Drawing.of("slices", slice_maps_figure, methods, duct),
        Drawing(
            "profiles",
            "Profiles of the mean velocity along the flow in the paper's slices (after Fig. 16), means along the flow; "
            "lines are the analytic flow.",
            slices_figure(methods, duct),
        ),
        Drawing.of("cumulative", cumulative_figure, methods),
    )


def _text(work: Work, size: ChannelSize, found: Mapping[str, Mapping[str, Any]]) -> tuple[str, ...]:
    whole = 100.0 * found["ert"]["within_25_percent_vector"]
    reduced = work.by_size(
        "A tiny experiment", "A reduced experiment, without DLFC", "The paper's experiment, full size"
    )
    return (
        f"{reduced}: {size.reported()}. A pair of raw images of tracers in the laminar flow of a square duct is "
        "rendered by Snell's law through wall and water, with a turned, shifted array, distortion, light's own noise "
        "and the sensor's. All ways get the same two images. ERT is calibrated by one snapshot of a board on the wall, "
        "DLFC by five boards in the water; both reconstruct by SART, "
        f"{size.iterations} iterations with relaxation 1, and correlate plainly, as the paper did. At its best the "
        f"program {work.by_size('reconstructs finer voxels by EM', BEST, BEST)}.",
        "The paper's flow runs along y, here along x: the paper's x is this program's y. A slice between two planes of "
        "windows is interpolated. The mean velocity is that of the channel times the sum of all measured velocities "
        "over that of the true ones in the same places.",
        "As the paper did it, the mean velocities are nearer to the truth here than in the paper's experiment, which "
        "had bubbles on the wall, a real flow and a real camera. The errors here are those of the method and of noise "
        "alone. What the method costs is seen in single vectors, not in means: of SART's whole vectors, depth "
        f"included, {whole:.0f} % lie within 25 % of the truth.",
    )
