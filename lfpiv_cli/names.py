"""The names that a configuration, a command and the code share: each list stands here once.

Nothing heavy is imported, as `--help` shows them. Solvers have a registry of their own, `reconstruction.registry`, and
flows theirs, `synthetic.flows`.
"""

from __future__ import annotations

from typing import Any, Literal, get_args

# The cameras that `init` knows: the paper's, and two microscopes of which only the lattice is known.
KnownCamera = Literal["table2", "guv", "seaurchin"]

# The microlens array, and the calibration target: what is on it, what it stands in, and its dots beside its ground.
Layout = Literal["square", "hexagonal"]
Pattern = Literal["dots", "chessboard", "charuco"]
Medium = Literal["air", "fluid"]
Polarity = Literal["auto", "bright", "dark"]

# The world axis that the sensor's columns follow.
ColumnAxis = Literal["x", "y"]

# The faces at which light is refracted; and how a round one faces the camera: bulging towards it, or hollow.
SurfaceKind = Literal["plane", "tilted_plane", "cylinder", "sphere", "height_map"]
Facing = Literal["convex", "concave"]

# Where the coordinates of volumes, vectors and points begin.
ReferenceName = Literal["focal_point", "mid_plane"]

# How rays are found: by equivalent points, traced through window and fluid, or fitted to boards at several depths; what
# they are refracted by; and how they are added up.
TracedMethod = Literal["ert", "drt"]
Method = Literal[TracedMethod, "dlfc"]
Refraction = Literal["paraxial", "exact"]
Sampling = Literal["exact", "rays"]

# How voxels count by their place in an interrogation window.
Weighting = Literal["uniform", "gaussian"]

# The section whose walls mask what lies beyond them.
Mask = Literal["channel", "pipe"]

# The wall of a channel that simulated bubbles stick to: across the depth the nearest or farthest one, across the other
# axis that of its low or high end.
BubbleWall = Literal["near", "far", "low", "high"]

# What a solver starts from, and which frames belong together.
Start = Literal["uniform", "line_of_sight"]
Pairing = Literal["ab", "sequence"]

# What a command takes by the thousand: images, or what other commands made of them.
InputKind = Literal["images", "results"]

# What `run` leaves in its folder.
Kept = Literal["all", "results"]

# How `run` measures a flow.
RunMethod = Literal["auto", "volumes", "particles", "both"]

# What is known of a field's divergence: it is held down as far as the data ask for, there is none, or nothing.
Divergence = Literal["penalised", "free", "off"]

# What is validated: flows and boards by which methods, boards in which images, and volumes of which moment of a pair.
GridMethod = Literal["polynomials", "spline"]
FlowMethod = Literal["volumes", "particles"]
BoardMethod = Literal["ert", "dlfc", "discs"]
BoardImages = Literal["ideal", "recorded", "both"]
Moment = Literal["a", "middle", "b"]

# The parts of the report on the paper in their order, and how large they are computed: for a test, within ten minutes,
# or as the paper did.
PaperPart = Literal[
    "table1",
    "table2",
    "table3",
    "table3-experiment",
    "focal-plane",
    "table4",
    "bubbles",
    "discussion",
    "sensitivities",
    "faults",
]
Size = Literal["tiny", "quick", "full"]


# The formats of other programs that results are exported to.
ExportFormat = Literal["netcdf", "tecplot", "csv", "mat", "vti", "vtp", "vtkhdf-series"]


def names_in(kind: Any) -> tuple[str, ...]:
    """Return the names of one of the kinds above, in their order."""
    return get_args(kind)
