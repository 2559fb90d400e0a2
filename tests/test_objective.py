"""A real objective: what is rendered of it, and that white image and board tell it."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lfpiv_cli.calibration.board_pose import BoardGeometry, pose_of_dots
from lfpiv_cli.calibration.lattice import fit_lattice
from lfpiv_cli.calibration.lens_light import LensImages
from lfpiv_cli.calibration.light_checks import field_depth, shape_notices, shapes_of
from lfpiv_cli.calibration.model import Photographs, calibrate
from lfpiv_cli.calibration.sheet import board_notices
from lfpiv_cli.errors import ConfigError
from lfpiv_cli.files.config import load_config
from lfpiv_cli.optics.camera import Camera, Lattice, Objective
from lfpiv_cli.optics.media import Media
from lfpiv_cli.optics.tracing import ObjectSpace, disc_points
from lfpiv_cli.optics.waves import Waves, WavesInCamera
from lfpiv_cli.synthetic.board import BoardPlacement, render_board
from lfpiv_cli.synthetic.rays import objective_of, passed_light, passes_barrel, trace_real_ray
from lfpiv_cli.synthetic.render import Balls, render_points, render_white
from lfpiv_cli.verbs.simulate import real_camera

SAMPLE = Path(__file__).parent.parent / "configs" / "sample.yaml"
AIR = ObjectSpace(Media(), None, "paraxial")
# Samples along each side of a white image's pixel.
SAMPLES = 4


@pytest.fixture
def small(table2: Camera) -> Camera:
    return replace(table2, columns=400, rows=320, lattice=Lattice.regular(0.1, "square"))


def with_objective(camera: Camera, **strengths: float | tuple[float, float]) -> Camera:
    return replace(camera, objective=objective_of(camera, **strengths))


def white_of(camera: Camera, rng: np.random.Generator) -> np.ndarray:
    return rng.poisson(render_white(camera, 1e4, SAMPLES) * passed_light(camera)).astype(np.uint16)


def codes_of(camera: Camera, rng: np.random.Generator) -> list[str]:
    """Return the codes of what a white image of a camera says of its objective."""
    found = calibrate(Photographs([white_of(camera, rng)]))
    images = LensImages.of(found.rectification, found.transmission, 1.0)
    return [each.code for each in shape_notices(shapes_of(images, found.rectification.image_shape))]


def test_barrel_leaves_a_share_of_the_aperture_in_the_corners(small: Camera, rng: np.random.Generator) -> None:
    camera = with_objective(small, vignetting=0.3)
    x, y = 0.5 * camera.pixel_mm * np.array([camera.columns, camera.rows])
    places = disc_points(20_000, camera.aperture_radius_mm, rng)
    passes = [passes_barrel(camera.for_kernels(), camera.objective, X, Y, x, y) for X, Y in places]
    # five standard deviations of 20,000 places
    assert np.mean(passes) == pytest.approx(0.7, abs=0.016)


def test_falloff_is_that_of_the_corners(small: Camera) -> None:
    passed = passed_light(with_objective(small, falloff=0.3))
    assert passed[0, 0] == pytest.approx(0.7, abs=0.002)
    assert passed[160, 200] == pytest.approx(1.0, abs=1e-4)


@pytest.mark.parametrize("by_waves", [False, True])
def test_curved_field_is_another_depth_beside_the_axis(small: Camera, by_waves: bool) -> None:
    """A point in the corner looks as one does that is as far off as the field is curved: 1/s_o' = 1/s_o + kappa/s_i."""
    curved = with_objective(small, field_curvature_mm=0.5)
    place = np.array([0.9, 0.7, 1.0])
    distance = small.focus_distance_mm + place[2]
    height2 = float(np.sum((place[:2] * small.image_distance_mm / distance) ** 2))
    other = 1.0 / (1.0 / distance + curved.objective.curvature_per_mm2 * height2 / small.image_distance_mm)
    # along the ray through the middle of the main lens
    moved = np.array([*place[:2] * other / distance, other - small.focus_distance_mm])

    def image_of(camera: Camera, point: np.ndarray) -> np.ndarray:
        if by_waves:
            image = np.zeros((camera.rows, camera.columns))
            patch = WavesInCamera(camera, AIR, Waves(532e-6)).patch(point)
            assert patch is not None
            patch.add_to(image, 1.0)
            return image
        return render_points(camera, AIR, Balls(point[np.newaxis], 1.0, 0.05), np.random.default_rng(1), rays=40_000)

    found, expected = image_of(curved, place), image_of(small, moved)
    # the spot is a tenth of the image height wide, and the field as much more curved on its outer side
    assert np.abs(found - expected).sum() < 0.25 * np.abs(found - image_of(small, place)).sum()


@pytest.mark.thorough
@pytest.mark.parametrize("strengths", [{"vignetting": 0.5}, {"array_tilt_deg": (2.0, -1.0)}])
def test_white_light_backwards_equals_forwards(
    small: Camera, rng: np.random.Generator, strengths: dict[str, float | tuple[float, float]]
) -> None:
    # a corner of an array that is shifted: far from the axis
    lattice = Lattice.regular(0.1, "square", 0.01, (0.013, -0.021))
    camera = with_objective(replace(small, columns=60, rows=50, lattice=lattice), **strengths)
    count, area = 400_000, (0.7, 0.6)
    lens = disc_points(count, camera.aperture_radius_mm, rng)
    array = (rng.random((count, 2)) - 0.5) * area
    slopes = (array - lens) / camera.image_distance_mm + lens / camera.focal_length_mm
    image, seen = np.zeros((camera.rows, camera.columns)), camera.for_kernels()
    for (X, Y), slope in zip(lens, slopes, strict=True):
        x, y, passes = trace_real_ray(seen, camera.objective, X, Y, *slope)
        column, row = np.rint(camera.mm_to_px((x, y))).astype(int)
        if passes and 0 <= column < camera.columns and 0 <= row < camera.rows:
            image[row, column] += 1.0
    share = (camera.pixel_mm * camera.image_distance_mm / camera.microlens_distance_mm / 12.5) ** 2 / np.pi
    per_pixel = count * share * 0.01 / (area[0] * area[1])
    difference = image / per_pixel - render_white(camera, 1.0)
    # noise of per_pixel (some 40) rays on lit pixels, 64 samples on the lens images' edges; no bias
    assert np.sqrt(np.mean(difference**2)) < 1.3 / np.sqrt(per_pixel)
    assert abs(difference.mean()) < 0.005


@pytest.mark.parametrize(
    ("strengths", "code"),
    [
        ({}, None),
        ({"vignetting": 0.01}, None),
        ({"vignetting": 0.04}, "aperture-cut"),
        ({"falloff": 0.4}, None),
        ({"vignetting": 0.2}, "aperture-cut"),
        ({"vignetting": 0.5, "falloff": 0.3}, "aperture-cut"),
        ({"array_tilt_deg": (0.0, 1.0)}, "array-tilted"),
        ({"array_tilt_deg": (0.2, 0.0)}, None),
    ],
)
def test_a_white_image_tells_of_the_objective(
    small: Camera, rng: np.random.Generator, strengths: dict[str, float | tuple[float, float]], code: str | None
) -> None:
    assert codes_of(with_objective(small, **strengths), rng) == ([] if code is None else [code])


def test_cut_and_growth_are_those_of_the_corners(small: Camera, rng: np.random.Generator) -> None:
    camera = with_objective(small, vignetting=0.2)
    found = calibrate(Photographs([white_of(camera, rng)]))
    shapes = shapes_of(LensImages.of(found.rectification, found.transmission, 1.0), (320, 400))
    # the fit is a parabola in the image height, the cut grows in proportion to it
    assert shapes.cut.value == pytest.approx(0.2, abs=0.03)
    camera = with_objective(small, array_tilt_deg=(0.0, 1.0))
    found = calibrate(Photographs([white_of(camera, rng)]))
    shapes = shapes_of(LensImages.of(found.rectification, found.transmission, 1.0), (320, 400))
    half_diagonal = 0.5 * camera.pixel_mm * np.hypot(camera.columns, camera.rows)
    expected = np.tan(np.deg2rad(1.0)) * half_diagonal / camera.microlens_distance_mm
    # pixels widen small lens images by a twentieth of their second moment
    assert shapes.growth[1].value == pytest.approx(expected, rel=0.08)
    assert abs(shapes.growth[0].value) < 0.1 * expected


def test_falloff_leaves_the_pitch_as_it_is(small: Camera, rng: np.random.Generator) -> None:
    even, falling = (fit_lattice(white_of(with_objective(small, falloff=f), rng)) for f in (0.0, 0.5))
    change = falling.lattice_px.pitch / even.lattice_px.pitch - 1.0
    # centroids would move it by f times the lens image's mean square width over the corner's: 3e-4
    assert np.abs(change).max() < 2e-5


def test_a_board_tells_of_a_curved_field(small: Camera, rng: np.random.Generator) -> None:
    board = BoardGeometry((5, 5), 0.3, 0.1)
    x, y = np.stack(np.meshgrid(0.3 * np.arange(-2.0, 3.0), 0.3 * np.arange(-2.0, 3.0)), axis=-1).reshape(-1, 2).T
    corner2 = float(np.sum((0.5 * small.pixel_mm * np.array([small.columns, small.rows])) ** 2))

    def pose_with(depth_mm: float) -> object:
        z = 0.1 * x + depth_mm * (x**2 + y**2) / corner2 + rng.normal(0.0, 1e-3, x.size)
        dots = np.column_stack([x + 0.02, y - 0.01, z])
        sigma = np.full((x.size, 3), 1e-3)
        return pose_of_dots(dots, sigma, small.magnification * dots[:, :2], small, board)

    curved, flat = pose_with(0.1), pose_with(0.0)
    found = field_depth(curved, small)
    assert found is not None
    assert found.value == pytest.approx(0.1, abs=5.0 * found.sigma)
    told = [[each.code for each in board_notices(pose, board, small, Media())] for pose in (curved, flat)]
    assert ["field-curved" in codes for codes in told] == [True, False]


def test_an_ideal_objective_does_nothing(small: Camera) -> None:
    assert objective_of(small) == Objective()


@pytest.mark.parametrize(("strengths", "refused"), [({"falloff": 0.3}, False), ({"astigmatism_mm": 0.1}, True)])
def test_prints_are_shown_by_falloff_alone(small: Camera, strengths: dict[str, float], refused: bool) -> None:
    camera = with_objective(replace(small, columns=40, rows=30), **strengths)
    board, rng = BoardGeometry((5, 4), 0.5, 0.2, 3.0, "air", pattern="chessboard"), np.random.default_rng(1)
    with pytest.raises(ConfigError, match="more than falloff only dots") if refused else nullcontext():
        render_board(camera, AIR, board, BoardPlacement(0.0), 1e3, rng)


@pytest.mark.parametrize("strength", ["vignetting: 0.2", "array_tilt_deg: [0.1, 0.0]"])
def test_waves_are_refused_where_rays_alone_are_rendered(tmp_path: Path, strength: str) -> None:
    rig = tmp_path / "rig.yaml"
    scene = f"simulation:\n  light: {{kind: waves}}\n  objective: {{{strength}}}\n"
    rig.write_text(SAMPLE.read_text().replace("simulation:\n", scene))
    with pytest.raises(ConfigError, match="simulation.objective: vignetting and array_tilt_deg"):
        real_camera(load_config(rig))
