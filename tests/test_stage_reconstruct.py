"""`reconstruct` on images that are not perfect: reflections, saturation, backgrounds made from the frames."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import tifffile

from lfpiv_cli.cli.main import cli
from lfpiv_cli.errors import InputError, OutputExistsError
from lfpiv_cli.files.images import read_image
from lfpiv_cli.files.vtkhdf import open_volume
from lfpiv_cli.verbs.checks import word_of
from lfpiv_cli.verbs.frames import Background

ROOT = Path(__file__).parent.parent
SAMPLE = ROOT / "sample_data"
REFLECTION = (slice(180, 230), slice(250, 320))


def run(*arguments: object) -> None:
    cli.main([str(argument) for argument in arguments], standalone_mode=False)


def build(folder: Path, *changes: tuple[str, str]) -> Path:
    """Return weights of a part of the sample's volume, without a calibration."""
    text = (ROOT / "configs" / "sample.yaml").read_text()
    part = ("shape_xyz: [30, 22, 40]", "shape_xyz: [16, 12, 20]"), ("reference: mid_plane", "reference: focal_point")
    for old, new in (*part, *changes):
        assert old in text, old
        text = text.replace(old, new)
    config = folder / "rig.yaml"
    config.write_text(text)
    run("build-weights", config, "-o", folder / "weights.h5")
    return folder / "weights.h5"


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build(tmp_path_factory.mktemp("weights"))


@pytest.fixture
def frame() -> np.ndarray:
    return read_image(SAMPLE / "pair_a.tif").astype(np.uint16)


def volume_of(weights: Path, image: Path, output: Path, *options: object) -> np.ndarray:
    run("reconstruct", weights, image, "--iterations", 4, *options, "-o", output)
    return open_volume(output).array


@pytest.mark.thorough
@pytest.mark.parametrize("layout", ["square", "hexagonal"])
def test_what_the_mask_hides_does_not_matter(weights, layout, frame, tmp_path, capsys):
    if layout == "hexagonal":  # whose columns are made on demand
        small = ("[16, 12, 20]", "[6, 5, 4]"), ("iterations: 16", "iterations: 16, padding_voxel: [0, 0, 0]")
        weights = build(tmp_path, ("layout: square", "layout: hexagonal"), *small)
        capsys.readouterr()
    mask = np.full(frame.shape, 255, np.uint8)
    mask[REFLECTION] = 0
    tifffile.imwrite(tmp_path / "mask.tif", mask)
    spoilt = frame.copy()
    spoilt[REFLECTION] = 50_000
    for name, image in (("clean", frame), ("spoilt", spoilt)):
        tifffile.imwrite(tmp_path / f"{name}.tif", image)
    clean = volume_of(weights, tmp_path / "clean.tif", tmp_path / "c.vtkhdf", "--mask", tmp_path / "mask.tif")
    masked = volume_of(weights, tmp_path / "spoilt.tif", tmp_path / "m.vtkhdf", "--mask", tmp_path / "mask.tif")
    believed = volume_of(weights, tmp_path / "spoilt.tif", tmp_path / "b.vtkhdf")
    assert ("columns are made on demand: up to 0.016 minutes" in capsys.readouterr().err) == (layout == "hexagonal")
    np.testing.assert_array_equal(masked, clean)
    assert believed.sum() > 2.0 * masked.sum()
    assert open_volume(tmp_path / "m.vtkhdf").attributes["excluded_pixels"] == 50 * 70


@pytest.mark.thorough
def test_saturated_pixels_and_defects_of_the_dark_image_are_left_out(weights, frame, tmp_path):
    dark = read_image(SAMPLE / "dark.tif").astype(np.uint16)
    dark[200, 300] = frame[200, 300] = 9000
    frame[210, 280:283] = 65535
    tifffile.imwrite(tmp_path / "a.tif", frame)
    tifffile.imwrite(tmp_path / "dark.tif", dark)
    mask = np.ones(frame.shape, np.uint8)
    mask[200, 300] = mask[210, 280:283] = 0
    tifffile.imwrite(tmp_path / "mask.tif", mask)
    found = volume_of(weights, tmp_path / "a.tif", tmp_path / "a.vtkhdf", "--dark", tmp_path / "dark.tif")
    assert open_volume(tmp_path / "a.vtkhdf").attributes["excluded_pixels"] == 4
    masked = ("--dark", SAMPLE / "dark.tif", "--mask", tmp_path / "mask.tif")
    np.testing.assert_array_equal(found, volume_of(weights, tmp_path / "a.tif", tmp_path / "m.vtkhdf", *masked))


@pytest.mark.thorough
def test_a_background_over_the_frames_is_that_of_its_image(weights, frame, tmp_path):
    rng = np.random.default_rng(3)
    frames = np.stack([frame, *rng.integers(90, 400, (3, *frame.shape)).astype(np.uint16)])
    tifffile.imwrite(tmp_path / "run.tif", frames, photometric="minisblack")
    tifffile.imwrite(tmp_path / "first.tif", frame)
    tifffile.imwrite(tmp_path / "lowest.tif", frames[:2].min(axis=0))
    sliding = ("reconstruct", weights, tmp_path / "run.tif", "--iterations", 4, "--background", "minimum:2")
    run(*sliding, "-o", tmp_path / "run")
    expected = volume_of(
        weights, tmp_path / "first.tif", tmp_path / "e.vtkhdf", "--background", tmp_path / "lowest.tif"
    )
    np.testing.assert_array_equal(open_volume(tmp_path / "run" / "run_0000.vtkhdf").array, expected)
    with pytest.raises(InputError, match="at least two"):
        run("reconstruct", weights, tmp_path / "first.tif", "--background", "mean", "-o", tmp_path / "f.vtkhdf")


def test_a_background_over_other_frames_is_another_input(weights, frame, tmp_path):
    for k in range(3):
        tifffile.imwrite(tmp_path / f"{k}.tif", frame + np.uint16(k))
    first, second, third = (tmp_path / f"{k}.tif" for k in range(3))
    options = ("--background", "mean", "--iterations", 1, "-o", tmp_path / "out", "--resume")
    run("reconstruct", weights, first, second, *options)
    before = (tmp_path / "out" / "0.vtkhdf").stat().st_mtime_ns
    run("reconstruct", weights, first, second, *options)
    assert (tmp_path / "out" / "0.vtkhdf").stat().st_mtime_ns == before
    with pytest.raises(OutputExistsError, match="other inputs"):
        run("reconstruct", weights, first, third, *options)


def test_frames_around_a_frame():
    assert [list(Background.parse("minimum:3").around(k, 5)) for k in (0, 2, 4)] == [[0, 1, 2], [1, 2, 3], [2, 3, 4]]
    assert list(Background.parse("mean:9").around(1, 4)) == [0, 1, 2, 3]
    assert list(Background.parse("mean").around(1, 4)) == [0, 1, 2, 3]
    assert Background.parse("minimum:x") == Background(path=Path("minimum:x"))
    assert not Background.parse("background.tif").around(0, 4)


@pytest.mark.thorough
def test_voxels_without_light_stay_out_with_lines_of_sight(weights, tmp_path):
    dark = ("--dark", SAMPLE / "dark.tif")
    volume = volume_of(weights, SAMPLE / "pair_a.tif", tmp_path / "a.vtkhdf", *dark, "--start", "line_of_sight")
    taking_part = open_volume(tmp_path / "a.vtkhdf").attributes["support_voxels"]
    assert np.count_nonzero(volume) <= taking_part
    volume_of(weights, SAMPLE / "pair_a.tif", tmp_path / "u.vtkhdf", *dark)
    assert taking_part < open_volume(tmp_path / "u.vtkhdf").attributes["support_voxels"]


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("stop", "done"), [("stop_noise: 1000.0", 0), ("stop_noise: 1.0e-3", 6), ("stop_change: 0.9", 1)]
)
def test_iterations_end_where_the_config_says(tmp_path, stop, done):
    # the first step from a uniform volume lowers the residual by less than nine tenths
    weights = build(tmp_path, ("iterations: 16", f"iterations: 6, {stop}"))
    run("reconstruct", weights, SAMPLE / "pair_a.tif", "--dark", SAMPLE / "dark.tif", "-o", tmp_path / "a.vtkhdf")
    assert len(open_volume(tmp_path / "a.vtkhdf").attributes["residual"]) == done + 1


@pytest.mark.parametrize(("counts", "said"), [(0, "one value everywhere \\(0\\)"), (65535, "one value everywhere")])
def test_a_frame_that_shows_nothing_is_refused(weights, frame, counts, said, tmp_path):
    tifffile.imwrite(tmp_path / "nothing.tif", np.full_like(frame, counts))
    with pytest.raises(InputError, match=f"nothing.tif: has {said}"):
        volume_of(weights, tmp_path / "nothing.tif", tmp_path / "v.vtkhdf")
    assert not (tmp_path / "v.vtkhdf").exists()


def test_a_frame_without_a_usable_pixel_is_refused(weights, frame, tmp_path):
    mask = np.zeros(frame.shape, np.uint8)
    tifffile.imwrite(tmp_path / "mask.tif", mask)
    with pytest.raises(InputError, match="mask and dark image leave out all pixels"):
        volume_of(weights, SAMPLE / "pair_a.tif", tmp_path / "v.vtkhdf", "--mask", tmp_path / "mask.tif")
    # what the mask leaves is saturated
    mask[:50] = 255
    frame[:50] = 65535
    tifffile.imwrite(tmp_path / "mask.tif", mask)
    tifffile.imwrite(tmp_path / "a.tif", frame)
    with pytest.raises(InputError, match="a.tif: all pixels are saturated or left out"):
        volume_of(weights, tmp_path / "a.tif", tmp_path / "v.vtkhdf", "--mask", tmp_path / "mask.tif")


# The weights believe the data sheet, and the sample's lens images lie a few pixels beside it.
TOLD = {
    "none": ["lens-images-moved"],
    "noise": ["frame-dark", "dark-level"],
    "noise less dark": ["frame-dark"],
    "saturated": ["frame-saturated", "lens-images-moved"],
}


def test_a_dark_image_as_a_frame_is_told(weights, tmp_path, capsys):
    dark = SAMPLE / "dark.tif"
    volume_of(weights, dark, tmp_path / "v.vtkhdf", "--dark", dark, "--json")
    (told,) = (each for each in json.loads(capsys.readouterr().out)["warnings"] if each["code"] == "frame-given-before")
    assert told["text"] == "the file is also the dark of reconstruct: it shows no tracers"


@pytest.mark.thorough
@pytest.mark.parametrize("fault", TOLD)
def test_a_frame_of_noise_or_half_saturated_is_told(weights, frame, fault, tmp_path, rng, capsys):
    dark = read_image(SAMPLE / "dark.tif")
    if fault.startswith("noise"):
        frame = np.rint(dark + rng.normal(0.0, 4.0, dark.shape)).astype(np.uint16)
    elif fault == "saturated":
        frame[:45] = 65535
    tifffile.imwrite(tmp_path / "a.tif", frame)
    options = () if fault == "noise" else ("--dark", SAMPLE / "dark.tif")
    volume_of(weights, tmp_path / "a.tif", tmp_path / "v.vtkhdf", *options, "--json")
    told = [each["code"] for each in json.loads(capsys.readouterr().out)["warnings"]]
    assert told == TOLD[fault]
    assert [each["code"] for each in open_volume(tmp_path / "v.vtkhdf").provenance.get("warnings", [])] == told


# Of the sample's pixels three in five are lit.
@pytest.mark.thorough
@pytest.mark.parametrize(("percent", "word"), [(0, "good"), (0.3, "good"), (2, "look"), (15, "look"), (28, "no")])
def test_saturated_pixels_count_as_much_before_the_work_as_after_it(weights, frame, percent, word, tmp_path, capsys):
    dark = read_image(SAMPLE / "dark.tif").astype(float)
    light = frame - dark
    recorded = dark + light * 4000.0 / np.percentile(light, 100.0 - percent)
    tifffile.imwrite(tmp_path / "a.tif", np.clip(np.rint(recorded), 0, 4095).astype(np.uint16))
    options = tmp_path / "a.tif", "--dark", SAMPLE / "dark.tif"
    run("check", weights.parent / "rig.yaml", *options, "--json")
    before = {line["about"]: line["verdict"] for line in json.loads(capsys.readouterr().out)["verdicts"]}
    volume_of(weights, options[0], tmp_path / "v.vtkhdf", *options[1:])
    warnings = open_volume(tmp_path / "v.vtkhdf").provenance["warnings"]
    after = [word_of(each) for each in warnings if each["code"] == "frame-saturated"]
    assert [before["exposure"]] == (after or ["good"]) == [word]
