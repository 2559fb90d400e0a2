"""A real objective, its pupils and its errors: what is rendered of it, and that white image and board tell it."""

from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import yaml

import lfpiv_cli as lf
from lfpiv_cli.calibration.board_pose import BoardGeometry, BoardPose, pose_of_dots
from lfpiv_cli.calibration.lattice import fit_lattice
from lfpiv_cli.calibration.lens_light import LensImages
from lfpiv_cli.calibration.light_checks import Shapes, field_depth, shape_notices, shapes_of
from lfpiv_cli.calibration.model import Photographs, calibrate
from lfpiv_cli.calibration.sheet import board_notices
from lfpiv_cli.errors import ConfigError
from lfpiv_cli.files.config import load_rig
from lfpiv_cli.optics.camera import Camera, Lattice, Objective, real_lens, refocused, thin_lens
from lfpiv_cli.optics.media import Media, Window
from lfpiv_cli.optics.tracing import ObjectSpace, disc_points, trace
from lfpiv_cli.optics.waves import Waves, WavesInCamera
from lfpiv_cli.synthetic.board import BoardPlacement, render_board
from lfpiv_cli.synthetic.rays import objective_of, passed_light, passes_barrel, trace_real_ray
from lfpiv_cli.synthetic.render import Balls, render_points, render_white
from lfpiv_cli.verbs.simulate import real_camera
from tests.commands import CONFIG, WATER, run, table2_rig
from tests.known_rays import slopes_equivalent, slopes_exact

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


def shapes_in(white: np.ndarray) -> Shapes:
    """Return what a white image says of the shapes of its lens images."""
    found = calibrate(Photographs([white]))
    images = LensImages.of(found.rectification, found.transmission, 1.0)
    return shapes_of(images, found.rectification.image_shape)


def test_barrel_and_falloff_are_those_of_the_corners(small: Camera, rng: np.random.Generator) -> None:
    camera = with_objective(small, vignetting=0.3)
    x, y = 0.5 * camera.pixel_mm * np.array([camera.columns, camera.rows])
    places = disc_points(20_000, camera.aperture_radius_mm, rng)
    passes = [passes_barrel(camera.for_kernels(), camera.objective, X, Y, x, y) for X, Y in places]
    # five standard deviations of 20,000 places
    assert np.mean(passes) == pytest.approx(0.7, abs=0.016)
    passed = passed_light(with_objective(small, falloff=0.3))
    assert passed[0, 0] == pytest.approx(0.7, abs=0.002)
    assert passed[160, 200] == pytest.approx(1.0, abs=1e-4)
    assert objective_of(small) == Objective()


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
    reported = shape_notices(shapes_in(white_of(with_objective(small, **strengths), rng)))
    assert [each.code for each in reported] == ([] if code is None else [code])


def test_cut_and_growth_are_those_of_the_corners(small: Camera, rng: np.random.Generator) -> None:
    camera = with_objective(small, vignetting=0.2)
    # the fit is a parabola in the image height, the cut grows in proportion to it
    assert shapes_in(white_of(camera, rng)).cut.value == pytest.approx(0.2, abs=0.03)
    camera = with_objective(small, array_tilt_deg=(0.0, 1.0))
    shapes = shapes_in(white_of(camera, rng))
    half_diagonal = 0.5 * camera.pixel_mm * np.hypot(camera.columns, camera.rows)
    expected = np.tan(np.deg2rad(1.0)) * half_diagonal / camera.microlens_distance_mm
    # pixels widen small lens images by a twentieth of their second moment
    assert shapes.growth[1].value == pytest.approx(expected, rel=0.08)
    assert abs(shapes.growth[0].value) < 0.1 * expected
    even, falling = (fit_lattice(white_of(with_objective(small, falloff=f), rng)) for f in (0.0, 0.5))
    change = falling.lattice_px.pitch / even.lattice_px.pitch - 1.0
    # centroids would move it by f times the lens image's mean square width over the corner's: 3e-4
    assert np.abs(change).max() < 2e-5


def test_a_board_tells_of_a_curved_field(small: Camera, rng: np.random.Generator) -> None:
    board = BoardGeometry((5, 5), 0.3, 0.1)
    x, y = np.stack(np.meshgrid(0.3 * np.arange(-2.0, 3.0), 0.3 * np.arange(-2.0, 3.0)), axis=-1).reshape(-1, 2).T
    corner2 = float(np.sum((0.5 * small.pixel_mm * np.array([small.columns, small.rows])) ** 2))

    def pose_with(depth_mm: float) -> BoardPose:
        z = 0.1 * x + depth_mm * (x**2 + y**2) / corner2 + rng.normal(0.0, 1e-3, x.size)
        dots = np.column_stack([x + 0.02, y - 0.01, z])
        sigma = np.full((x.size, 3), 1e-3)
        return pose_of_dots(dots, sigma, small.magnification * dots[:, :2], small, board)

    curved, flat = pose_with(0.1), pose_with(0.0)
    found = field_depth(curved, small)
    assert found is not None
    assert found.value == pytest.approx(0.1, abs=5.0 * found.sigma)
    reported = [[each.code for each in board_notices(pose, board, small, Media())] for pose in (curved, flat)]
    assert ["field-curved" in codes for codes in reported] == [True, False]
    # Dots that do not scatter are still unsure of corners far from them by what they may have in common.
    names = ("indices", "dots_mm", "dots_sigma_mm", "residual_mm", "dots_px")
    near = np.flatnonzero(np.maximum(np.abs(x), np.abs(y)) < 0.4)
    even = replace(flat, residual_mm=np.zeros_like(flat.residual_mm))
    middle = replace(even, **{name: getattr(even, name)[near] for name in names})
    wide, narrow = (field_depth(pose, small).sigma for pose in (even, middle))
    assert narrow > 4.0 * wide > 0.0


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
    rig.write_text(CONFIG.read_text().replace("simulation:\n", scene))
    with pytest.raises(ConfigError, match="simulation.objective: vignetting and array_tilt_deg"):
        real_camera(load_rig(rig))


F_1, F_2 = 150.0, 150.0
# From the front lens to the object in focus, mm.
TO_FOCUS = 200.0
S_MU, F_MU, PIXEL, PITCH = 0.8, 0.75, 0.01, 0.1


@dataclass(frozen=True)
class TwoLenses:
    """Thin lenses of F_1 and F_2 in air and a stop between them, at `before` and `behind` it; an array and a sensor."""

    before: float
    behind: float

    @property
    def focal_length(self) -> float:
        return F_1 * F_2 / (F_1 + F_2 - self.before - self.behind)

    @property
    def entrance_per_stop(self) -> float:
        return F_1 / (F_1 - self.before)

    @property
    def entrance_behind_front(self) -> float:
        """Place of the stop's picture in the front lens."""
        return self.before * self.entrance_per_stop

    @property
    def entrance_over_exit(self) -> float:
        return self.entrance_per_stop * (F_2 - self.behind) / F_2

    def image(self) -> tuple[float, float]:
        """Return how far behind the rear lens the object in focus is shown, and how large."""
        first = 1.0 / (1.0 / F_1 - 1.0 / TO_FOCUS)
        second_object = self.before + self.behind - first
        second = 1.0 / (1.0 / F_2 - 1.0 / second_object)
        return second, (first / TO_FOCUS) * (second / second_object)

    def from_stop(self, stop, slope):
        """Return where rays through the stop meet the array, and their slopes there."""
        x = stop + self.behind * slope
        slope = slope - x / F_2
        return x + self.image()[0] * slope, slope

    def to_stop(self, points, depth, stop):
        """Return the slopes at the stop of rays from points, `depth` behind the focus in air, through the stop."""
        distance = TO_FOCUS + depth
        # at the stop: (x + distance s) (1 - before/F_1) + before s
        slope = (stop - points * (1.0 - self.before / F_1)) / (distance * (1.0 - self.before / F_1) + self.before)
        return slope - (points + distance * slope) / F_1

    def pixels(self, stop, slope, lattice):
        """Return where rays end on the sensor, in pixels from the axis, and on the array in mm."""
        array, behind = self.from_stop(stop, slope)
        centre = lattice.points(lattice.nearest(array))
        return (array + S_MU * (behind - (array - centre) / F_MU)) / PIXEL, array

    def camera(self) -> Camera:
        """Return what a data sheet says of it."""
        lattice = Lattice.regular(PITCH, "hexagonal", 0.02, (0.03, -0.02))
        magnification = self.image()[1]
        real = Camera(magnification, self.focal_length, 25.0, F_MU, S_MU, lattice, PIXEL, 1000, 800)
        return thin_lens(real, self.entrance_over_exit)


# P = 0.8, 1.3, and the stop in the rear lens's focus: telecentric towards the array.
LENSES = {
    "0.8": TwoLenses(38.0, 10.0),
    "1.3": TwoLenses(10.0, 150.0 - 140.0 / 1.3),
    "telecentric": TwoLenses(10.0, 150.0),
}


@pytest.fixture(params=list(LENSES))
def lenses(request: pytest.FixtureRequest) -> TwoLenses:
    return LENSES[request.param]


def test_points_in_air_light_the_pixels_that_two_lenses_and_a_stop_make_them_light(lenses, rng):
    camera, air = lenses.camera(), Media()
    points = rng.uniform((-6.0, -5.0, -20.0), (6.0, 5.0, 20.0), (400, 3))
    stop = rng.uniform(-8.0, 8.0, (400, 2))
    reported, array = lenses.pixels(stop, lenses.to_stop(points[:, :2], points[:, 2:], stop), camera.lattice)
    entrance = stop * lenses.entrance_per_stop
    hits = trace(camera, entrance, slopes_equivalent(points, entrance, camera, air))
    np.testing.assert_allclose(hits.array_mm, array, rtol=0, atol=1e-11)
    np.testing.assert_allclose(hits.sensor_mm / camera.pixel_mm, reported, rtol=0, atol=1e-8)


def test_points_in_water_are_seen_by_snell_from_the_entrance_pupil(lenses, rng):
    """Rays are followed from the stop outwards: through the front lens, to the window, by Snell's law into water."""
    camera = lenses.camera()
    stop, slope = rng.uniform(-8.0, 8.0, 100), rng.uniform(-0.06, 0.06, 100)
    front = stop - lenses.before * slope
    outward = slope + front / F_1
    to_window, glass, depth = 150.0, 3.0, rng.uniform(5.0, 40.0, 100)
    sine = outward / np.hypot(1.0, outward)
    fluid = (sine / 1.33) / np.sqrt(1.0 - (sine / 1.33) ** 2)
    wall = (sine / 1.49) / np.sqrt(1.0 - (sine / 1.49) ** 2)
    x = front - to_window * outward - glass * wall - depth * fluid
    in_focus = (TO_FOCUS - to_window - glass / 1.49) * 1.33
    points = np.stack([x, np.zeros(100), depth - in_focus], axis=1)
    window = Window(to_window + lenses.entrance_behind_front, glass)
    entrance = np.stack([stop * lenses.entrance_per_stop, np.zeros(100)], axis=1)
    hits = trace(camera, entrance, slopes_exact(points, entrance, camera, WATER, window))
    flat = np.zeros((100, 1))
    reported, _ = lenses.pixels(
        np.hstack([stop[:, np.newaxis], flat]), np.hstack([slope[:, np.newaxis], flat]), camera.lattice
    )
    np.testing.assert_allclose(hits.sensor_mm / camera.pixel_mm, reported, rtol=0, atol=1e-8)


def test_lens_images_are_projected_from_the_exit_pupil(lenses):
    """Their pitch is p_l (1 + s_mu/s_i); behind a telecentric lens it is that of the lenses, to the last pixel."""
    camera = lenses.camera()
    exit_pupil = lenses.image()[0] + (lenses.behind * F_2 / (F_2 - lenses.behind) if lenses.behind < F_2 else np.inf)
    expected = PITCH * (1.0 + S_MU / exit_pupil) / PIXEL
    np.testing.assert_allclose(camera.micro_image_lattice_px().pitch, expected, rtol=1e-12)


def test_thin_lenses_stand_for_themselves_and_the_two_are_what_they_are_called(camera):
    reported = replace(camera, magnification=-0.7, focal_length_mm=98.7)
    for same in (thin_lens(reported, 1.0), real_lens(reported), refocused(reported, -0.7)):
        assert (same.focal_length_mm, same.microlens_distance_mm, same.pixel_mm) == (98.7, 0.8, 0.0055)
    assert refocused(reported, -0.9).image_distance_mm == replace(reported, magnification=-0.9).image_distance_mm
    ratios = [each.entrance_over_exit for each in LENSES.values()]
    assert ratios == pytest.approx([1.0 / 0.8, 1.0 / 1.3, 0.0], abs=1e-12)


@pytest.mark.parametrize("entrance_over_exit", [1.25, 0.6, 0.0])
def test_refocused_is_the_same_lens_at_another_magnification(camera, entrance_over_exit):
    seen = refocused(thin_lens(camera, entrance_over_exit), -0.8)
    reported = thin_lens(replace(camera, magnification=-0.8), entrance_over_exit)
    for name in ("magnification", "focal_length_mm", "microlens_distance_mm", "pixel_mm", "entrance_over_exit"):
        assert getattr(seen, name) == pytest.approx(getattr(reported, name), rel=1e-14)


def test_weights_files_know_the_lens(tmp_path):
    rig = table2_rig(60, 50, volume={"shape_xyz": [4, 3, 2], "voxel_mm": 0.1})
    rig = rig.replace("aperture_mm: 25.0", "aperture_mm: 20.0\n    pupil_ratio: 1.6")
    (tmp_path / "rig.yaml").write_text(rig)
    run("build-weights", tmp_path / "rig.yaml", "-o", tmp_path / "weights.h5")
    made, read = lf.load_rig(tmp_path / "rig.yaml").camera_model(), lf.open_weights(tmp_path / "weights.h5").camera
    assert made.entrance_over_exit == pytest.approx(1.0 / 1.6)
    for name in ("focal_length_mm", "microlens_distance_mm", "pixel_mm", "entrance_over_exit"):
        assert getattr(read, name) == getattr(made, name)


COLUMNS, ROWS, STOP_RADIUS = 210, 180, 8.0
SPACING, DOTS, DOT_MM, BOARD_Z = 0.7, (4, 3), 0.3, 0.3
TRACER_MM = 0.05


def photograph(lenses, stop, slope) -> np.ndarray:
    """Return the rays that each pixel gets behind an array that is turned and shifted, as a picture (rows, columns)."""
    lattice = Lattice.regular(PITCH, "square", 0.004, (0.013, -0.021))
    array, behind = lenses.from_stop(stop, slope)
    centre = lattice.points(np.rint(lattice.coordinates(array)))
    sensor = array + S_MU * (behind - (array - centre) / F_MU)
    column, row = np.floor(sensor / PIXEL + 0.5 * np.array([COLUMNS, ROWS])).astype(int).T
    seen = (column >= 0) & (column < COLUMNS) & (row >= 0) & (row < ROWS)
    return np.bincount(row[seen] * COLUMNS + column[seen], minlength=ROWS * COLUMNS).reshape(ROWS, COLUMNS)


def picture_of(lenses, points, rays, rng) -> np.ndarray:
    """Return the picture of points (n, 3) that shine alike, some rays each."""
    points = np.repeat(points, rays, axis=0)
    stop = disc_points(len(points), STOP_RADIUS, rng)
    return photograph(lenses, stop, lenses.to_stop(points[:, :2], points[:, 2:], stop))


def data_sheet(lenses, folder):
    """Return the rig as its owner would describe it."""
    q = lenses.entrance_over_exit
    ratio = {"pupil_ratio": 1.0 / q} if q > 1e-9 else {"image_distance": "infinite"}
    size = [round(0.75 * side * PIXEL / abs(lenses.image()[1]), 2) for side in (COLUMNS, ROWS)]
    reported = {
        "camera": {
            "main_lens": {
                "magnification": lenses.image()[1],
                "focal_length_mm": lenses.focal_length,
                "aperture_mm": 2.0 * STOP_RADIUS * lenses.entrance_per_stop,
                **ratio,
            },
            "microlenses": {"pitch_mm": PITCH, "focal_length_mm": F_MU},
            "sensor": {"pixel_um": 1e3 * PIXEL, "columns": COLUMNS, "rows": ROWS, "microlens_distance_mm": S_MU},
        },
        "media": {},
        "board": {"dots": list(DOTS), "spacing_mm": SPACING, "dot_diameter_mm": DOT_MM, "polarity": "bright"},
        "volume": {"size_mm": [*size, 10.0]},
        "reconstruction": {"particle_diameter_mm": TRACER_MM},
    }
    path = folder / "rig.yaml"
    path.write_text(yaml.safe_dump(reported))
    return lf.load_rig(path)


@pytest.mark.thorough
@pytest.mark.parametrize("name", [pytest.param("1.3", marks=pytest.mark.slow), "telecentric"])
def test_tracers_are_found_where_they_are_behind_two_lenses_and_a_stop(name, tmp_path, rng):
    """The whole experiment, white picture, board and tracers, in pictures that the program had no part in."""
    lenses = LENSES[name]
    rig = data_sheet(lenses, tmp_path)
    columns, rows = np.indices(DOTS).reshape(2, -1) - 0.5 * (np.array(DOTS)[:, np.newaxis] - 1.0)
    dots = np.repeat(SPACING * np.stack([columns, rows], axis=1), 300, axis=0)
    dots += disc_points(len(dots), 0.5 * DOT_MM, rng)
    board = picture_of(lenses, np.column_stack([dots, np.full(len(dots), BOARD_Z)]), 200, rng)
    # Uniform light: rays from everywhere in the stop to everywhere on the array.
    stop, reach = disc_points(3_000_000, STOP_RADIUS, rng), 0.55 * PIXEL * np.array([COLUMNS, ROWS])
    array, to_array = rng.uniform(-reach, reach, stop.shape), lenses.image()[0]
    left = 1.0 - to_array / F_2
    white = photograph(lenses, stop, (array - stop * left) / (lenses.behind * left + to_array))
    calibration = lf.calibrate(white, board, rig)
    assert calibration.pose.z0_mm == pytest.approx(BOARD_Z, abs=0.1)
    # Apart from each other, so that none hides another, at depths from -4.5 to 4.5 mm.
    places = np.stack([0.65 * columns, 0.65 * rows, rng.permutation(np.linspace(-4.5, 4.5, columns.size))], axis=1)
    places[:, :2] += rng.uniform(-0.1, 0.1, (columns.size, 2))
    ball = rng.normal(size=(400, 3))
    ball *= 0.5 * TRACER_MM * rng.random((400, 1)) ** (1 / 3) / np.linalg.norm(ball, axis=1, keepdims=True)
    tracers = picture_of(lenses, (places[:, np.newaxis] + ball).reshape(-1, 3), 100, rng)
    found = lf.find_particles(lf.build_weights(rig, calibration), tracers).position_mm
    near = [np.argmin(np.linalg.norm((found - place) * (1.0, 1.0, 0.1), axis=1)) for place in places]
    slope = [np.polyfit(places[:, axis], found[near, axis], 1)[0] for axis in range(3)]
    error = np.sqrt(np.mean((found[near] - places) ** 2, axis=0))
    assert slope == pytest.approx([1.0, 1.0, 1.0], abs=0.01)
    # A hundredth of a microlens, as wide as 0.15 mm here, and of the depth over which light spreads by one: 1.6 mm.
    assert error[:2].max() < 0.0025
    assert error[2] < 0.05
