"""The parts of the report, in the order in which they are made and shown; a new one is a line here and in `names`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from lfpiv_cli.names import PaperPart
from lfpiv_cli.paper.bubbles import bubbles
from lfpiv_cli.paper.discussion import discussion
from lfpiv_cli.paper.faults import faults
from lfpiv_cli.paper.focal_plane import focal_plane
from lfpiv_cli.paper.parts import Findings, Work
from lfpiv_cli.paper.sensitivities import sensitivities
from lfpiv_cli.paper.table1 import table1
from lfpiv_cli.paper.table2 import table2
from lfpiv_cli.paper.table3 import table3, table3_experiment
from lfpiv_cli.paper.table4 import table4


@dataclass(frozen=True)
class Part:
    """A part: what makes it, what of the paper it covers, and how long it takes on two cores, quick and full."""

    find: Callable[[Work], Findings]
    title: str
    quick_minutes: float
    full_minutes: float


PARTS: dict[PaperPart, Part] = {
    "table1": Part(table1, "Weights of single voxels (Table 1, Figs. 5 and 6)", 0.5, 4.0),
    "table2": Part(table2, "The camera (Table 2)", 0.01, 0.01),
    "table3": Part(table3, "Boards, an ideal camera (Table 3, numerical; Figs. 8 to 11)", 0.8, 20.0),
    "table3-experiment": Part(
        table3_experiment,
        "Boards, a camera as real ones are, simulated (Table 3, experiment; Figs. 12 and 13)",
        0.8,
        22.0,
    ),
    "focal-plane": Part(focal_plane, "The focal plane from one snapshot (Eq. 21)", 0.5, 3.0),
    "table4": Part(table4, "The laminar channel flow (Section 4.2, Figs. 14-16 and 18, Table 4)", 1.2, 15.0),
    "bubbles": Part(bubbles, "Bubbles on the wall (Fig. 17)", 0.5, 2.5),
    "discussion": Part(discussion, "Depth resolution and seeding (the paper's discussion)", 0.1, 0.5),
    "sensitivities": Part(sensitivities, "What matters, and how much", 2.0, 8.0),
    "faults": Part(faults, "Planted mistakes", 0.3, 0.3),
}
