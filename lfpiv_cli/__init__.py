"""lfpiv: from raw light-field camera images to three-dimensional velocity fields.

The five steps, arrays in and arrays out::

    import lfpiv_cli as lf

    rig = lf.load_rig("rig.yaml")
    calibration = lf.calibrate(white, board, rig, dark=dark)
    weights = lf.build_weights(rig, calibration)
    a, b = (lf.reconstruct(weights, image, dark=dark) for image in (image_a, image_b))
    field = lf.correlate(a, b)                     # field.velocity (nz, ny, nx, 3), m/s

or with the particles themselves in place of volumes (particle tracking velocimetry)::

    p, q = (lf.find_particles(weights, image, dark=dark) for image in (image_a, image_b))
    tracks = lf.track(p, q)                        # tracks.points.position_mm, .arrays["velocity"]
    field = lf.combine(field, tracks.vectors()[0]).field

and in a time-resolved sequence both at once, each frame predicted by those before it (as in Shake-The-Box)::

    found = lf.follow(weights, images, dark=dark)  # found.particles of each frame, found.tracks

Images are (rows, columns) arrays of counts; `read_image` reads one. `open_calibration`, `open_weights`, `open_volume`,
`open_vectors`, `open_particles` and `open_tracks` read the files that the commands write, and what they return goes
into the functions above. Volumes and fields are indexed [z, y, x]; points and vectors are (x, y, z) in mm, m/s.

Each command is a function as well, files in and files out, with its options as a dataclass::

    from lfpiv_cli.verbs.reconstruct import ReconstructOptions, reconstruct_files

    reconstruct_files(Path("weights.h5"), images, Path("volumes"), ReconstructOptions(dark=Path("dark.tif")))

likewise `lfpiv_cli.verbs.calibrate`, `.build_weights`, `.correlate`, `.track`, `.follow` and so on. All that can go
wrong is an `LfpivError` of `lfpiv_cli.errors`, whose message names the place, what was found and what was expected;
what speaks against a result is an `LfpivWarning`.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from lfpiv_cli.files.kernel_cache import ensure_place
from lfpiv_cli.results import Result

if TYPE_CHECKING:
    from lfpiv_cli.errors import LfpivError as LfpivError
    from lfpiv_cli.files.calibration_file import open_calibration as open_calibration
    from lfpiv_cli.files.config import load_rig as load_rig
    from lfpiv_cli.files.images import read_image as read_image
    from lfpiv_cli.files.particle_file import open_particles as open_particles
    from lfpiv_cli.files.particle_file import open_tracks as open_tracks
    from lfpiv_cli.files.vtkhdf import open_vectors as open_vectors
    from lfpiv_cli.files.vtkhdf import open_volume as open_volume
    from lfpiv_cli.files.weights_file import open_weights as open_weights
    from lfpiv_cli.notice import LfpivWarning as LfpivWarning
    from lfpiv_cli.verbs.build_weights import build_weights as build_weights
    from lfpiv_cli.verbs.calibrate import calibrate as calibrate
    from lfpiv_cli.verbs.combine import combine as combine
    from lfpiv_cli.verbs.correlate import correlate as correlate
    from lfpiv_cli.verbs.fields import fit_field as fit_field
    from lfpiv_cli.verbs.following import follow as follow
    from lfpiv_cli.verbs.moments import statistics as statistics
    from lfpiv_cli.verbs.particles import find_particles as find_particles
    from lfpiv_cli.verbs.reconstruct import reconstruct as reconstruct
    from lfpiv_cli.verbs.tracks import track as track

__version__ = "0.1.0"

# What is promised, and where each name is from: they are imported when they are asked for, so that `lfpiv --help` need
# not wait for them.
MODULES = {
    "LfpivError": "errors",
    "LfpivWarning": "notice",
    "build_weights": "verbs.build_weights",
    "calibrate": "verbs.calibrate",
    "combine": "verbs.combine",
    "correlate": "verbs.correlate",
    "find_particles": "verbs.particles",
    "fit_field": "verbs.fields",
    "follow": "verbs.following",
    "load_rig": "files.config",
    "open_calibration": "files.calibration_file",
    "open_particles": "files.particle_file",
    "open_tracks": "files.particle_file",
    "open_vectors": "files.vtkhdf",
    "open_volume": "files.vtkhdf",
    "open_weights": "files.weights_file",
    "read_image": "files.images",
    "reconstruct": "verbs.reconstruct",
    "statistics": "verbs.moments",
    "track": "verbs.tracks",
}
__all__ = ["__version__", *MODULES]

# Before any kernel, and any result, is imported.
ensure_place()
Result.ways = staticmethod(lambda: import_module(f"{__name__}.verbs.results"))


def __getattr__(name: str) -> Any:
    """Return what is promised, imported when it is asked for."""
    if name not in MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{MODULES[name]}"), name)


def __dir__() -> list[str]:
    """Return the names that are promised."""
    return sorted(__all__)
