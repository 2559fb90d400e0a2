"""Boards at seventeen depths (Sections 3.3 and 4.1: Table 3, Figs. 8 to 13), ideal and with a camera as real ones are.

Three methods: SART on voxels as wide as a microlens with equivalent points (ERT) and with rays fitted to the boards
(DLFC), as the paper did it, and expectation maximisation on fine voxels (best).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Literal

import numpy as np

from lfpiv_cli.arrays import Floats
from lfpiv_cli.calibration.board_pose import BoardGeometry
from lfpiv_cli.files.config import Config, load_rig
from lfpiv_cli.files.pages import Table
from lfpiv_cli.notice import written
from lfpiv_cli.paper.parts import AS_PAPER, BOARD, Drawing, Findings, Row, Work, merged, sections
from lfpiv_cli.paper.pictures import board_view, centres_figure, elongation_figure, location_figure, views_figure
from lfpiv_cli.validation import board as of_boards
from lfpiv_cli.validation.board import BoardBench, BoardSolver, board_in
from lfpiv_cli.verbs.simulate import placement_of
from lfpiv_cli.verbs.validate import bench_of, board_solver

Half = Literal["ideal", "recorded"]
Figures = dict[str, dict[str, Any]]
METHODS = {"dlfc": "DLFC", "ert": "ERT", "best": "best"}
# Of which boards are drawn as such.
VIEWED = ("ert", "best")
SEED = 1

# The paper's voxels have their centres at whole tenths of a millimetre (Table 1), and so has a volume of an even number
# of them its centre half a voxel off the focal point. It matters: dots stand at whole millimetres.
PAPERS = {
    "board": BOARD | {"medium": "fluid"},
    "volume": {"centre_mm": [-0.05, -0.05, -0.05]},
    "reconstruction": AS_PAPER | {"padding_voxel": [0, 0, 0]},
    "simulation": {"seed": SEED},
}
# Voxels of a third of a microlens hold the edge of a dot.
BEST = {
    "volume": {"shape_xyz": [240, 240, 120], "voxel_mm": [0.033333333, 0.033333333, 0.2], "centre_mm": [0.0, 0.0, 0.0]},
    "reconstruction": {"solver": "em", "iterations": 30, "accelerate": True},
}
# From what the paper did: nothing, our best, and dots on the corners of voxels.
CHANGES: dict[str, dict[str, Any]] = {"paper": {}, "best": BEST, "corners": {"volume": {"centre_mm": [0.0, 0.0, 0.0]}}}
# The assembly's tolerances and the lens of a real camera; noise and Snell's law are the simulation's defaults.
FAULTS = {"rotation_deg": 0.12, "shift_px": [3.4, -2.1], "distortion_per_mm2": 2.0e-5}

# Fewer dots on a smaller sensor, boards next to the focal plane in a shallower volume, fewer iterations.
SMALL: dict[str, dict[str, Any]] = {
    "tiny": {
        "camera": {"sensor": {"columns": 520, "rows": 520}},
        "board": {"dots": [3, 3], "spacing_mm": 0.7},
        "paper": {"volume": {"shape_xyz": [24, 24, 60]}, "reconstruction": {"iterations": 4}},
        "best": {
            "volume": {"shape_xyz": [36, 36, 30], "voxel_mm": [1.0 / 15.0, 1.0 / 15.0, 0.2]},
            "reconstruction": {"iterations": 4},
        },
    },
    "quick": {
        "camera": {"sensor": {"columns": 760, "rows": 760}},
        "board": {"dots": [3, 3]},
        "paper": {"volume": {"shape_xyz": [32, 32, 100]}, "reconstruction": {"iterations": 60}},
        "best": {"volume": {"shape_xyz": [96, 96, 50]}, "reconstruction": {"iterations": 30}},
    },
    "full": {},
}
# How far from the focal plane boards stand.
REACH_MM = {"tiny": 1, "quick": 2, "full": 8}
# Fig. 9 and Fig. 12: the elongation's range, and what its spread stays below; Fig. 11: the depth separations' range.
PAPERS_ELONGATION_MM = {"ideal": (3.1, 3.9), "recorded": (3.1, 4.0)}
PAPERS_SPREAD_MM = {"ideal": 0.15, "recorded": 0.4}
PAPERS_STEPS_MM = {"ideal": (0.92, 1.08), "recorded": None}
SOURCE = {"ideal": "numerical", "recorded": "experiment (here simulated)"}
SCENES = {
    "ideal": "photographed with the camera of Table 2 without noise, light refracted paraxially.",
    "recorded": (
        "simulated, not photographed, as an experiment may have had them: the array turned by 0.12 degrees and "
        "shifted, a main lens that distorts, noise of light and sensor, light refracted by Snell's law. The camera is "
        "calibrated from a white picture and one board in air; weights are paraxial."
    ),
}
FIGURES = {"ideal": ("Fig. 9", "Fig. 11"), "recorded": ("Fig. 12", "Fig. 13")}
CORNERS = (
    "With the middle of the volume in the focal point, dots stand on the corners of voxels and of microlenses at once. "
    "There the same definition has 5.2 % at full size, nearly all of it next to the focal plane, and the dots are "
    "longest in the focal plane, where the paper's are shortest: the paper's dots did not stand so."
)
REDUCED = " Reduced: fewer boards and dots, a smaller sensor and volume, fewer iterations."
# Dots next to the focal plane have uneven depth profiles.
NEAR_MM = 2.0

QUANTITIES = {
    "elongation_mm": ("elongation e_z (mm)", 1.0),
    "elongation_sigma_mm": ("spread of the elongation, sigma (mm)", 1.0),
    "lateral_error": ("lateral error delta_x (%)", 100.0),
    "depth_error": ("depth error delta_z (%)", 100.0),
}


@dataclass(frozen=True, eq=False)
class _Boards:
    """The boards of one half of Table 3; pictures, benches and solvers are made when a board first needs them.

    `ways` are those by the methods that boards have needed so far.
    """

    half: Half
    depths_mm: tuple[float, ...]
    paper: Config
    best: Config
    ways: dict[str, tuple[BoardBench, BoardSolver]] = field(default_factory=dict)

    @property
    def board(self) -> BoardGeometry:
        """The board itself."""
        return self.paper.rig().board

    @cached_property
    def bench(self) -> BoardBench:
        """Weights and picture-taking as the paper did it, by equivalent points."""
        return bench_of(self.paper, self.half)

    @cached_property
    def pictures(self) -> list[Any]:
        """One for each depth, in their order, as random numbers are drawn for one after the other."""
        return [self.bench.picture(placement_of(self.paper, depth)) for depth in self.depths_mm]

    def measure(self, method: str, number: int, advance: Callable[[int], None]) -> dict[str, Any]:
        """Reconstruct one board and return what is measured of it, as plain data, and of the middle one a view."""
        if method not in self.ways:
            bench = self.bench
            if method == "best":
                bench = bench.with_voxels(self.best.grid(), self.best.plane_space("validating boards"))
            elif method == "dlfc":
                bench = bench.with_fitted_rays(self.pictures, self.depths_mm)
            self.ways[method] = bench, board_solver(bench, self.best if method == "best" else self.paper)
        (bench, solve), depth = self.ways[method], self.depths_mm[number]
        placement = placement_of(self.paper, depth)
        dots, volume, residual = board_in(bench, solve, self.pictures[number], placement, advance)
        view = board_view(volume, bench.weights.grid) if depth == 0.0 else None
        return {"dots": vars(dots), "view": view, "residual": residual}


def _config(work: Work, half: Half, name: str) -> Path:
    """Write a config of `CHANGES` for a half of the table and return its path."""
    small = SMALL[work.size]
    size = {key: small.get(key, {}) for key in ("camera", "board")}
    size |= small.get("best" if name == "best" else "paper", {})
    own = merged(merged(PAPERS, CHANGES[name]), size)
    asked = {"images": half, "methods": ["ert", "dlfc"] if name == "paper" else ["ert"]}
    faults = FAULTS if half == "recorded" else {}
    return work.config(name, sections(**merged(own, {"simulation": faults, "validation": {"board": asked}})))


def table3(work: Work, half: Half) -> Findings:
    """Reconstruct and measure boards: of an ideal camera (Section 3.3), or of one with faults and noise (4.1)."""
    configs = {name: _config(work, half, name) for name in (CHANGES if half == "ideal" else ("paper", "best"))}
    depths = tuple(depth for depth in of_boards.DEPTHS_MM if abs(depth) <= REACH_MM[work.size])
    boards = _Boards(half, depths, load_rig(configs["paper"]), load_rig(configs["best"]))
    steps: dict[str, list[dict[str, Any]]] = {}
    for method in ("ert", "best", "dlfc"):
        # each board a step of its own
        settings, steps[method] = boards.best if method == "best" else boards.paper, []
        rounds = settings.reconstruction.iterations * len(boards.depths_mm)
        with work.console.progress(rounds, METHODS[method]) as advance:
            for number, depth in enumerate(boards.depths_mm):
                measure = partial(boards.measure, method, number, advance)
                steps[method].append(work.step(f"{method}_{depth:+.0f}mm", measure))
        work.console.say(f"{work.folder.name}: {METHODS[method]}, {len(steps[method])} boards")
    dots = {method: [of_boards.DotFigures.from_plain(each["dots"]) for each in steps[method]] for method in METHODS}
    figures = {
        method: of_boards.board_figures(each, boards.depths_mm, boards.board.dots, boards.board.spacing_mm)
        for method, each in dots.items()
    }
    # by every definition: what the paper's words leave open
    definitions = []
    for name, definition in of_boards.DEPTH_DEFINITIONS.items():
        found = {method: figures[method]["depth_definitions"][name] for method in METHODS}
        errors = (f"{100.0 * each['error']:.2f}" for each in found.values())
        words = definition.words + (" (used)" if name == of_boards.THE_PAPERS else "")
        definitions.append((words, *errors, f"{found['ert']['shortest']:.3f} to {found['ert']['longest']:.3f}"))
    head = ("depth of a dot", *METHODS.values(), "separations, ERT (mm)")
    depth_errors = Table("Depth error (%) by what is taken for the depth of a dot", head, tuple(definitions))
    middle = boards.depths_mm.index(0.0)
    kept = {METHODS[method]: steps[method][middle]["view"] for method in VIEWED}
    views = {
        reported: {name: np.array(each, np.float64) for name, each in view.items()} for reported, view in kept.items()
    }
    return Findings(
        rows=tuple(_row(boards, measure, figures) for measure in of_boards.MEASURES),
        drawings=_drawings(boards, figures, views, dots),
        tables=(depth_errors,),
        text=_text(work, boards, figures),
        commands=tuple(
            f"lfpiv validate board work/{work.folder.name}/{name}.yaml -o {work.folder.name}-{name}" for name in configs
        ),
        seeds=(SEED,),
    )


def _row(boards: _Boards, measure: str, figures: Figures) -> Row:
    half, spacing_mm = boards.half, boards.board.spacing_mm
    quantity, scale = QUANTITIES[measure]
    # rounded: 100 x 0.056 is not 5.6
    paper = {method: round(scale * of_boards.PAPER[half, method][measure], 9) for method in ("dlfc", "ert")}
    ours = {method: scale * each[measure] for method, each in figures.items()}
    reason = ""
    if ours["ert"] > paper["ert"]:
        # at which depths it is made
        table = figures["ert"]["by_depth"]
        depth = np.array(table["depth_mm"])
        if measure == "depth_error":
            errors = np.abs(np.diff(table["centre_mm"]) / np.diff(depth) - 1.0)
            near = np.abs(0.5 * (depth[1:] + depth[:-1])) < NEAR_MM
            share, steps = errors[near].sum() / errors.sum(), f"{near.sum()} steps within {NEAR_MM:g} mm"
            reason = f"{100.0 * share:.0f} % of it comes from the {steps} of the focal plane"
            if not near.all():
                reason += f"; the others err by {100.0 * errors[~near].mean():.2f} %"
        else:
            off = 100.0 * np.abs(np.array(table["spacing_mm"]) / spacing_mm - 1.0)
            values, unit = (off, "%") if measure == "lateral_error" else (np.array(table[measure]), "mm")
            worst, middle = int(np.argmax(values)), f"median over the depths {written(np.median(values))} {unit}"
            reason = f"largest at z = {depth[worst]:+.0f} mm, {written(values[worst])} {unit}; {middle}"
    return Row(
        quantity,
        f"Table 3, {SOURCE[half]}",
        paper["ert"],
        paper_dlfc=paper["dlfc"],
        paper_ert=paper["ert"],
        **ours,
        reason=reason,
    )


def _drawings(
    boards: _Boards, figures: Figures, views: dict[str, dict[str, Floats]], dots: dict[str, list[of_boards.DotFigures]]
) -> tuple[Drawing, ...]:
    half = boards.half
    named = {METHODS[method]: each for method, each in figures.items()}
    lengths, places = FIGURES[half]
    centres = {
        METHODS[m]: np.concatenate([np.column_stack([d.lateral_mm, d.depth_mm[of_boards.THE_PAPERS]]) for d in dots[m]])
        for m in VIEWED
    }
    steps = PAPERS_STEPS_MM[half]
    return (
        Drawing.of("board", views_figure, views),
        Drawing(
            "elongation",
            f"Elongation of the dots by depth, mean and standard deviation over the dots (after {lengths}). Grey: the "
            "range that the paper gives.",
            elongation_figure(named, PAPERS_ELONGATION_MM[half], PAPERS_SPREAD_MM[half]),
        ),
        Drawing.of("centres", centres_figure, centres),
        Drawing(
            "places",
            f"Lateral spacing and separation in depth, and their errors (after {places})."
            + (" Grey: the range that the paper gives." if steps else ""),
            location_figure(named, boards.board.spacing_mm, steps),
        ),
    )


def _text(work: Work, boards: _Boards, figures: Figures) -> tuple[str, ...]:
    board, volume = boards.board, boards.paper.grid()
    solver, best = boards.paper.reconstruction, boards.best.reconstruction
    deepest = boards.depths_mm[-1]
    steps, table = figures["ert"]["depth_definitions"][of_boards.THE_PAPERS], figures["ert"]["by_depth"]
    middle = boards.depths_mm.index(0.0)
    lengths = np.array(table["elongation_mm"])
    return (
        f"{len(boards.depths_mm)} boards of {board.dots[0]} x {board.dots[1]} dots from {-deepest:g} to {deepest:g} "
        f"mm, {SCENES[boards.half]} As the paper did it: {solver.solver.upper()}, {solver.iterations} iterations, "
        f"{' x '.join(str(n) for n in volume.shape_xyz)} voxels of 0.1 mm, with equivalent points (ERT) and with rays "
        f"fitted to the boards' own pictures (DLFC). At its best: {best.solver.upper()}, {best.iterations} accelerated "
        f"iterations, voxels of {' x '.join(written(mm) for mm in boards.best.grid().spacing_mm)} mm with "
        f"equivalent points.{'' if work.size == 'full' else REDUCED}",
        "The paper says that depths are those of Gaussian peak fittings, not of what, nor where its voxels lie among "
        "the dots. Both matter next to the focal plane, where a voxel is as wide as a microlens and the depth profile "
        "of a dot is not even. Taken here: a Gaussian through the sum of each plane of a dot's column, over all "
        "depths, fitted dot by dot, then averaged; and voxels with their centres at whole tenths of a millimetre, as "
        "those of Table 1 have them, so that dots stand on the centres of voxels. By this, ERT's separations are "
        f"{steps['shortest']:.2f} to {steps['longest']:.2f} mm (the paper's numerical ones: 0.92 to 1.08 mm), and e_z "
        f"is {lengths[middle]:.2f} mm in the focal plane and {np.delete(lengths, middle).mean():.2f} mm elsewhere (the "
        "paper's is shorter in the focal plane). A table below has other definitions.",
        *((CORNERS,) if boards.half == "ideal" else ()),
    )
