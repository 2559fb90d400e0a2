"""A calibration: what a white image and the picture of a board tell about a camera.

Axes: pixels are (column, row); world axes are those of the raw sensor, z away from the camera from the focal point.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from threadpoolctl import threadpool_limits

from lfpiv_cli.arrays import Flags, Floats, Singles
from lfpiv_cli.calibration import white as of_white
from lfpiv_cli.calibration.board import PictureFrame, locate_board
from lfpiv_cli.calibration.board_pose import BoardGeometry, BoardPose
from lfpiv_cli.calibration.dlfc import RayFit, fit_rays
from lfpiv_cli.calibration.lattice import LatticeFit, fit_lattice, shadowed
from lfpiv_cli.calibration.light_checks import check_residual
from lfpiv_cli.calibration.rectification import Rectification
from lfpiv_cli.calibration.sheet import check_pitch, image_distance_mm, sheet_fit
from lfpiv_cli.calibration.wave_shapes import WaveLight
from lfpiv_cli.calibration.white import NARROWEST_LENS_IMAGE
from lfpiv_cli.errors import InputError
from lfpiv_cli.names import Layout
from lfpiv_cli.optics.camera import Camera, refocused
from lfpiv_cli.optics.media import Media
from lfpiv_cli.optics.shapes import ScenePose
from lfpiv_cli.results import Result

# A measured magnification replaces the data sheet's when it differs by more standard errors than chance explains.
MAGNIFICATION_SIGMAS = 3.0


@dataclass(frozen=True)
class Channel:
    """The channel that is looked into after the board: its inner width, its wall, and the camera's move in between.

    `camera_move_mm` is positive towards the channel; None stands for the advised one, Eq. 21's. A board in the fluid
    stood `board_from_mid_plane_mm` behind the mid plane; None: nobody knows.
    """

    width_mm: float
    wall_mm: float
    camera_move_mm: float | None = None
    board_from_mid_plane_mm: float | None = None


@dataclass(frozen=True, eq=False)
class Rig:
    """What must be known of the bench to read the picture of a board.

    Attributes
    ----------
    camera : as the data sheet has it
    media : refractive indices in front of it
    board : the dots
    channel : to tell its mid plane; None where there is none
    light : waves that a single board's dots send; None: rays
    """

    camera: Camera
    media: Media
    board: BoardGeometry
    channel: Channel | None = None
    light: WaveLight | None = None


@dataclass(frozen=True, eq=False, repr=False)
class Calibration(Result):
    """What was measured.

    Attributes
    ----------
    rectification : lattice of the raw image and the way to an upright one
    transmission : (rows, columns) float32, share of light that pixels pass, rectified, 0 where unusable; or None
    pose : of the board, or None
    camera_move_mm : d_m of Eq. 21, or None
    mid_plane_z_mm, mid_plane_z_sigma_mm : depth of the channel's mid plane in the fluid, or None
    mid_plane_given : that depth was told and not measured, its uncertainty is not known
    image_distance_mm, image_distance_sigma_mm : s_i by the pitch of the lens images, a check of the data sheet, or None
    ray_fit : polynomials of rays from boards at several depths, in the rectified frame, or None
    scene : where the faces before the fluid lie, from where the config has them, or None
    white : (rows, columns) float32, raw uniform light over that of a full lens image, where the transmission is known
    shadowed : (rows, columns) raw pixels in the shadow of a speck, where the transmission is known
    provenance : the record of how it was made
    """

    rectification: Rectification
    transmission: Singles | None = None
    pose: BoardPose | None = None
    camera_move_mm: float | None = None
    mid_plane_z_mm: float | None = None
    mid_plane_z_sigma_mm: float | None = None
    image_distance_mm: float | None = None
    image_distance_sigma_mm: float | None = None
    ray_fit: RayFit | None = None
    mid_plane_given: bool = False
    scene: ScenePose | None = None
    white: Singles | None = None
    shadowed: Flags | None = None
    provenance: dict[str, Any] = field(default_factory=dict)

    @property
    def fit(self) -> LatticeFit:
        """The lattice of the raw image."""
        return self.rectification.fit

    @property
    def image_shape(self) -> tuple[int, int]:
        """(rows, columns) of the images it serves."""
        return self.rectification.image_shape

    def camera(self, camera: Camera) -> Camera:
        """Return the data sheet's camera with the measured lattice, rectified, magnification, distortion and pupils.

        Raises
        ------
        InputError : when the calibration was made with another sensor
        """
        self.ensure_images_of(camera)
        if self.pose is not None:
            difference = abs(self.pose.magnification - camera.magnification)
            if difference > MAGNIFICATION_SIGMAS * self.pose.magnification_sigma:
                camera = refocused(camera, self.pose.magnification)
            camera = replace(camera, distortion_per_mm2=self.pose.distortion_per_mm2)
        if self.ray_fit is not None:
            camera = self.ray_fit.behind_its_pupil(camera)
        return camera.with_micro_images(self.rectification.lattice_px)

    def ensure_images_of(self, camera: Camera) -> None:
        """Refuse a camera with another sensor.

        Raises
        ------
        InputError
        """
        if self.image_shape != (camera.rows, camera.columns):
            raise InputError(
                f"the calibration was made with images of {self.image_shape[0]} x {self.image_shape[1]} pixels (rows x "
                f"columns) and the configured sensor has {camera.rows} x {camera.columns}"
            )

    def vignetting(self) -> Floats | None:
        """Return the slow part of the transmission as coefficients; None where it was not measured."""
        if self.transmission is None:
            return None
        return of_white.fit_vignetting(self.transmission, self.rectification.lattice_px)

    def summary(self) -> dict[str, Any]:
        """Return the figures as plain numbers and lists, units in their names; None where unknown."""
        lattice, fit, pose, rays = self.fit.lattice_px, self.fit, self.pose, self.ray_fit
        return {
            "lenses": fit.lenses,
            "pitch_px": lattice.pitch.tolist(),
            "layout": lattice.layout,
            "pitch_px_sigma": known(fit.pitch_sigma_px),
            "rotation_deg": float(np.rad2deg(lattice.rotation_rad)),
            "rotation_deg_sigma": known(np.rad2deg(fit.rotation_sigma_rad)),
            "origin_px": fit.centres((0, 0)).tolist(),
            "origin_px_sigma": known(fit.origin_sigma_px),
            "residual_px": known(fit.residual_px if fit.cubic_used else fit.residual_affine_px),
            "residual_affine_px": known(fit.residual_affine_px),
            "distortion_model": "cubic" if fit.cubic_used else "affine",
            "image_distance_mm": self.image_distance_mm,
            "image_distance_mm_sigma": self.image_distance_sigma_mm,
            "k1_per_mm2": pose.k1_per_mm2 if pose else None,
            "k1_per_mm2_sigma": pose.k1_sigma_per_mm2 if pose else None,
            "dots_found": pose.dots_found if pose else None,
            "board_z_mm": pose.z0_mm if pose else None,
            "board_z_mm_sigma": pose.z0_sigma_mm if pose else None,
            "tilt_deg": pose.tilt_deg.tolist() if pose else None,
            "tilt_deg_sigma": pose.tilt_sigma_deg.tolist() if pose else None,
            "offset_mm": pose.offset_mm.tolist() if pose else None,
            "offset_mm_sigma": pose.offset_sigma_mm.tolist() if pose else None,
            "magnification": pose.magnification if pose else None,
            "magnification_sigma": pose.magnification_sigma if pose else None,
            "camera_move_mm": self.camera_move_mm,
            "mid_plane_z_mm": self.mid_plane_z_mm,
            "mid_plane_z_mm_sigma": self.mid_plane_z_sigma_mm,
            "mid_plane_given": None if self.mid_plane_z_mm is None else self.mid_plane_given,
            "dlfc_entrance_pupil_mm": rays.entrance_pupil_mm if rays else None,
            "dlfc_entrance_pupil_mm_sigma": rays.entrance_pupil_sigma_mm if rays else None,
            "dlfc_depths_mm": rays.depths_mm.tolist() if rays else None,
            "dlfc_degree": rays.rays.degree if rays else None,
            "dlfc_sightings": rays.sightings if rays else None,
            "dlfc_residual_mm": np.sqrt(np.mean(rays.residual_mm**2, axis=0)).tolist() if rays else None,
        } | ({} if self.scene is None else self.scene.summary())


@dataclass(frozen=True, eq=False)
class Photographs:
    """Raw pictures (rows, columns) to calibrate from, and what is known of the scene.

    Attributes
    ----------
    whites : of uniform light: the one with the smallest aperture gives the lattice, the one with the widest the
        transmission; none: the lattice is that of the data sheet
    dark : of no light
    board : of the calibration target
    depth_boards, depths_mm : of the board at several depths, and these, for fitted rays
    mid_plane_z_mm : depth of the channel's mid plane in the fluid where it is known without a board
    """

    whites: Sequence[ArrayLike] = ()
    dark: ArrayLike | None = None
    board: ArrayLike | None = None
    depth_boards: Sequence[ArrayLike] = ()
    depths_mm: Sequence[float] = ()
    mid_plane_z_mm: float | None = None

    def less_dark(self, picture: ArrayLike) -> Floats:
        """Return a picture with the dark one taken off."""
        image = np.asarray(picture, dtype=np.float64)
        return image if self.dark is None else image - np.asarray(self.dark, dtype=np.float64)


@dataclass(frozen=True, eq=False)
class DataSheet:
    """What a data sheet says of the lens images, to be checked or believed.

    Attributes
    ----------
    layout, pitch_px : of the lens images; None: not known
    camera : whole, for the image distance; needed where there is no white picture
    """

    layout: Layout | None = None
    pitch_px: float | None = None
    camera: Camera | None = None


UNKNOWN_SHEET = DataSheet()


def calibrate(pictures: Photographs, rig: Rig | None = None, sheet: DataSheet = UNKNOWN_SHEET) -> Calibration:
    """Calibrate from photographs.

    Parameters
    ----------
    rig : camera, media and board; needed for boards only

    Raises
    ------
    InputError : when a picture cannot serve; it says why
    """
    lit = [*pictures.whites, *([] if pictures.board is None else [pictures.board]), *pictures.depth_boards]
    shapes = [np.shape(picture) for picture in lit]
    shapes += [] if sheet.camera is None else [(sheet.camera.rows, sheet.camera.columns)]
    if len(set(shapes)) != 1 or len(shapes[0]) != 2:
        raise InputError(f"the pictures are {', '.join(map(str, shapes))} (rows, columns), expected all of one shape")
    # One BLAS thread: the same bits on every machine, and small problems gain nothing from more.
    with threadpool_limits(limits=1, user_api="blas"):
        calibration = lattice_calibration(pictures, (shapes[0][0], shapes[0][1]), sheet)
        if pictures.mid_plane_z_mm is not None:
            calibration = replace(calibration, mid_plane_z_mm=pictures.mid_plane_z_mm, mid_plane_given=True)
        if rig is None:
            return calibration
        upright, passed = calibration.rectification, calibration.transmission
        if len(pictures.depth_boards):
            boards = [upright.apply(pictures.less_dark(each)) for each in pictures.depth_boards]
            camera = calibration.camera(rig.camera)
            rays = fit_rays(boards, pictures.depths_mm, camera, rig.board, rig.media, passed)
            calibration = replace(calibration, ray_fit=rays)
        if pictures.board is None:
            return calibration
        # Pixels as they are: between lens images of 8 px interpolation makes depths three times as wrong.
        board, camera = upright.nearest(pictures.less_dark(pictures.board)), calibration.camera(rig.camera)
        if calibration.white is not None:
            passed = of_white.relative_transmission(upright.nearest(calibration.white), upright.lattice_px)
        frame = PictureFrame(upright.rotation_rad, upright.off_px)
        pose = locate_board(board, camera, rig.board, rig.media, frame, passed, rig.light)
    return with_mid_plane(replace(calibration, pose=pose), pose, rig)


def lattice_calibration(pictures: Photographs, shape: tuple[int, int], sheet: DataSheet) -> Calibration:
    """Return lattice and transmission from white images, or what the data sheet says where there are none."""
    whites, dark, camera = pictures.whites, pictures.dark, sheet.camera
    if not whites:
        if camera is None:
            raise InputError("without a white image the lattice needs the whole camera of the data sheet")
        return Calibration(Rectification(sheet_fit(camera), shape))
    order = of_white.by_aperture(whites, dark)
    fit = fit_lattice(whites[order[0]], dark, sheet.layout)
    if sheet.pitch_px is not None:
        check_pitch(fit, sheet.pitch_px)
    check_residual(fit)
    rectification = Rectification(fit, shape)
    raw = pictures.less_dark(whites[order[-1]])
    image, lattice_px = rectification.apply(raw), rectification.lattice_px
    transmission, white, shadows = None, None, None
    if of_white.lens_image_width(image, lattice_px) >= NARROWEST_LENS_IMAGE:
        transmission = of_white.relative_transmission(image, lattice_px)
        white = np.maximum(raw / np.percentile(raw, of_white.FULL_PERCENTILE), 0.0).astype(np.float32)
        slow = of_white.fit_vignetting(transmission, lattice_px)
        shadows = shadowed(raw, fit, np.ones(1) if slow is None else of_white.vignetting_surface(slow, shape))
    distance, sigma = (None, None) if camera is None else image_distance_mm(fit, camera) or (None, None)
    return Calibration(
        rectification,
        transmission,
        image_distance_mm=distance,
        image_distance_sigma_mm=sigma,
        white=white,
        shadowed=shadows,
    )


def known(value: ArrayLike) -> Any:
    """Return a number or an array as plain numbers, None where they are not known."""
    array = np.asarray(value, dtype=np.float64)
    return array.tolist() if np.isfinite(array).all() else None


def with_mid_plane(calibration: Calibration, pose: BoardPose, rig: Rig) -> Calibration:
    """Return the calibration with the channel's mid plane, where there is a channel and the board's place in it known.

    That place is its outer wall for a board in air.
    """
    in_fluid = rig.board.medium == "fluid"
    if rig.channel is None or (in_fluid and rig.channel.board_from_mid_plane_mm is None):
        return calibration
    return replace(
        calibration,
        camera_move_mm=advised_move_mm(rig.board, rig.channel, rig.media),
        mid_plane_z_mm=mid_plane_z_mm(rig.board, rig.channel, rig.media, pose.z0_mm),
        mid_plane_z_sigma_mm=pose.z0_sigma_mm / (1.0 if in_fluid else rig.media.depth_ratio),
    )


def advised_move_mm(board: BoardGeometry, channel: Channel, media: Media) -> float:
    """Return the camera's move that takes its focal plane from the board to the mid plane.

    In air d_m = t_b + t_w/n_ag + D/(2 n_w) (Eq. 21, n_a = 1); from a board in the fluid n_a/n_w times its distance.
    """
    if board.medium == "fluid":
        return -(channel.board_from_mid_plane_mm or 0.0) * media.depth_ratio
    wall = channel.wall_mm * media.air / media.window
    return board.thickness_mm + wall + 0.5 * channel.width_mm * media.depth_ratio


def mid_plane_z_mm(board: BoardGeometry, channel: Channel, media: Media, board_z_mm: float) -> float:
    """Return the depth of the channel's mid plane in the fluid after the camera's move; `board_z_mm` in its medium."""
    advised = advised_move_mm(board, channel, media)
    moved = advised if channel.camera_move_mm is None else channel.camera_move_mm
    apparent = board_z_mm * (media.depth_ratio if board.medium == "fluid" else 1.0)
    return (apparent + advised - moved) / media.depth_ratio
