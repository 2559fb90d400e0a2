"""The paper's laminar channel flow (Section 4.2) as sections of a config, at the sizes that the report has."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from lfpiv_cli.paper.rig import AS_PAPER, BOARD, MISALIGNED, merged, sections

SEED = 7
# The mean over the channel's section, m/s: 40 L/h through 1 cm2, rounded as the paper has it.
MEAN_VELOCITY_M_S = 0.1082
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
    voxel_mm, windows : of volumes and their correlation, coarse to fine
    iterations : of SART
    dots : of the boards in the fluid along x and y; the one on the wall has at most seven
    spacing_mm : of the dots
    rays : of a tracer; None: as many as its noise needs
    """

    width_mm: float
    length_mm: float
    columns: int
    rows: int
    voxel_mm: float
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

    @property
    def window_mm(self) -> float:
        """Side of the final interrogation window."""
        return self.windows[-1] * self.voxel_mm

    def told(self) -> str:
        """Return the size in words."""
        shape = " x ".join(f"{round(side / self.voxel_mm)}" for side in self.volume_mm)
        return (
            f"a channel of {self.width_mm:g} mm, {shape} voxels of {self.voxel_mm:g} mm, {self.particles} tracers, "
            f"{self.columns} x {self.rows} pixels"
        )


FULL = ChannelSize(10.0, 13.0, 2352, 1768, 0.1, (32, 16), 200, (13, 9))
QUICK = ChannelSize(5.0, 4.0, 800, 900, 0.1, (32, 16), 60, (5, 5))
TINY = ChannelSize(1.6, 1.6, 400, 400, 0.1, (8,), 5, (3, 3), 0.5, 5_000)

# Iterations of accelerated EM, which needs no more.
EM_ITERATIONS = 24


def as_paper(size: ChannelSize) -> dict[str, Any]:
    """Return how the paper reconstructs; SART's volumes are correlated plainly."""
    return AS_PAPER | {"iterations": size.iterations}


def at_best(size: ChannelSize) -> dict[str, Any]:
    """Return how this program does."""
    iterations = min(EM_ITERATIONS, size.iterations)
    return {"solver": "em", "iterations": iterations, "accelerate": True, "particle_diameter_mm": 0.05}


def channel_sections(size: ChannelSize, **changes: Any) -> dict[str, Any]:
    """Return the sections of the channel, measured with voxels; with changes, see `rig.sections`."""
    flow = {
        "kind": "square_duct",
        "width_mm": size.width_mm,
        "mean_velocity_m_s": MEAN_VELOCITY_M_S,
        "axis": "x",
    }
    dots = [min(7, count) for count in size.dots]
    base = sections(
        camera={"sensor": {"columns": size.columns, "rows": size.rows}},
        window=None,
        channel={"width_mm": size.width_mm, "wall_mm": 5.0},
        board=BOARD | {"dots": dots, "spacing_mm": size.spacing_mm, "medium": "air"},
        volume={
            "shape_xyz": [round(side / size.voxel_mm) for side in size.volume_mm],
            "voxel_mm": size.voxel_mm,
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


def dlfc_sections(size: ChannelSize) -> Mapping[str, Any]:
    """Return the changes for weights that are fitted to boards at several depths in the fluid."""
    return {"board": {"dots": list(size.dots), "medium": "fluid"}, "weights": {"method": "dlfc"}}
