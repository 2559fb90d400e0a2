"""Chessboards and ChArUco boards, rendered and found again; targets that the config does not name."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from lfpiv_cli.arrays import Floats, Singles
from lfpiv_cli.calibration.board import another_kind, chessboard, dot_signal, locate_board, sentence
from lfpiv_cli.calibration.board_pose import BoardGeometry, BoardPose, off_focus_mm, pose_of_dots, upright_numbers
from lfpiv_cli.calibration.corners import quadrant_shares
from lfpiv_cli.calibration.shape_fit import lens_cell
from lfpiv_cli.errors import InputError
from lfpiv_cli.names import Polarity
from lfpiv_cli.optics.camera import Camera, Lattice
from lfpiv_cli.optics.media import Media, Window, equivalent_object_distance
from lfpiv_cli.optics.tracing import ObjectSpace
from lfpiv_cli.synthetic.board import BoardPlacement, _on_plate, _rays_to, printed_plate, render_board
from lfpiv_cli.synthetic.render import Balls, render_points, render_white
from tests.known_rays import slopes_exact

CHESS = BoardGeometry((4, 3), 0.8, 0.0, pattern="chessboard")
CHARUCO = BoardGeometry((4, 3), 1.6, 0.0, pattern="charuco", marker_mm=1.2)
DOTS = BoardGeometry((5, 4), 0.8, 0.3)
WIDER, FEW_CHARUCO = replace(CHESS, dots=(5, 4)), replace(CHARUCO, dots=(3, 2))
SMALL_CHARUCO = replace(CHARUCO, spacing_mm=0.8, marker_mm=0.6)
PAPERS = Camera(-1.0, 100.0, 25.0, 0.8, 0.8, Lattice.regular(0.1), 0.0055, 2352, 1768)
AIR = ObjectSpace(Media())
LEVEL = 10_000.0


def small(camera: Camera, columns: int = 600, rows: int = 448) -> Camera:
    """The paper's optics in front of coarse pixels, nine to a microlens: 66 x 49 lenses."""
    return replace(camera, pixel_mm=0.011, columns=columns, rows=rows)


def large(camera: Camera) -> Camera:
    """The same with more of them, which markers need: 75 x 62 lenses."""
    return small(camera, 680, 560)


def picture(camera: Camera, board: BoardGeometry, placement: BoardPlacement) -> Singles:
    return render_board(camera, AIR, board, placement, LEVEL, np.random.default_rng(5)).astype(np.float32)


@cache
def at_one_mm(board: BoardGeometry) -> Singles:
    return picture(large(PAPERS) if board.pattern == "charuco" else small(PAPERS), board, BoardPlacement(1.0))


def posed(dots: Floats, board: BoardGeometry) -> BoardPose:
    """Return the pose of places that are known to a micrometre, before the paper's camera."""
    return pose_of_dots(dots, np.full(dots.shape, 1e-3), -dots[:, :2], PAPERS, board)


def agrees(pose: BoardPose, placement: BoardPlacement) -> None:
    """Within four of its own standard errors, and these are small."""
    assert pose.z0_sigma_mm < 0.03
    assert pose.z0_mm == pytest.approx(placement.z_mm, abs=4 * pose.z0_sigma_mm)
    np.testing.assert_array_less(np.abs(pose.tilt_deg - placement.tilt_deg), 4 * pose.tilt_sigma_deg)
    np.testing.assert_allclose(pose.offset_mm, placement.offset_mm, atol=2e-3)
    assert pose.magnification == pytest.approx(-1.0, abs=4 * pose.magnification_sigma + 1e-4)
    assert pose.rotation_deg == pytest.approx(placement.rotation_deg, abs=4 * pose.rotation_sigma_deg + 0.02)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("z_mm", "tilt_deg"),
    [
        pytest.param(-3.0, (0.0, 0.0), marks=pytest.mark.slow),
        pytest.param(4.0, (0.0, 0.0), marks=pytest.mark.slow),
        (7.0, (3.0, -2.0)),
    ],
)
def test_a_chessboard_is_found_in_both_layouts(camera: Camera, z_mm: float, tilt_deg: tuple[float, float]) -> None:
    placement = BoardPlacement(z_mm, (0.07, -0.04), tilt_deg, 1.5)
    pose = locate_board(picture(small(camera), CHESS, placement), small(camera), CHESS, Media())
    assert pose.dots_found == 12
    agrees(pose, placement)


@pytest.mark.thorough
def test_a_chessboard_in_focus_and_a_quarter_turn_and_its_magnification(table2: Camera) -> None:
    # Turned, the longer side stands along y.
    camera = replace(small(table2, 448, 600), column_axis="y")
    board = replace(CHESS, dots=(3, 4))
    placement = BoardPlacement(0.0, (0.07, -0.04), rotation_deg=1.5)
    pose = locate_board(picture(camera, board, placement), camera, CHESS, Media())
    assert pose.z0_mm == pytest.approx(0.0, abs=4 * pose.z0_sigma_mm)
    np.testing.assert_allclose(pose.offset_mm, placement.offset_mm, atol=2e-3)
    assert pose.indices.max(axis=0).tolist() == [2, 3]
    true = replace(small(table2), magnification=-1.01)
    sheet = replace(true, magnification=-1.0).with_micro_images(true.micro_image_lattice_px())
    pose = locate_board(picture(true, CHESS, BoardPlacement(3.0)), sheet, CHESS, Media())
    assert pose.magnification == pytest.approx(-1.01, abs=4 * pose.magnification_sigma + 1e-4)
    assert pose.z0_mm == pytest.approx(3.0, abs=4 * pose.z0_sigma_mm)


@pytest.mark.thorough
def test_a_charuco_board_may_reach_beyond_the_view(table2: Camera) -> None:
    """The markers tell which corners are seen, so that the board's middle is known."""
    camera, placement = large(table2), BoardPlacement(2.0, (1.3, -0.1), rotation_deg=-1.0)
    pose = locate_board(picture(camera, CHARUCO, placement), camera, CHARUCO, Media())
    assert 6 <= pose.dots_found < 12
    agrees(pose, placement)


def test_numbers_grow_with_x_and_y_however_the_board_is_turned_and_markers_are_no_dots() -> None:
    numbers = np.array([[0, 0], [3, 0], [0, 2], [3, 2]])
    for turn, expected in ((np.diag([-1.0, -1.0]), [3, 2]), (np.array([[0.0, 1.0], [-1.0, 0.0]]), [2, 0])):
        found, board = upright_numbers(numbers, numbers @ turn, CHESS)
        assert found[0].tolist() == expected
        assert board.dots == ((4, 3) if expected == [3, 2] else (3, 4))
    # Out of focus its markers are dark, round and even.
    assert sentence("a board of 9 dark dots", "dots", CHARUCO) is None
    assert sentence("a board of 9 dark dots", "dots", CHESS) is not None


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("shown", "said", "expected"),
    [
        (CHESS, DOTS, "looks like a chessboard of 5 x 4 squares; board.pattern says dots"),
        (DOTS, CHESS, "looks like a board of 20 bright dots; board.pattern says chessboard"),
        (CHESS, WIDER, "looks like a chessboard of 5 x 4 squares; the config says a chessboard of 6"),
        (CHESS, SMALL_CHARUCO, "a chessboard of 5 x 4 squares; board.pattern says charuco"),
        (FEW_CHARUCO, DOTS, "looks like a ChArUco board with markers of 4X4; board.pattern says dots"),
    ],
)
def test_another_target_is_named(table2: Camera, shown: BoardGeometry, said: BoardGeometry, expected: str) -> None:
    camera = large(table2) if shown.pattern == "charuco" else small(table2)
    with pytest.raises(InputError, match=expected):
        locate_board(at_one_mm(shown), camera, said, Media())


def test_dots_out_of_focus_are_no_chessboard_on_a_corner() -> None:
    row, column = np.indices((400, 500))
    waves = np.cos(2.0 * np.pi * column / 60.0) + np.cos(2.0 * np.pi * row / 60.0)
    picture = np.rint(128.0 + 60.0 * waves).astype(np.uint8)
    found = chessboard(picture)
    assert found is not None
    assert "chessboard of" in found
    assert chessboard(picture, 60.0 * np.sqrt(0.5)) is None
    assert chessboard(picture, 60.0) == found


def test_boards_that_are_none_are_refused(table2: Camera, rng: np.random.Generator) -> None:
    # Many tracers fill a grid of any spacing, and lie anywhere about its points.
    board = BoardGeometry((9, 9), 1.0, 0.2)
    tracers = rng.uniform(-5.0, 5.0, (2000, 3))
    with pytest.raises(InputError, match="mm rms off a grid of 1 mm"):
        posed(tracers, board)
    i, j = np.divmod(np.arange(20), 5)
    dots = np.column_stack([0.8 * (j - 2.0), 0.8 * (i - 1.5), 2.0 + rng.normal(0.0, 0.5, 20)])
    with pytest.raises(InputError, match=r"lies 0\.\d+ mm rms in front of and behind one plane, at most 0\.16 mm"):
        posed(dots, DOTS)
    i, j = np.divmod(np.arange(81), 9)
    dots = np.column_stack([i - 4.0, j - 4.0, np.full(81, 2.0)])
    assert posed(dots[:41], board).dots_found == 41
    with pytest.raises(InputError, match="only 40 of the board's 9 x 9 dots were found.* at least 41 are needed"):
        posed(dots[:40], board)
    camera = small(table2)
    dark = np.zeros((camera.rows, camera.columns), np.float32)
    with pytest.raises(InputError, match="squares are 4 microlenses wide"):
        locate_board(dark, camera, replace(CHESS, spacing_mm=0.4), Media())
    # Near the focal plane they seem to lie in the middle of their lenses, a grid of 0.1 mm, and not on their own.
    lateral = 0.24 * np.column_stack([i - 4.0, j - 4.0])
    dots = np.column_stack([0.1 * np.rint(lateral / 0.1), rng.normal(0.0, 0.01, 81)])
    for wide, words in (
        (0.08, r"dots 0\.8 microlenses wide .* by 0\.96 mm off it, .* 0\.2 mm; then board"),
        (0.2, "check board"),
    ):
        with pytest.raises(InputError, match=f"mm rms off a grid of 0.24 mm, .* {words}"):
            posed(dots, BoardGeometry((9, 9), 0.24, wide))


def test_a_dot_is_two_lenses_wide_where_boards_are_moved_to(table2: Camera, media: Media) -> None:
    """By Eqs. 1 and 9: on the array light spreads from rim to rim by alpha of the aperture."""
    board = BoardGeometry((9, 9), 0.24, 0.08, medium="fluid")
    depth = off_focus_mm(board, table2, media)
    at = equivalent_object_distance(np.array([-depth, depth]), table2.focus_distance_mm, media)
    wide = np.abs(table2.defocus(at)) * table2.aperture_mm / 0.1 + 0.08 * abs(table2.magnification) / 0.1
    # nearer and further spread differs by depth over distance, 1 in 200
    np.testing.assert_allclose(wide, 2.0, rtol=0.01)


ASKEW = BoardPlacement(2.0, (0.07, -0.04), (1.0, -0.5), 1.5)


@cache
def dots_askew(diameter_mm: float, *, is_origin: bool) -> Singles:
    """The origin, or the other dots of the board, of a diameter."""
    board, shown = replace(DOTS, dot_diameter_mm=diameter_mm), (np.arange(20) == 7) == is_origin
    return render_board(small(PAPERS), AIR, board, ASKEW, LEVEL, np.random.default_rng(5), shown)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("polarity", "diameters_mm"), [("bright", ()), ("dark", ()), ("bright", (0.5,)), ("dark", (0.5, 0.3))]
)
def test_an_origin_may_be_missing_larger_or_a_ring(polarity: Polarity, diameters_mm: tuple[float, ...]) -> None:
    """One dot is not like the others: left out, of another diameter, or one less a smaller one."""
    camera, image = small(PAPERS), dots_askew(DOTS.dot_diameter_mm, is_origin=False)
    for diameter, sign in zip(diameters_mm, (1.0, -1.0), strict=False):
        image = image + sign * dots_askew(diameter, is_origin=True)
    if polarity == "dark":
        image = np.maximum(render_white(camera, LEVEL) - image, 0.0)
    pose = locate_board(image.astype(np.float32), camera, replace(DOTS, polarity="auto"), Media())
    assert pose.dots_found == 19
    agrees(pose, ASKEW)


@pytest.mark.thorough
def test_particles_are_called_nothing_and_few_are_no_small_board(table2: Camera, rng: np.random.Generator) -> None:
    # Nor is white light: OpenCV alone finds three by three corners in both.
    camera = small(table2)
    points = np.column_stack([rng.uniform(-3.0, 3.0, 300), rng.uniform(-2.5, 2.5, 300), rng.uniform(-3.0, 3.0, 300)])
    tracers = render_points(camera, AIR, Balls(points, 1e4, 0.05), rng, rays=500)
    for image in (tracers, render_white(camera, LEVEL)):
        assert another_kind(image, camera, DOTS) is None
        assert another_kind(image, camera, CHESS) is None
    # Half of a board of 4 x 3 is soon found among tracers, near enough to a grid of which six numbers are free.
    for _ in range(40):
        tracers = rng.uniform(-1.0, 1.0, (25, 3)) * (1.6, 1.2, 0.8)
        with pytest.raises(InputError):
            posed(tracers, replace(DOTS, dots=(4, 3)))


def test_auto_sees_whether_dots_are_bright_or_dark(rng: np.random.Generator) -> None:
    """Dots cover the smaller part of what micro-images show."""
    passed = np.where(rng.random((60, 80)) < 0.7, 0.8, 0.0).astype(np.float32)
    on_dots = rng.random(passed.shape) < 0.1
    for polarity, ground, dot in (("bright", 50.0, 900.0), ("dark", 900.0, 50.0)):
        image = (np.where(on_dots, dot, ground) * passed + rng.normal(0.0, 5.0, passed.shape)).astype(np.float32)
        found = dot_signal(image, passed, replace(DOTS, polarity="auto"))
        np.testing.assert_array_equal(found, dot_signal(image, passed, replace(DOTS, polarity=polarity)))


@pytest.mark.thorough
def test_quadrants_share_what_a_fine_grid_counts(layout: str) -> None:
    lattice = Lattice.regular(1.0, layout)
    line = np.linspace(-0.7, 0.7, 701)
    points = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    own = points[(lattice.nearest(points) == 0).all(axis=-1)]
    edges = np.array([[2.0, 0.3], [-0.2, 2.1]])
    middles = np.array([[0.0, 0.0], [0.1, -0.2], [0.3, 0.05], [-0.4, 0.4], [2.0, 1.0], [-2.0, 1.0]])
    shares, _ = quadrant_shares(middles, lens_cell(lattice), np.linalg.inv(edges), 0.0, 1)
    counted = [np.mean(np.prod((own + middle) @ np.linalg.inv(edges), axis=1) > 0.0) for middle in middles]
    np.testing.assert_allclose(shares, counted, atol=3e-3)
    np.testing.assert_allclose(shares[4:], [1.0, 0.0], atol=1e-12)


def test_a_white_plate_is_a_white_image_by_the_tracer_s_rays(camera: Camera, rng: np.random.Generator) -> None:
    # Where the plate's margin fills the view there is nothing but the aperture.
    camera = small(camera, 90, 90)
    board = BoardGeometry((2, 2), 40.0, 0.0, pattern="chessboard")
    image = picture(camera, board, BoardPlacement(1.0, (80.0, 0.0)))
    white = render_white(camera, LEVEL)
    # A sixteenth of a pixel's rays is the step; between touching micro-images some come from the neighbour.
    assert np.mean(np.abs(image - white)[white > 0.999 * LEVEL] > 0.0) < 0.02
    assert image.sum() == pytest.approx(white.sum(), rel=0.01)
    # Back through window and water to a tilted plate, and from there forward again.
    camera, media, window = replace(small(camera), distortion_per_mm2=2e-5), Media(1.0, 1.49, 1.33), Window(98.0, 2.0)
    placement = BoardPlacement(1.5, (0.1, -0.2), (12.0, -7.0), 20.0)
    plate = printed_plate(camera, CHESS, placement)
    crossing, slope = _rays_to(rng.uniform(0, 440, (50, 2)), np.array([0.02, -0.03]), camera)
    on_plate = _on_plate(crossing, slope, camera, ObjectSpace(media, window), plate)
    points = placement.to_world(on_plate)
    np.testing.assert_allclose(slopes_exact(points, crossing, camera, media, window), slope, atol=1e-8)
