"""Solvers: Eq. 12 against its loops, fixed points, guarded sums; `reconstruct` on images that are not perfect."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tifffile

from lfpiv_cli.errors import InputError, OutputExistsError
from lfpiv_cli.files.images import read_image
from lfpiv_cli.files.vtkhdf import open_volume
from lfpiv_cli.grid import Grid
from lfpiv_cli.optics.camera import Lattice
from lfpiv_cli.reconstruction import solvers
from lfpiv_cli.reconstruction.registry import SOLVERS
from lfpiv_cli.reconstruction.solvers import Problem, SolverSettings, Stopping, normalisers, reconstruct
from lfpiv_cli.verbs.checks import word_of
from lfpiv_cli.verbs.frames import Background
from lfpiv_cli.weights.build import factorise
from tests.commands import SAMPLE, run, sample_weights, summary_of


class DenseOperator:
    """Weights as a plain matrix (pixels, voxels) on a 1 x 1 x n volume and a 1 x m image.

    Not by BLAS: its kernels read beyond rows as short as these, and may raise flags of what happens to lie there.
    """

    def __init__(self, matrix: np.ndarray) -> None:
        self.matrix = matrix.astype(np.float32)
        self.shape = (1, 1, matrix.shape[1])

    def forward(self, volume: np.ndarray) -> np.ndarray:
        return np.einsum("pv,v->p", self.matrix, volume.ravel())[np.newaxis]

    def adjoint(self, image: np.ndarray) -> np.ndarray:
        return np.einsum("pv,p->v", self.matrix, image.ravel()).reshape(self.shape)


@pytest.fixture
def dense(rng) -> DenseOperator:
    return DenseOperator(rng.random((9, 5)) * (rng.random((9, 5)) < 0.6))


@pytest.fixture
def optical(table2, water):
    camera = replace(table2, columns=220, rows=200, lattice=Lattice.regular(0.1))
    return factorise(camera, water, Grid.centred((8, 7, 6), (0.1, 0.1, 0.5), (0.0, 0.0, 2.0)))


def stepped(step, dense: DenseOperator, image: np.ndarray, volume: np.ndarray, relaxation: float) -> np.ndarray:
    """Return what a solver's step makes of a volume."""
    problem = Problem(dense, image[np.newaxis].astype(np.float32), normalisers(dense))
    start = volume.reshape(dense.shape).astype(np.float32)
    return step(problem, start, dense.forward(start), relaxation).ravel()


def test_sart_step_is_eq_12_written_as_loops(dense, rng):
    w, image, volume = dense.matrix, rng.random(9), rng.random(5)
    expected = volume.copy()
    for j in range(5):
        numerator = denominator = 0.0
        for i in range(9):
            row_sum = sum(w[i, n] for n in range(5))
            if row_sum > 0:
                numerator += (image[i] - sum(w[i, n] * volume[n] for n in range(5))) / row_sum * w[i, j]
                denominator += w[i, j]
        expected[j] += 0.7 * numerator / denominator
    np.testing.assert_allclose(
        stepped(solvers.sart_step, dense, image, volume, 0.7), np.maximum(expected, 0), rtol=1e-5
    )


@pytest.mark.parametrize("solver", SOLVERS)
def test_true_volume_is_a_fixed_point(optical, rng, solver):
    truth = rng.random(optical.shape, dtype=np.float32)
    sums = normalisers(optical)
    image = optical.forward(truth)
    problem = Problem(optical, image, sums)
    seen = sums.inverse_column_sum > 0
    stepped = SOLVERS[solver].step()(problem, truth, image, 1.0)
    # Pixels below the guard are left out of numerator and denominator alike, so only float32 rounding remains.
    np.testing.assert_allclose(stepped[seen], truth[seen], rtol=1e-4)


@pytest.mark.thorough
@pytest.mark.parametrize("solver", SOLVERS)
def test_residual_falls_volume_stays_non_negative_and_momentum_takes_fewer_steps(optical, rng, solver):
    truth = np.zeros(optical.shape, np.float32)
    truth[rng.integers(0, 6, 8), rng.integers(0, 7, 8), rng.integers(0, 8, 8)] = 100.0
    image = optical.forward(truth)
    plain = reconstruct(optical, image, SolverSettings(solver, 24))
    fast = reconstruct(optical, image, SolverSettings(solver, 12, accelerate=True))
    assert np.all(np.diff(plain.residual) < 0)
    assert plain.residual[12] < 0.5 * plain.residual[0]
    assert fast.residual[-1] < plain.residual[-1]
    assert min(plain.volume.min(), fast.volume.min()) >= 0.0
    dark = reconstruct(optical, np.full(optical.image_shape, -3.0, np.float32), SolverSettings(solver, 3))
    assert not dark.volume.any()
    assert np.all(np.isfinite(dark.residual))


def test_mart_takes_its_pixels_in_turn_and_smart_all_at_once(dense, rng):
    # On a 1 x 9 image the blocks of four columns are the pixels 0, 4, 8, then 1, 5, and so on.
    w, image, volume = dense.matrix, rng.random(9) + 0.5, rng.random(5) + 0.5
    expected = volume.copy()
    for first in range(4):
        block = [i for i in range(first, 9, 4) if w[i].sum() > 0]
        now = expected.copy()
        largest = max(sum(w[i, j] for i in block) for j in range(5))
        for j in range(5):
            exponent = sum(w[i, j] * np.log(image[i] / (w[i] @ now)) for i in block)
            expected[j] *= np.exp(0.8 * exponent / largest)
    np.testing.assert_allclose(stepped(solvers.mart_step, dense, image, volume, 0.8), expected, rtol=1e-4)
    ratio = np.divide(image, w @ volume, out=np.ones(9), where=w.sum(axis=1) > 0)
    expected = volume * np.prod(ratio[:, np.newaxis] ** w, axis=0) ** (0.8 / w.sum(axis=0))
    np.testing.assert_allclose(stepped(solvers.smart_step, dense, image, volume, 0.8), expected, rtol=1e-4)


@pytest.mark.parametrize("accelerate", [False, True])
@pytest.mark.parametrize("solver", ["sart", "em", "smart"])
def test_excluded_pixels_are_deleted_rows(dense, rng, solver, accelerate):
    image = (dense.matrix @ rng.random(5) * rng.uniform(0.8, 1.2, 9)).astype(np.float32)
    excluded = np.array([False, True, False, False, True, False, False, False, False])
    spoilt = np.where(excluded, np.float32(65535.0), image)[np.newaxis]
    fewer = DenseOperator(dense.matrix[~excluded])
    settings = SolverSettings(solver, 12, accelerate=accelerate)
    expected = reconstruct(fewer, image[np.newaxis, ~excluded], settings)
    for sums in (normalisers(dense, excluded[np.newaxis]), normalisers(dense).without(dense, excluded[np.newaxis])):
        found = reconstruct(dense, spoilt, settings, sums=sums)
        np.testing.assert_allclose(found.volume, expected.volume, rtol=1e-4)
        np.testing.assert_allclose(found.residual, expected.residual, rtol=1e-4)


@pytest.mark.parametrize("solver", ["sart", "em", "smart"])
def test_voxels_out_of_the_support_are_deleted_columns(dense, rng, solver):
    image = (dense.matrix @ rng.random(5)).astype(np.float32)[np.newaxis]
    support = np.array([True, False, True, True, False])
    expected = reconstruct(DenseOperator(dense.matrix[:, support]), image, SolverSettings(solver, 12)).volume
    sums = normalisers(dense).within(dense, support.reshape(dense.shape))
    found = reconstruct(dense, image, SolverSettings(solver, 12), sums=sums)
    np.testing.assert_allclose(found.volume.ravel()[support], expected.ravel(), rtol=1e-4)
    assert not found.volume.ravel()[~support].any()
    assert found.support_voxels == 3


def test_line_of_sight_start_is_the_geometric_mean_of_what_pixels_allow(dense, rng):
    w, image = dense.matrix, rng.random(9) + 0.5
    seen = w.sum(axis=1) > 0
    level = image[seen] / w[seen].sum(axis=1)
    expected = np.prod(level[:, np.newaxis] ** w[seen], axis=0) ** (1.0 / w.sum(axis=0))
    start = solvers.line_of_sight_start(
        Problem.of(dense, image[np.newaxis].astype(np.float32), normalisers(dense))
    ).ravel()
    np.testing.assert_allclose(start / start[0], expected / expected[0], rtol=1e-4)
    assert (w @ start)[seen].sum() == pytest.approx(image[seen].sum(), rel=1e-4)


def test_line_of_sight_leaves_dark_voxels_out_for_good(optical):
    truth = np.zeros(optical.shape, np.float32)
    truth[2, 3, 4] = 100.0
    image = optical.forward(truth)
    sums = normalisers(optical)
    support = solvers.lit_support(optical, image, sums)
    assert support[2, 3, 4]
    assert support.sum() < 0.5 * support.size
    start = solvers.line_of_sight_start(Problem(optical, image, sums))
    assert np.unravel_index(start.argmax(), start.shape) == (2, 3, 4)
    assert start.sum() == pytest.approx(100.0, rel=0.05)
    # voxels of the support do not light the whole sensor: the pixels they miss are left out with the others
    volume = reconstruct(optical, image, SolverSettings("sart", 20, start="line_of_sight")).volume
    assert not volume[~support].any()
    assert volume[2, 3, 4] == volume.max()


@pytest.mark.thorough
def test_stopping_by_change_and_by_residual(optical, rng):
    image = optical.forward(rng.random(optical.shape, dtype=np.float32))
    whole = reconstruct(optical, image, SolverSettings("em", 60))
    relative = 1.0 - whole.residual[1:] / whole.residual[:-1]
    first = int(np.argmax(relative < 0.02))
    by_change = reconstruct(optical, image, SolverSettings("em", 60, stopping=Stopping(change=0.02)))
    np.testing.assert_array_equal(by_change.residual, whole.residual[: first + 2])
    limit = float(whole.residual[7])
    by_residual = reconstruct(optical, image, SolverSettings("em", 60, stopping=Stopping(residual=limit)))
    np.testing.assert_array_equal(by_residual.residual, whole.residual[:8])


def test_momentum_restarts_where_a_step_points_back_and_kernels_are_their_array_twins(rng):
    volume = np.array([[[1.0, 2.0]]], np.float32)
    ahead = solvers.extrapolated(5.0, volume, volume - 1, volume)
    back = solvers.extrapolated(5.0, volume + 1, volume - 1, volume)
    pace = 0.5 * (1.0 + np.sqrt(101.0))
    np.testing.assert_allclose(ahead[1], volume + 4.0 / pace, rtol=1e-6)
    np.testing.assert_array_equal(back[1], volume)
    assert back[0] < ahead[0]
    image, projection = rng.random((2, 7, 5), dtype=np.float32)
    inverse = rng.random((7, 5), dtype=np.float32) * (rng.random((7, 5)) < 0.7).astype(np.float32)
    projection[2, 3] = 0.0
    inverse[2, 3] = 1.0
    change, ratio, squares = np.empty_like(image), np.empty_like(image), np.empty(7)
    writers = (
        (solvers.write_correction, change),
        (solvers.write_ratio, ratio),
        (solvers.write_square_differences, squares),
    )
    for write, result in writers:
        for rows in ((0, 4), (4, 7)):
            write(rows, image, projection, inverse, result)
    np.testing.assert_array_equal(change, (image - projection) * inverse)
    lit = (projection > 0.0) & (inverse > 0.0)
    expected = np.divide(image, projection, out=np.zeros_like(image), where=lit)
    np.testing.assert_array_equal(ratio, expected)
    expected = np.where(inverse > 0.0, (image - projection).astype(np.float64) ** 2, 0.0).sum(axis=1)
    np.testing.assert_allclose(squares, expected, rtol=1e-14)
    matrix = np.array([[1.0, 0.0, 0.0], [0.5, 0.5, 0.0], [0.0, 0.0, 0.0]])
    image = np.array([[2.0, 3.0, 50.0]], np.float32)  # the third pixel is lit by nothing in the volume
    for solver in SOLVERS:
        volume = reconstruct(DenseOperator(matrix), image, SolverSettings(solver, 400)).volume.ravel()
        np.testing.assert_allclose(volume, [2.0, 4.0, 0.0], rtol=0.02)


REFLECTION = (slice(180, 230), slice(250, 320))


def build(folder: Path, *changes: tuple[str, str]) -> Path:
    """Return weights of a part of the sample's volume, without a calibration."""
    return sample_weights(folder, ("shape_xyz: [30, 22, 40]", "shape_xyz: [16, 12, 20]"), *changes)


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


def test_frames_around_a_frame_and_a_background_over_others_is_another_input(weights, frame, tmp_path):
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


def test_frames_that_show_nothing_are_refused_or_told(weights, frame, tmp_path, capsys):
    for counts in (0, 65535):
        tifffile.imwrite(tmp_path / "nothing.tif", np.full_like(frame, counts))
        with pytest.raises(InputError, match=rf"nothing.tif: has one value everywhere \({counts}\)"):
            volume_of(weights, tmp_path / "nothing.tif", tmp_path / "v.vtkhdf")
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
    assert not (tmp_path / "v.vtkhdf").exists()
    dark = SAMPLE / "dark.tif"
    summary = summary_of(
        capsys, "reconstruct", weights, dark, "--iterations", 4, "--dark", dark, "-o", tmp_path / "v.vtkhdf"
    )
    texts = {each["code"]: each["text"] for each in summary["warnings"]}
    assert texts["frame-given-before"] == "the file is also the dark of reconstruct: it shows no tracers"


# The weights believe the data sheet, and the sample's lens images lie a few pixels beside it.
REPORTED = {
    "none": ["lens-images-moved"],
    "noise": ["frame-dark", "dark-level"],
    "noise less dark": ["frame-dark"],
    "saturated": ["frame-saturated", "lens-images-moved"],
}


@pytest.mark.thorough
@pytest.mark.parametrize("fault", REPORTED)
def test_a_frame_of_noise_or_half_saturated_is_told(weights, frame, fault, tmp_path, rng, capsys):
    dark = read_image(SAMPLE / "dark.tif")
    if fault.startswith("noise"):
        frame = np.rint(dark + rng.normal(0.0, 4.0, dark.shape)).astype(np.uint16)
    elif fault == "saturated":
        frame[:45] = 65535
    tifffile.imwrite(tmp_path / "a.tif", frame)
    options = () if fault == "noise" else ("--dark", SAMPLE / "dark.tif")
    command = ("reconstruct", weights, tmp_path / "a.tif", "--iterations", 4, *options, "-o", tmp_path / "v.vtkhdf")
    summary = summary_of(capsys, *command)
    for warnings in (summary["warnings"], open_volume(tmp_path / "v.vtkhdf").provenance.get("warnings", [])):
        assert [each["code"] for each in warnings] == REPORTED[fault]


# Of the sample's pixels three in five are lit.
@pytest.mark.thorough
@pytest.mark.parametrize(("percent", "word"), [(0, "good"), (0.3, "good"), (2, "look"), (15, "look"), (28, "no")])
def test_saturated_pixels_count_as_much_before_the_work_as_after_it(weights, frame, percent, word, tmp_path, capsys):
    dark = read_image(SAMPLE / "dark.tif").astype(float)
    light = frame - dark
    recorded = dark + light * 4000.0 / np.percentile(light, 100.0 - percent)
    tifffile.imwrite(tmp_path / "a.tif", np.clip(np.rint(recorded), 0, 4095).astype(np.uint16))
    options = tmp_path / "a.tif", "--dark", SAMPLE / "dark.tif"
    verdicts = summary_of(capsys, "check", weights.parent / "rig.yaml", *options)["verdicts"]
    before = {line["about"]: line["verdict"] for line in verdicts}
    volume_of(weights, options[0], tmp_path / "v.vtkhdf", *options[1:])
    warnings = open_volume(tmp_path / "v.vtkhdf").provenance["warnings"]
    after = [word_of(each) for each in warnings if each["code"] == "frame-saturated"]
    assert [before["exposure"]] == (after or ["good"]) == [word]
