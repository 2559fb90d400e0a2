"""The calibration file: all that `calibration.model.Calibration` holds, as HDF5.

Layout, version 1: `image_shape` (rows, columns), `lattice` (centres and model of the lens images, pixels as (column,
row)), `transmission`, `white` and `shadowed` (rows, columns), `board` (pose, mm and degrees), `dlfc` (rays fitted to
boards at several depths), `scene` (where the faces lie), and the channel's mid plane (mm). A weights file holds the
same as a group.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from lfpiv_cli.calibration.board_pose import BoardPose
from lfpiv_cli.calibration.dlfc import RayFit
from lfpiv_cli.calibration.lattice import EXPONENTS, LatticeFit
from lfpiv_cli.calibration.model import Calibration
from lfpiv_cli.calibration.rectification import Rectification
from lfpiv_cli.errors import InputError
from lfpiv_cli.files.hdf5 import read_tree, write_tree
from lfpiv_cli.optics.camera import Lattice
from lfpiv_cli.optics.shapes import ScenePose
from lfpiv_cli.optics.tracing import LARGEST_DEGREE, VARIABLES, PolynomialRays

FORMAT = "lfpiv-calibration"
VERSION = 1
# Of the arrays whose names do not say them.
UNITS = {"image_shape": "pixel", "transmission": "1", "white": "1", "shadowed": "1", "indices": "1", "exponents": "1"}
# Of the whole sensor; None where they were not measured.
PICTURES = ("transmission", "white", "shadowed")

Shape = tuple[int | None, ...]

# Numbers at the root, None where they are not known.
CARRIED = ("camera_move_mm", "mid_plane_z_mm", "mid_plane_z_sigma_mm", "image_distance_mm", "image_distance_sigma_mm")
UNKNOWN = (*CARRIED, "k1_per_mm2", "k1_sigma_per_mm2", "entrance_pupil_mm", "entrance_pupil_sigma_mm")
# Groups and texts, which are no numbers.
NO_NUMBERS = ("layout", "rays", "faces_sha256")
# Shapes of the arrays, None for any length; all else is a single number.
SHAPES: Mapping[str, Shape] = {
    **dict.fromkeys(("indices", "centres_px", "dots_px"), (None, 2)),
    **dict.fromkeys(("dots_mm", "dots_sigma_mm", "residual_mm"), (None, 3)),
    **dict.fromkeys(("residual_px", "residual_affine_px", "pitch_sigma_px", "origin_sigma_px", "origin_px"), (2,)),
    **dict.fromkeys(("tilt_deg", "tilt_sigma_deg", "offset_mm", "offset_sigma_mm"), (2,)),
    "basis_px": (2, 2),
    "cubic_px": (len(EXPONENTS), 2),
}
OF_RAY_FIT: Mapping[str, Shape] = {"depths_mm": (None,), "reach_mm": (2, 2), "residual_mm": (None, 2)}
OF_RAYS: Mapping[str, Shape] = {
    "scale_mm": (VARIABLES,),
    "exponents": (None, VARIABLES),
    "coefficients_mm": (None, 2),
}
OF_SCENE: Mapping[str, Shape] = dict.fromkeys(
    ("shift_mm", "turn_deg", "pivot_mm", "shift_sigma_mm", "turn_sigma_deg"), (3,)
)


def write_calibration(path: Path, calibration: Calibration, provenance: Mapping[str, Any], overwrite: bool) -> None:
    """Write a calibration."""
    write_tree(
        path,
        tree_of(calibration),
        format_name=FORMAT,
        format_version=VERSION,
        provenance=provenance,
        overwrite=overwrite,
        units=UNITS,
    )


def open_calibration(path: Path | str) -> Calibration:
    """Read a calibration.

    Returns
    -------
    Calibration
        As `calibrate` gives it.

    Raises
    ------
    InputError
        The file is missing, broken, or of another format or version.
    """
    tree, provenance = read_tree(Path(path), FORMAT, VERSION)
    try:
        return replace(calibration_of(tree), provenance=provenance)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def tree_of(calibration: Calibration) -> dict[str, Any]:
    """Return everything as a nested dict of arrays, numbers, strings and None."""
    fit = asdict(calibration.fit)
    lattice = fit.pop("lattice_px")
    fit |= {"layout": lattice["layout"], "origin_px": lattice["origin"], "basis_px": lattice["basis"]}
    parts = {"board": calibration.pose, "dlfc": calibration.ray_fit, "scene": calibration.scene}
    return {
        "image_shape": np.array(calibration.image_shape, dtype=np.int64),
        "lattice": fit | {"cubic_used": int(calibration.fit.cubic_used)},
        "transmission": calibration.transmission,
        "white": calibration.white,
        "shadowed": None if calibration.shadowed is None else calibration.shadowed.astype(np.uint8),
        **{name: None if part is None else asdict(part) for name, part in parts.items()},
        "mid_plane_given": 1 if calibration.mid_plane_given else None,
        **{name: getattr(calibration, name) for name in CARRIED},
    }


def calibration_of(tree: Mapping[str, Any]) -> Calibration:
    """Return the calibration that `tree_of` took apart.

    Raises
    ------
    InputError : something is missing, of another shape, or what it cannot be
    """
    try:
        rows, columns = (int(n) for n in tree["image_shape"])
        carried = _checked({name: tree.get(name) for name in CARRIED})
        fit, pictures = _checked(tree["lattice"]), [tree.get(name) for name in PICTURES]
        for name, picture in zip(PICTURES, pictures, strict=True):
            if picture is not None:
                _checked({name: picture}, {name: (rows, columns)})
                if not np.isfinite(picture).all():
                    raise ValueError(f"a {name} is not a finite number")
        passed, white, shadows = pictures
        lattice = Lattice(fit.pop("origin_px"), fit.pop("basis_px"), fit.pop("layout"))
        fit["cubic_used"] = bool(fit["cubic_used"])
        ray_fit, scene = None, None
        if tree.get("dlfc"):
            reported = _checked(tree["dlfc"], OF_RAY_FIT)
            rays = PolynomialRays(**_checked(reported.pop("rays"), OF_RAYS))
            if not 0 < len(rays.exponents) == len(rays.coefficients_mm):
                raise ValueError(f"{len(rays.exponents)} terms of {len(rays.coefficients_mm)} coefficients")
            if not np.isin(rays.exponents, range(LARGEST_DEGREE + 1)).all() or rays.degree > LARGEST_DEGREE:
                raise ValueError(f"polynomials with exponents up to {rays.exponents.max()}")
            if not np.isfinite(rays.coefficients_mm).all() or not np.all(rays.scale_mm > 0.0):
                raise ValueError("polynomials with coefficients that are no numbers")
            ray_fit = RayFit(rays=rays, **reported)
        if tree.get("scene"):
            scene = ScenePose(**_checked(tree["scene"], OF_SCENE))
            if not all(np.isfinite(getattr(scene, name)).all() for name in OF_SCENE):
                raise ValueError("a scene's place is not a finite number")
        return Calibration(
            Rectification(LatticeFit(lattice_px=lattice, **fit), (rows, columns)),
            passed,
            BoardPose(**_checked(tree["board"])) if tree.get("board") else None,
            ray_fit=ray_fit,
            mid_plane_given=bool(tree.get("mid_plane_given")),
            scene=scene,
            white=white,
            shadowed=None if shadows is None else shadows.astype(np.bool_),
            **carried,
        )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(f"the calibration is not complete ({error}); make it again") from error


def _checked(group: Mapping[str, Any], shapes: Mapping[str, Shape] = SHAPES) -> dict[str, Any]:
    """Return what a group holds; numbers of other shapes than these are a `ValueError`."""
    for name, value in group.items():
        if name in NO_NUMBERS or (value is None and name in UNKNOWN):
            continue
        found, expected = np.asarray(value), shapes.get(name, ())
        fits = found.ndim == len(expected) and all(n in (None, m) for n, m in zip(expected, found.shape, strict=True))
        if not fits or found.dtype.kind not in "biuf":
            kind = f"numbers of the shape {found.shape}" if found.dtype.kind in "biuf" else "no numbers"
            words = " x ".join("n" if n is None else str(n) for n in expected)
            raise ValueError(f"{name} holds {kind}, expected {words + ' numbers' if expected else 'a number'}")
    return dict(group)
