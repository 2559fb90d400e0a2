"""Lens images that have moved since the calibration, told by a picture's light; and what else that light tells."""

from collections.abc import Sequence
from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from lfpiv_cli.arrays import Floats
from lfpiv_cli.calibration import light_checks
from lfpiv_cli.calibration.lattice import lattice_through
from lfpiv_cli.calibration.lens_light import Beside, Cells, LensImages, Place, dark_level, folded, level_error
from lfpiv_cli.calibration.light_checks import blur_notices, dark_notices, level_notices, uniform_notices
from lfpiv_cli.calibration.rectification import Rectification
from lfpiv_cli.calibration.sheet import sheet_fit
from lfpiv_cli.files.provenance import also_used_as
from lfpiv_cli.optics.camera import Camera, Lattice

SHAPE = (170, 200)
PITCH_PX, RADIUS_PX = 10.3, 4.9
NOISE = 2.0


@pytest.fixture
def lattice(layout: str) -> Lattice:
    return Lattice.regular(PITCH_PX, layout, np.deg2rad(0.6), (98.7, 84.2))


@pytest.fixture
def images(lattice: Lattice, table2: Camera) -> LensImages:
    camera = replace(table2, columns=SHAPE[1], rows=SHAPE[0]).with_micro_images(lattice)
    return LensImages.of(Rectification(sheet_fit(camera), SHAPE), None, 2.0 * RADIUS_PX / PITCH_PX)


def uniform(lattice: Lattice, shift_px: Sequence[float] = (0.0, 0.0)) -> Floats:
    """Return uniform light on lens images that have moved."""
    place = places() - np.array(shift_px)
    distance = np.linalg.norm(place - lattice.points(lattice.nearest(place)), axis=-1)
    return np.clip(RADIUS_PX + 0.5 - distance, 0.0, 1.0)


def tracers(
    lattice: Lattice, shift_px: Sequence[float] = (0.0, 0.0), *, share: float = 0.3, tilt: float = 0.0, seed: int = 0
) -> Floats:
    """Return light that is bright behind a share of the lenses, more to the right of each, and noise."""
    rng = np.random.default_rng(seed)
    lens = lattice.nearest(places() - np.array(shift_px)) - lattice.nearest(places()).min(axis=(0, 1)) + 2
    brightness = rng.exponential(1000.0, lens.max(axis=(0, 1)) + 1)
    brightness *= rng.random(brightness.shape) < share
    across = (places() - np.array(shift_px) - lattice.points(lattice.nearest(places() - np.array(shift_px))))[..., 0]
    lit = uniform(lattice, shift_px) * brightness[lens[..., 0], lens[..., 1]] * (1.0 + tilt * across / RADIUS_PX)
    return lit + rng.normal(0.0, NOISE, SHAPE)


def places() -> Floats:
    row, column = np.indices(SHAPE)
    return np.stack([column, row], axis=-1).astype(float)


def codes(images: LensImages, picture: Floats) -> list[str]:
    return [notice.code for notice in light_checks.position_notices(images, picture, "a", "b")]


def test_folding_follows_a_lattice_that_is_bent(lattice: Lattice, table2: Camera) -> None:
    indices = np.stack(np.meshgrid(np.arange(-12, 13), np.arange(-12, 13)), axis=-1).reshape(-1, 2)
    bent = lattice.points(indices)
    bent = bent + 1e-6 * (bent - 90.0) ** 3
    inside = np.all((bent > 0) & (bent < SHAPE[::-1]), axis=1)
    fit = lattice_through(indices[inside], bent[inside], np.array([99.5, 84.5]), lattice.layout)
    assert fit.cubic_used
    dots = np.zeros(SHAPE)
    column, row = np.rint(bent[inside]).astype(int).T
    dots[row, column] = 1.0
    bins = 10
    light = folded(dots, 0.0, Cells.of(fit.lattice_px, SHAPE, fit), bins).sum(axis=0)
    middle = light[np.ix_([-1, 0, 1], [-1, 0, 1])].sum()
    assert middle > 0.99 * light.sum()


@pytest.mark.thorough
@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.3, 0.0), (-2.4, 3.1)])
@pytest.mark.parametrize("tilt", [0.0, 0.4])
def test_shift_is_found_so_well(images: LensImages, lattice: Lattice, shift: tuple[float, float], tilt: float) -> None:
    found = images.beside(tracers(lattice, shift, tilt=tilt))
    assert found.lit
    assert found.following == pytest.approx(1.0, abs=0.25)
    for place in found.places:
        assert place.sigma_px < 0.08
        assert np.hypot(*(place.shift_px - shift)) < max(5.0 * place.sigma_px, 0.05)
    assert codes(images, tracers(lattice, shift, tilt=tilt)) == (["lens-images-moved"] if any(shift) else [])


@pytest.mark.parametrize(("shift_px", "following", "code"), [(2.0, 0.24, True), (0.0, 0.24, False), (2.0, 0.5, False)])
def test_little_light_that_is_elsewhere_for_certain_is_reported(
    lattice: Lattice, shift_px: float, following: float, code: bool
) -> None:
    """As of 48 tracers in a mirrored picture, where either sign alone may be chance."""
    beside = Beside((Place(np.array([0.0, shift_px]), 0.25),), following, 0.094, True)
    known = Mock(lattice_px=lattice, beside=lambda _: beside)
    assert codes(known, np.zeros(SHAPE)) == (["light-off-lens-images"] if code else [])


@pytest.mark.parametrize(("shift_px", "moved"), [(0.2, False), (0.25, True), (0.14, False)])
def test_a_shift_is_reported_that_is_certainly_harmful(lattice: Lattice, shift_px: float, moved: bool) -> None:
    place = Place(np.array([0.0, shift_px]), 0.04)
    known = Mock(lattice_px=lattice, beside=lambda _: Beside((place,), 1.0, 0.01, True))
    reported = light_checks.position_notices(known, np.zeros(SHAPE), "board", "")
    assert [each.code for each in reported] == (["lens-images-moved"] if moved else [])


@pytest.mark.thorough
def test_stated_errors_are_those_made(images: LensImages, lattice: Lattice) -> None:
    relative = []
    for seed in range(12):
        place = images.beside(tracers(lattice, share=0.15, seed=seed)).places[0]
        relative.append(place.shift_px / place.sigma_px)
    # of two components with the larger one's error, and errors that are rather too large
    assert 0.2 < np.sqrt(np.mean(np.square(relative))) < 1.3


@pytest.mark.thorough
def test_other_lattices_and_offsets_are_told(images: LensImages, lattice: Lattice) -> None:
    turned = Lattice.regular(PITCH_PX, lattice.layout, np.deg2rad(1.0), lattice.origin)
    assert codes(images, tracers(turned)) == ["lens-images-moved"]
    other = Lattice.regular(1.21 * PITCH_PX, lattice.layout, 0.1, (95.0, 80.0))
    assert codes(images, tracers(other)) == ["light-off-lens-images"]


@pytest.mark.thorough
def test_little_light_and_rounding_tell_nothing(images: LensImages, lattice: Lattice, rng: np.random.Generator) -> None:
    assert codes(images, rng.normal(0.0, NOISE, SHAPE)) == []
    # a tracer behind one lens, in the middle of one of the parts
    one = tracers(lattice, (3.0, 0.0), share=0.0)
    one[92:106, 110:124] += 500.0 * uniform(lattice, (3.0, 0.0))[92:106, 110:124]
    assert not np.isfinite(images.beside(one).places[0].sigma_px)
    assert codes(images, one) == []
    # bright pixels
    assert codes(images, rng.normal(0.0, NOISE, SHAPE) + 500.0 * (rng.random(SHAPE) < 1e-3)) == []
    # A few counts of light, of a sensor whose noise is less than one count.
    faint = 0.02 * tracers(lattice, share=0.1) + rng.normal(0.0, 0.5, SHAPE)
    assert images.background(np.rint(faint))[1] == pytest.approx(0.5, abs=0.1)
    assert images.beside(np.rint(faint)).following > 0.7
    assert codes(images, np.rint(faint)) == []


@pytest.mark.thorough
def test_offset_between_lens_images_is_told(images: LensImages, lattice: Lattice) -> None:
    picture = tracers(lattice, share=0.1)
    for offset, reported in ((0.0, []), (2.0 * NOISE, []), (60.0, ["dark-level"]), (-60.0, ["dark-level"])):
        assert [notice.code for notice in level_notices(images, picture + offset, "a")] == reported


@pytest.mark.thorough
def test_uniform_light_is_no_frame(images: LensImages, lattice: Lattice, table2: Camera) -> None:
    camera = replace(table2, columns=SHAPE[1], rows=SHAPE[0]).with_micro_images(lattice)
    indices = np.unique(lattice.nearest(places()).reshape(-1, 2), axis=0)
    centres = lattice.points(indices)
    whole = np.all((centres > RADIUS_PX) & (centres < np.array(SHAPE[::-1]) - RADIUS_PX), axis=1)
    fit = replace(sheet_fit(camera), indices=indices[whole], centres_px=centres[whole])
    noise = tracers(lattice, share=0.0)
    reported = [notice.code for notice in uniform_notices(images, fit, 1000.0 * uniform(lattice) + noise, "a")]
    assert reported == ["frame-uniform"]
    for share in (0.1, 0.9):
        assert not list(uniform_notices(images, fit, tracers(lattice, share=share), "a"))
    # A tracer in haze.
    hazy = 1000.0 * uniform(lattice) + noise
    hazy[92:106, 110:124] *= 1.5
    assert not list(uniform_notices(images, fit, hazy, "a"))
    assert not list(uniform_notices(images, sheet_fit(camera), 1000.0 * uniform(lattice) + noise, "a"))


def test_dark_image_with_the_light_on_is_told(images: LensImages, lattice: Lattice, rng: np.random.Generator) -> None:
    dark = 100.0 + rng.normal(0.0, NOISE, SHAPE)
    dark[rng.random(SHAPE) < 1e-3] += 500.0
    assert not dark_notices(images, dark)
    assert [notice.code for notice in dark_notices(images, dark + 30.0 * uniform(lattice))] == ["dark-lit"]
    # Of whole counts without noise a single pixel stands out, here on a lens image.
    single = np.full(SHAPE, 10.0)
    place = np.unravel_index(np.argmax(uniform(lattice)), SHAPE)
    single[place] = 11.0
    assert not dark_notices(images, single)


def test_a_picture_that_was_given_before_is_known() -> None:
    def given(digest: str) -> dict[str, str]:
        return {"name": f"{digest}.tif", "sha256": digest}

    before = {"command": "calibrate-snapshot", "inputs": {"white": given("w"), "board": given("b")}}
    refined = {"command": "refine-calibration", "inputs": {"image": given("a"), "image_2": given("a2")}}

    def made(image: str) -> dict[str, object]:
        inputs = {"image": given(image), "dark": given("d")}
        return {"command": "reconstruct page 0", "inputs": inputs, "made_from": {"c": before, "r": refined}}

    assert also_used_as(made("b"), "image") == "board of calibrate-snapshot"
    assert also_used_as(made("d"), "image") == "dark of reconstruct"
    # Images that a calibration was refined by show tracers.
    assert all(also_used_as(made(each), "image") is None for each in ("a", "a2", "new"))


def test_blur_of_a_white_image_is_told(images: LensImages, lattice: Lattice, table2: Camera) -> None:
    camera = replace(table2, columns=SHAPE[1], rows=SHAPE[0]).with_micro_images(lattice)
    for blur_px, reported in ((0.0, 0), (0.4, 0), (1.2, 1), (2.0, 1)):
        notices = list(blur_notices(images, gaussian_filter(uniform(lattice), blur_px), camera))
        assert [notice.code for notice in notices] == reported * ["white-blurred"]
        if notices:
            # Less what diffraction and charge are allowed, which these discs have not.
            assert blur_px - 0.4 < float(notices[0].measured) < blur_px + 0.1


def test_the_error_of_a_dark_level_is_that_of_its_scatter(rng: np.random.Generator) -> None:
    levels = [dark_level(rng.normal(100.0, 10.0, 222))[0] for _ in range(300)]
    assert np.std(levels) == pytest.approx(level_error(10.0, 222), rel=0.15)


@pytest.mark.parametrize("spread", [0.3, 0.5, 0.9])
def test_the_dark_level_of_little_noise_is_not_moved_by_rounding(rng: np.random.Generator, spread: float) -> None:
    for level in (0.0, 0.2, 0.5):
        pixels = np.rint(rng.normal(level, spread, 5000))
        assert dark_level(pixels) == pytest.approx((level, spread), abs=0.12)
    assert dark_level(np.full(9, 2.0)) == (2.0, 0.0)
