"""The lattice fit against spots on known lattices, and against photographs."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from lfpiv_cli.arrays import Floats
from lfpiv_cli.calibration.lattice import fit_lattice, without_strays
from lfpiv_cli.calibration.white import index_spots
from lfpiv_cli.errors import InputError
from lfpiv_cli.optics.camera import Lattice

SHAPE = (220, 260)


def discs(centres: Floats, radius_px: float, shape: tuple[int, int] = SHAPE) -> Floats:
    """Draw bright discs with a rim one pixel wide, centred at (column, row)."""
    image = np.full(shape, 100.0)
    reach = int(radius_px) + 2
    for x, y in centres:
        row, column = int(round(y)), int(round(x))
        rows = np.arange(max(0, row - reach), max(0, min(shape[0], row + reach + 1)))[:, np.newaxis]
        columns = np.arange(max(0, column - reach), max(0, min(shape[1], column + reach + 1)))
        image[rows, columns] += 4000.0 * np.clip(radius_px + 0.5 - np.hypot(columns - x, rows - y), 0.0, 1.0)
    return image


def lens_centres(lattice: Lattice, shape: tuple[int, int] = SHAPE) -> Floats:
    """All lattice points that can touch the image."""
    reach = np.arange(-60, 61)
    points = lattice.points(np.stack(np.meshgrid(reach, reach), axis=-1).reshape(-1, 2))
    margin = 2 * float(lattice.pitch.max())
    return points[((points > -margin) & (points < np.array(shape[::-1]) + margin)).all(axis=1)]


def white_image(lattice: Lattice, rng: np.random.Generator, radius_per_pitch: float = 0.42) -> Floats:
    image = discs(lens_centres(lattice), radius_per_pitch * float(lattice.pitch[0]))
    return image + rng.normal(0.0, 40.0, image.shape)


def tilted(layout: str, pitch: float = 13.37, angle_deg: float = 3.0) -> Lattice:
    return Lattice.regular(pitch, layout, np.deg2rad(angle_deg), (127.3, 108.9))


def test_pitch_rotation_and_origin_are_found_from_the_lens_in_the_middle(layout: str, rng: np.random.Generator) -> None:
    truth = tilted(layout)
    fit = fit_lattice(white_image(truth, rng), layout=layout)
    # 1 % noise moves a centroid by about 0.02 px; some 200 lenses over 100 px leave a tenth of the tolerances.
    np.testing.assert_allclose(fit.lattice_px.pitch, truth.pitch, atol=2e-3)
    assert np.rad2deg(fit.lattice_px.rotation_rad) == pytest.approx(3.0, abs=0.01)
    np.testing.assert_allclose(fit.lattice_px.origin, truth.points(truth.nearest(fit.lattice_px.origin)), atol=0.02)
    assert not fit.cubic_used
    assert np.all(fit.residual_px < 0.05)
    fit = fit_lattice(white_image(tilted(layout), rng), layout=layout)
    middle = (np.array(SHAPE[::-1]) - 1) / 2
    distance = np.hypot(*(fit.centres_px - middle).T)
    np.testing.assert_array_equal(fit.indices[np.argmin(distance)], [0, 0])


@pytest.mark.parametrize("pitch", [8.0, 10.0])
def test_whole_pixels_between_lens_images_are_no_distortion(pitch: float, rng: np.random.Generator) -> None:
    """As behind a telecentric lens: the centroids' own error within a pixel changes slowly from lens to lens."""
    truth = tilted("square", pitch, 0.3)
    fit = fit_lattice(white_image(truth, rng, 0.48))
    assert not fit.cubic_used
    found = fit.centres(fit.indices)
    assert np.abs(found - truth.points(truth.nearest(found))).max() < 0.03  # a cubic is 0.1 px off


@pytest.mark.thorough
@pytest.mark.parametrize("radius_per_pitch", [0.2, 0.45])
@pytest.mark.parametrize(("pitch", "angle_deg"), [(6.1, 2.7), (7.2, 44.0), (10.3, -41.0), (23.0, 20.0), (60.0, -2.0)])
def test_lattices_are_found_stopped_down_or_at_working_aperture(
    layout: str, pitch: float, angle_deg: float, radius_per_pitch: float, rng: np.random.Generator
) -> None:
    side = (480, 520) if pitch > 20.0 else (240, 280)
    truth = Lattice.regular(pitch, layout, np.deg2rad(angle_deg), (130.3, 120.9))
    image = discs(lens_centres(truth, side), radius_per_pitch * pitch, side) + rng.normal(0.0, 80.0, side)
    fit = fit_lattice(image)
    assert fit.lattice_px.layout == layout
    np.testing.assert_allclose(fit.lattice_px.pitch, truth.pitch, rtol=3e-4)
    # On hexagons the first vector is within 30 degrees of the columns: -41 is seen as 19.
    turn = np.rad2deg(fit.lattice_px.rotation_rad) - angle_deg
    beyond = layout == "hexagonal" and abs(angle_deg) > 30.0
    assert turn == pytest.approx(-60.0 * np.sign(angle_deg) if beyond else 0.0, abs=0.03)


def test_dirty_photographs(layout: str, rng: np.random.Generator) -> None:
    """Eight bits, speckle, dead lenses, dust, light that falls to a third on one side, lenses that the sensor cuts."""
    truth = tilted(layout)
    centres = lens_centres(truth)
    image = discs(centres[rng.random(len(centres)) > 0.05], 5.5)
    image *= rng.gamma(8.0, 1.0 / 8.0, SHAPE) * np.linspace(0.33, 1.0, SHAPE[1])
    for _ in range(15):
        row, column = rng.integers(0, SHAPE[0] - 6), rng.integers(0, SHAPE[1] - 6)
        image[row : row + 6, column : column + 6] = 50.0
    fit = fit_lattice(np.clip(image / 40.0, 0, 255).astype(np.uint8))
    assert fit.lattice_px.layout == layout
    within = np.sum(((centres > 6.0) & (centres < np.array(SHAPE[::-1]) - 7.0)).all(axis=1))
    assert fit.lenses > 0.85 * within
    np.testing.assert_allclose(fit.lattice_px.pitch, truth.pitch, rtol=2e-3)
    error = fit.centres((0, 0)) - truth.points(truth.nearest(fit.centres((0, 0))))
    assert np.all(np.abs(error) < 0.15)


def test_cubic_distortion_is_found_and_plain_lattices_stay_plain(rng: np.random.Generator) -> None:
    truth = tilted("square")
    middle = (np.array(SHAPE[::-1]) - 1) / 2
    centres = lens_centres(truth)
    offset = centres - middle
    bent = centres + 1e-6 * offset * np.sum(offset**2, axis=1, keepdims=True)
    fit = fit_lattice(discs(bent, 5.2) + rng.normal(0.0, 40.0, SHAPE))
    assert fit.cubic_used
    assert np.all(fit.residual_px < 0.05)
    # A radial distortion of 3 px in the corners is no plain lattice.
    assert np.all(fit.residual_affine_px > 0.15)
    np.testing.assert_allclose(fit.centres(fit.indices), fit.centres_px, atol=0.2)


def test_dirt_missing_and_half_vignetted_lenses_do_not_bend_the_lattice(rng: np.random.Generator) -> None:
    truth = tilted("square")
    image = white_image(truth, rng)
    image[60:75, 60:85] = 100.0
    image[150:158, 40:44] = 9000.0
    fit = fit_lattice(image)
    np.testing.assert_allclose(fit.lattice_px.pitch, truth.pitch, atol=4e-3)
    assert np.rad2deg(fit.lattice_px.rotation_rad) == pytest.approx(3.0, abs=0.02)
    # Lens images in the corners that the rim of the lens cuts on their outer side are not the lattice's distortion.
    truth = tilted("square")
    image = white_image(truth, rng)
    row, column = np.indices(SHAPE)
    place = np.stack([column, row], axis=-1).astype(float)
    lens = truth.points(truth.nearest(place)) - (np.array(SHAPE[::-1]) - 1) / 2
    radius = np.hypot(lens[..., 0], lens[..., 1])
    outward = np.sum((place - (np.array(SHAPE[::-1]) - 1) / 2 - lens) * lens, axis=-1) / np.maximum(radius, 1.0)
    image[(radius > 145.0) & (outward > 2.0)] = 100.0
    fit = fit_lattice(image)
    np.testing.assert_allclose(fit.lattice_px.pitch, truth.pitch, atol=2e-3)


@pytest.mark.thorough
def test_standard_errors_match_the_scatter_of_repeats(rng: np.random.Generator) -> None:
    turns, pitches = [], []
    for _ in range(20):
        angle, pitch = rng.uniform(-20.0, 20.0), rng.uniform(12.5, 13.5)
        fit = fit_lattice(discs(lens_centres(tilted("square", pitch, angle)), 5.6) + rng.normal(0.0, 250.0, SHAPE))
        turns.append((fit.lattice_px.rotation_rad - np.deg2rad(angle)) / fit.rotation_sigma_rad)
        pitches.append((fit.lattice_px.pitch - pitch) / fit.pitch_sigma_px)
    # Twenty repeats (forty pitches) know a standard deviation to a sixth (a ninth).
    assert 0.6 < np.std(turns) < 1.6
    assert 0.6 < np.std(pitches) < 1.5


def test_the_walk_numbers_lenses_and_one_with_a_wrong_number_is_dropped() -> None:
    lattice = Lattice.regular(10.0, "square", 0.1, (3.0, 4.0))
    indices = np.array([(i, j) for i in range(-3, 4) for j in range(-2, 3) if (i, j) != (1, 0)])
    found, reached = index_spots(lattice.points(indices), 17, lattice.basis)
    assert reached.all()
    np.testing.assert_array_equal(found, indices - indices[17])
    indices = np.stack(np.meshgrid(np.arange(-4, 5), np.arange(-4, 5)), axis=-1).reshape(-1, 2)
    points = lattice.points(indices)
    indices[17] += (1, 0)
    kept, _ = without_strays(indices, points, 10.0)
    np.testing.assert_array_equal(kept, np.delete(indices, 17, axis=0))


def test_images_that_cannot_serve_are_refused_with_advice(rng: np.random.Generator) -> None:
    image, noise = white_image(tilted("square"), rng), rng.normal(100.0, 5.0, (2, *SHAPE))
    twelve_bits = np.clip(2.0 * image, 0.0, 4095.0).astype(np.uint16)
    for pictures, options, advice in (
        ((np.zeros(SHAPE),), {}, "one value everywhere"),
        ((rng.normal(1000.0, 30.0, SHAPE),), {}, "no lattice"),
        ((twelve_bits,), {}, "saturated.*less light"),
        ((twelve_bits << 4,), {}, "saturated.*less light"),
        ((np.minimum(image, 2000.0),), {}, "saturated.*less light"),
        (noise, {}, "more light"),
        ((np.where(image > 3900.0, np.nan, image),), {}, "not numbers"),
        ((image, image[:-1]), {}, "dark frame is"),
        ((image,), {"layout": "hexagonal"}, "shows a square array"),
    ):
        with pytest.raises(InputError, match=advice):
            fit_lattice(*pictures, **options)


def read(path: Path) -> Floats:
    return cv2.imread(str(path), cv2.IMREAD_UNCHANGED)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("name", "lenses", "pitch", "tolerance"), [("seaurchin", 13500, 17.195, 0.02), ("guv", 650, 15.40, 0.02)]
)
def test_photographs(data_folder: Path, name: str, lenses: int, pitch: float, tolerance: float) -> None:
    folder = data_folder / "real"
    fit = fit_lattice(read(folder / f"{name}_white.tif"), read(folder / f"{name}_dark.tif"))
    assert fit.lenses >= lenses
    np.testing.assert_allclose(fit.lattice_px.pitch, pitch, atol=tolerance)
    assert fit.cubic_used
    assert np.all(fit.residual_px < (0.18, 0.13) if name == "seaurchin" else (0.02, 0.02))
    if name == "seaurchin":
        assert np.rad2deg(fit.lattice_px.rotation_rad) == pytest.approx(0.177, abs=0.02)


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["spots_b", "spots_c"])
def test_hexagonal_spots_with_known_centres(data_folder: Path, name: str) -> None:
    fit = fit_lattice(read(data_folder / "real" / f"{name}.png"))
    known = np.loadtxt(data_folder / "real" / f"{name}_centres.txt")[:, ::-1]
    error = fit.centres(fit.lattice_px.nearest(known)) - known
    assert np.hypot(*error.T).mean() < 0.03


@pytest.mark.thorough
def test_experiment_gives_the_true_rotation_and_shift(data_folder: Path) -> None:
    folder = data_folder / "channel"
    fit = fit_lattice(read(folder / "white.tif"), read(folder / "dark.tif"))
    # Made with 0.12 degrees and a shift of (3.4, -2.1) px at the array: 1 + s_mu/s_i = 1.004 of it on the sensor.
    assert np.rad2deg(fit.lattice_px.rotation_rad) == pytest.approx(0.12, abs=0.002)
    on_axis = np.array([1175.5, 883.5]) + 1.004 * np.array([3.4, -2.1])
    np.testing.assert_allclose(fit.lattice_px.points(fit.lattice_px.nearest(on_axis)), on_axis, atol=0.02)
    assert not fit.cubic_used


@pytest.mark.parametrize("cubic_used", [False, True])
def test_a_shift_moves_all_lens_images_alike(rng: np.random.Generator, cubic_used: bool) -> None:
    fit = replace(fit_lattice(white_image(tilted("square"), rng)), cubic_used=cubic_used)
    moved = fit.shifted(np.array([0.3, -0.2]))
    indices = np.array([(0, 0), (5, -3), (-4, 6)])
    np.testing.assert_allclose(moved.centres(indices) - fit.centres(indices), np.tile((0.3, -0.2), (3, 1)), atol=1e-10)
    np.testing.assert_allclose(moved.lattice_px.origin - fit.lattice_px.origin, (0.3, -0.2), atol=1e-10)
    off, before = moved.centres_px - moved.centres(moved.indices), fit.centres_px - fit.centres(fit.indices)
    np.testing.assert_allclose(off, before)
