"""What is taken off a raw image, haze among it, and which of its pixels are not believed."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

from lfpiv_cli.calibration.model import Calibration
from lfpiv_cli.calibration.rectification import Rectification
from lfpiv_cli.calibration.sheet import sheet_fit
from lfpiv_cli.errors import InputError
from lfpiv_cli.files.images import read_image, write_tiff
from lfpiv_cli.files.vtkhdf import open_volume
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.media import Media
from lfpiv_cli.particles.noise import Noise
from lfpiv_cli.particles.view import raw_view
from lfpiv_cli.reconstruction import images
from lfpiv_cli.reconstruction.haze import Haze, White, white_of
from lfpiv_cli.reconstruction.images import as_if_lit, defects, filled, light, noise_residual, saturated, touched
from lfpiv_cli.synthetic.render import Readout, render_white
from tests.commands import AT_FOCUS, SAMPLE, run, sample_rig, summary_of
from tests.particle_images import light_on


def test_light_takes_off_dark_or_background_and_survives_broken_pixels():
    image = np.array([[10.0, np.nan], [7.0, 3.0]], np.float32)
    dark = np.full((2, 2), 4.0, np.float32)
    np.testing.assert_array_equal(light(image, dark), [[6.0, 0.0], [3.0, -1.0]])
    np.testing.assert_array_equal(light(image, dark, dark + 1), [[5.0, 0.0], [2.0, -2.0]])
    with pytest.raises(InputError, match="does not fit"):
        light(image, dark[:1])


@pytest.mark.parametrize(
    ("background", "expected"), [(images.minimum_background, [1.0, 3.0]), (images.mean_background, [2.0, 4.0])]
)
def test_a_background_needs_two_images_of_one_shape(background, expected):
    a, b = np.array([[1.0, 5.0]]), np.array([[3.0, 3.0]])
    np.testing.assert_array_equal(background([a, b]), [expected])
    with pytest.raises(InputError, match="at least two"):
        background([a])
    with pytest.raises(InputError, match="differ in shape"):
        background([a, b.T])


def test_saturated_pixels_are_at_the_end_of_a_scale_and_defects_stand_out_of_the_noise(rng):
    image = np.array([[4095.0, 4094.0, np.nan, np.inf]], np.float32)
    np.testing.assert_array_equal(saturated(image), [[True, False, True, True]])
    assert not saturated(np.array([[4090.0, 4090.0]], np.float32)).any()
    np.testing.assert_array_equal(saturated(image, 4094.0), [[True, True, True, True]])
    dark = np.rint(rng.normal(96.0, 6.0, (300, 300))).astype(np.float32)
    assert not defects(dark).any()
    dark[40, 50], dark[120, 0] = 300.0, 0.0
    np.testing.assert_array_equal(np.argwhere(defects(dark)), [[40, 50], [120, 0]])
    assert not defects(np.full((4, 4), 96.0, np.float32)).any()


def test_unusable_pixels_are_filled_and_excluded_ones_may_be_lit():
    image = np.arange(25.0, dtype=np.float32).reshape(5, 5)
    unusable = np.zeros((5, 5), bool)
    unusable[1, 1] = True
    assert filled(np.where(unusable, np.float32(9e9), image), unusable)[1, 1] == 6.0  # of 0 1 2 5 7 10 11 12
    np.testing.assert_array_equal(filled(image, unusable)[~unusable], image[~unusable])
    assert not filled(image, np.ones((5, 5), bool)).any()
    image = np.array([[1.0, 9.0, 5.0, 7.0]], np.float32)
    excluded = np.array([[True, False, False, False]])
    np.testing.assert_allclose(as_if_lit(image, excluded), [[9.0, 9.0, 5.0, 7.0]], rtol=1e-3)
    assert not as_if_lit(image, np.ones((1, 4), bool)).any()


def test_pixels_touched_by_unusable_ones_in_another_frame():
    def half_a_pixel_on(image):
        return ndimage.shift(image, (0.0, 0.5), order=3, mode="nearest")

    mask = np.zeros((5, 9), bool)
    mask[2, 4] = True
    np.testing.assert_array_equal(np.argwhere(touched(mask, half_a_pixel_on)), [[2, 3], [2, 4], [2, 5], [2, 6]])
    np.testing.assert_array_equal(touched(mask, lambda image: image), mask)


def test_noise_alone_leaves_this_residual(rng):
    light = np.where(rng.random((400, 400)) < 0.3, 2000.0, 0.0)
    recorded = rng.poisson(light * 0.5) / 0.5 + rng.normal(0.0, 6.0, light.shape)
    left = np.linalg.norm(recorded - light) / np.linalg.norm(recorded)
    assert noise_residual(recorded.astype(np.float32), 0.5) == pytest.approx(left, rel=0.02)
    # without the photons of a count only the read noise is known
    assert noise_residual(recorded.astype(np.float32)) == pytest.approx(6.0 * 400 / np.linalg.norm(recorded), rel=0.02)
    assert noise_residual(np.zeros((3, 3), np.float32)) == 0.0


DEPTHS_MM, LIGHT_COUNTS = (-1.5, 2.5), 5e5
# Read noise twice: of a frame and of its dark image.
PHOTONS_PER_COUNT = 0.5
READOUT = Readout(PHOTONS_PER_COUNT, read_noise_counts=8.5, dark_level_counts=0.0)
BACKGROUND = (0.0, 8.5)


def white_light(camera: Camera, rng: np.random.Generator) -> tuple[np.ndarray, White]:
    """Return uniform light as it is, and what a noisy white image tells of it."""
    true = render_white(camera, 1.0, samples_per_side=4)
    photographed = READOUT.record(28_000.0 * true, rng).astype(np.float32) / 28_000.0
    rectification = Rectification(sheet_fit(camera), true.shape)
    white = white_of(Calibration(rectification, photographed, white=photographed))
    assert white is not None
    return true, white


def tracers(camera: Camera, media: Media, per_lens: float, rng: np.random.Generator) -> np.ndarray:
    """Return the expected image of tracers at random; so many for each microlens, and around what is seen."""
    half = 0.6 * camera.pixel_mm * np.array([camera.columns, camera.rows])
    number = round(per_lens * 4.0 * float(np.prod(half)) / camera.lattice.cell_area)
    places = rng.uniform((*-half, DEPTHS_MM[0]), (*half, DEPTHS_MM[1]), (number, 3))
    balls = np.column_stack([places, LIGHT_COUNTS * rng.uniform(0.6, 1.4, number)])
    image = light_on(raw_view(camera, media, 0.025), balls, DEPTHS_MM)
    return image.reshape(camera.rows, camera.columns)


def uneven(shape: tuple[int, int], level: float, rng: np.random.Generator) -> np.ndarray:
    """Return light that varies by a factor of two over the sensor, brightest somewhere in it."""
    y, x = (np.linspace(-1.0, 1.0, n) - rng.uniform(-0.5, 0.5) for n in shape)
    return level * (0.7 + 0.7 * np.exp(-(x**2) - y[:, np.newaxis] ** 2))


def seen(image: np.ndarray, white: White, rng: np.random.Generator) -> Haze | None:
    """Return the haze in what a sensor records of an expected image."""
    recorded = READOUT.record(image + 100.0, rng).astype(np.float32) - 100.0
    return white.haze_in(recorded, np.ones(image.shape, np.bool_), BACKGROUND, 0.0)[0]


@pytest.mark.parametrize("level", [100.0, 1500.0])
def test_uneven_or_faint_haze_is_found(camera: Camera, water: Media, rng: np.random.Generator, level: float):
    camera = replace(camera, columns=400, rows=320)
    true, white = white_light(camera, rng)
    for per_lens in (0.05, 0.4, 0.8):
        haze = uneven(true.shape, level, rng)
        found = seen(tracers(camera, water, per_lens, rng) + haze * true, white, rng)
        assert found is not None
        middle = true > 0.95
        # Of a pixel's own noise it is a fraction, and most of that lies where tracers leave few pixels dark.
        noise = np.sqrt(BACKGROUND[1] ** 2 + haze[middle] / PHOTONS_PER_COUNT)
        off = np.abs(found.image - haze * true)[middle] / noise
        assert np.median(off) < 0.6
        assert np.percentile(off, 95.0) < 2.0
        assert found.level_counts == pytest.approx(np.median(haze), rel=0.06)
        # Over the pixels that a tracer lights it adds up: of noise of 16 counts, known to a fifth of it.
        faint = seen(tracers(camera, water, per_lens, rng) + 12.0 * true, white, rng)
        assert faint is not None
        assert faint.level_counts == pytest.approx(12.0, abs=3.0)


@pytest.mark.parametrize(("count", "haze"), [(0.15, 1.8), (0.03, 1.4), (0.03, 0.7), (0.02, 1.0), (0.03, 0.3)])
def test_haze_of_few_counts_is_found_where_a_count_is_of_many_photons(
    camera: Camera, water: Media, rng: np.random.Generator, count: float, haze: float
):
    """1.8 counts of noise of 2.4, and 1.4 of half a count, of which rounding leaves steps; 0.3 is an error."""
    camera = replace(camera, columns=400, rows=320)
    true, white = white_light(camera, rng)
    noise, dark = count * BACKGROUND[1], np.ceil(100.0 * count)
    light = count * tracers(camera, water, 0.4, rng) + haze * true
    recorded = Readout(PHOTONS_PER_COUNT / count, noise, 0.0).record(light + dark, rng) - dark
    found, error = white.haze_in(recorded.astype(np.float32), np.ones(light.shape, np.bool_), (0.0, noise), 0.0)
    if haze < 0.5:
        assert found is None
        assert haze < error < 2.0 * haze
        return
    assert found is not None
    assert abs(found.level_counts - haze) < 2.0 * error < 1.0
    # A level by few pixels may be as far off as the haze is bright.
    unsure, error = white.haze_in(recorded.astype(np.float32), np.ones(light.shape, np.bool_), (0.0, noise), 0.4 * haze)
    assert unsure is None
    assert error > haze


def test_haze_between_two_counts_is_not_one_of_them(camera: Camera, water: Media, rng: np.random.Generator) -> None:
    """Of noise of a sixth of a count most pixels have one count or the next: 1 was found of 0.6 to 1.6, or 2 of it."""
    camera = replace(camera, columns=400, rows=320)
    true, white = white_light(camera, rng)
    light = 0.02 * tracers(camera, water, 0.1, rng) + true * np.linspace(2.0, 1.0, 400)
    # A dark level of 2.6 counts is recorded as 3.
    recorded = Readout(50.0, 0.06, 0.0).record(light + 2.6, rng).astype(np.float32) - 3.0
    found, _ = white.haze_in(recorded, np.ones(light.shape, np.bool_), (0.0, 0.3), 0.0)
    assert found is not None
    assert np.percentile(np.abs(found.image - np.linspace(1.6, 0.6, 400))[true > 0.95], 90.0) < 0.25


@pytest.mark.parametrize("photons_per_count", [0.5, 0.01])
def test_tracers_are_no_haze(camera: Camera, water: Media, rng: np.random.Generator, photons_per_count: float):
    """Of four for each microlens a third of the light is in the darkest pixels of all."""
    camera = replace(camera, columns=400, rows=320)
    _, white = white_light(camera, rng)
    readout = replace(READOUT, photons_per_count=photons_per_count)
    for per_lens in (0.05, 0.6, 1.3, 1.6, 2.0, 4.0, 6.0):
        image = readout.record(tracers(camera, water, per_lens, rng) + 100.0, rng).astype(np.float32) - 100.0
        assert white.haze_in(image, np.ones(image.shape, np.bool_), BACKGROUND, 0.0)[0] is None, per_lens


def test_another_dark_level_is_no_haze(table2: Camera, water: Media, rng: np.random.Generator):
    """It does not follow the lens images."""
    camera = replace(table2, columns=400, rows=320)
    true, white = white_light(camera, rng)
    image = READOUT.record(tracers(camera, water, 0.2, rng) + 100.0, rng).astype(np.float32)
    assert white.haze_in(image, np.ones(true.shape, np.bool_), (100.0, BACKGROUND[1]), 0.0)[0] is None


def test_noise_of_dark_pixels_holds_the_haze_s_shot_noise():
    noise = Noise(6.0, 2.0, 0.0)
    assert noise.of_dark(None) == 6.0
    assert noise.of_dark(np.array([1000.0, 2000.0])) == pytest.approx(np.sqrt(36.0 + 2.0 * 1500.0))


@pytest.mark.thorough
def test_reconstruct_takes_haze_off_and_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    rig = sample_rig(tmp_path, AT_FOCUS, ("shape_xyz: [30, 22, 40]", "shape_xyz: [8, 6, 12]"))
    pictures = {name: read_image(SAMPLE / f"{name}.tif").astype(np.float64) for name in ("white", "dark", "pair_a")}
    light = pictures["white"] - pictures["dark"]
    hazy = pictures["pair_a"] + uneven(light.shape, 1000.0, np.random.default_rng(1)) * light / light.max()
    write_tiff(tmp_path / "hazy.tif", np.rint(hazy).clip(0.0).astype(np.uint16), overwrite=False)
    calibration, made = tmp_path / "calibration.h5", tmp_path / "weights.h5"
    dark = ("--dark", SAMPLE / "dark.tif")
    run("calibrate-snapshot", rig, "--white", SAMPLE / "white.tif", *dark, "-o", calibration, "-q")
    run("build-weights", rig, "--calibration", calibration, "-o", made, "-q")
    volumes = {}
    for frame, expected in ((SAMPLE / "pair_a.tif", []), (tmp_path / "hazy.tif", ["haze"])):
        output = tmp_path / f"{frame.stem}.vtkhdf"
        few = ("--solver", "sart", "--iterations", "2", "-o", output)
        summary = summary_of(capsys, "reconstruct", made, frame, *dark, *few)
        assert [each["code"] for each in summary["warnings"] if each["code"] == "haze"] == expected
        volumes[frame.stem] = open_volume(output)
    clear, cleared = (volumes[name].array for name in ("pair_a", "hazy"))
    assert np.linalg.norm(cleared - clear) < 0.3 * np.linalg.norm(clear)
    assert volumes["hazy"].attributes["haze_counts"] == pytest.approx(900.0, rel=0.3)
    assert "haze_counts" not in volumes["pair_a"].attributes
