"""What `check` says of rigs and images: ten good ones, ten bad ones, and what its figures are worth."""

import json
import re
from collections.abc import Callable
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from lfpiv_cli import correlate
from lfpiv_cli.arrays import Singles
from lfpiv_cli.calibration.model import Calibration, Channel
from lfpiv_cli.cli.main import cli
from lfpiv_cli.files.config import Config
from lfpiv_cli.files.images import write_tiff
from lfpiv_cli.optics.camera import Camera, Lattice
from lfpiv_cli.optics.media import Media
from lfpiv_cli.optics.tracing import ObjectSpace
from lfpiv_cli.paper.small_rig import Case, Rig
from lfpiv_cli.particles.view import raw_view
from lfpiv_cli.synthetic.render import Balls, Readout, render_points, render_white
from lfpiv_cli.validation import planning
from lfpiv_cli.validation.planning import Tracer, errors_alone_mm, errors_by_depth_mm, half_view_mm, in_miniature
from lfpiv_cli.validation.volume import pairs_of
from lfpiv_cli.verbs.check import Pictures, image_lines, lattice_of
from lfpiv_cli.verbs.checks import Line, worst
from lfpiv_cli.verbs.init import RigNumbers, rig_text, tree_of
from lfpiv_cli.verbs.particles import light_of
from lfpiv_cli.verbs.planning import believed_line, bench_of, diffraction_line, rig_figures, rig_lines, windows_line
from tests.commands import WATER

Tree = dict[str, Any]
Image = Singles


def changed(tree: Tree, **keys: Any) -> Tree:
    """Return a configuration with keys, named section__key or section__part__key, replaced."""
    copy = json.loads(json.dumps(tree))
    for name, value in keys.items():
        *path, last = name.split("__")
        place = copy
        for part in path:
            place = place[part]
        place[last] = value
    return copy


def settings_of(tree: Tree) -> Config:
    return Config.from_resolved(tree, "rig.yaml")


def verdicts(lines: list[Line]) -> dict[str, str]:
    return {line.about: line.verdict for line in lines}


PLAIN = tree_of(RigNumbers())
LENS = "camera__main_lens__"
GOOD_RIGS = {
    "Table 2": PLAIN,
    "half size, large lenses": tree_of(RigNumbers(magnification=-0.5, pitch_mm=0.125, columns=3000, rows=2000)),
    "twice life size": tree_of(RigNumbers(magnification=-2.0)),
    "channel": tree_of(RigNumbers(channel_mm=10.0, wall_mm=5.0)),
    "in air": tree_of(RigNumbers(fluid=1.0)),
}
BAD_RIGS = {
    "f-numbers differ a little": (changed(PLAIN, camera__main_lens__f_number=2.8), "f-numbers", "look"),
    "f-numbers differ": (changed(PLAIN, camera__main_lens__f_number=16.0), "f-numbers", "no"),
    "beyond the depth of field": (changed(PLAIN, volume__size_mm=[2, 2, 70], window=None), "depth of field", "no"),
    "beyond the field of view": (changed(PLAIN, volume__size_mm=[20.0, 20.0, 8.0]), "field of view", "no"),
    "too dense": (changed(PLAIN, simulation__particles=60000), "seeding", "no"),
    "too sparse": (changed(PLAIN, simulation__particles=20), "seeding", "look"),
    "hardly any light": (changed(PLAIN, simulation__particle_counts=300.0), "precision", "no"),
    "a long time between images": (changed(PLAIN, correlation__dt_s=0.1), "time step", "no"),
    "voxels too wide": (changed(PLAIN, volume={"shape_xyz": [40, 40, 50], "voxel_mm": [0.2] * 3}), "voxels", "no"),
    "windows too large": (changed(PLAIN, correlation__window_mm=20.0), "windows", "no"),
}


@pytest.mark.thorough
@pytest.mark.parametrize("tree", GOOD_RIGS.values(), ids=GOOD_RIGS)
def test_good_rigs_are_good(tree: Tree) -> None:
    lines = rig_lines(bench_of(settings_of(tree), None))
    # These are by rays.
    found = [line for line in lines if line.verdict not in ("good", "unknown")]
    assert [(line.about, line.verdict) for line in found] == [("diffraction", "look")], found


@pytest.mark.parametrize(
    ("keys", "verdict", "words"),
    [
        ({}, "look", "532 nm over 4.3 um, 0.77 pixel; rays leave that out"),
        (
            {"reconstruction": {"wavelength_nm": 633.0}},
            "good",
            "633 nm over 5.1 um, 0.92 pixel; tracers are fitted by waves",
        ),
        ({"camera__sensor__pixel_um": 25.0}, "good", "0.17 pixel; rays are sharp enough"),
    ],
)
def test_what_rays_leave_out_is_said(keys: Tree, verdict: str, words: str) -> None:
    line = diffraction_line(bench_of(settings_of(changed(PLAIN, **keys)), None))
    assert line.verdict == verdict
    assert words in line.reason


@pytest.mark.parametrize(("index", "named"), [(1.33, True), (1.0, False)])
def test_what_no_snapshot_tells_is_said_with_how_far_off_results_are(index: float, named: bool) -> None:
    bench = replace(bench_of(settings_of(PLAIN), None), media=Media(1.0, 1.49, index))
    line = believed_line(bench)
    assert ("media.fluid of 1.33: 1% more makes depths and w 1% larger" in line.reason) == named
    # At -1 a depth is n p N / M^2, N growing with 1 - M.
    assert "magnification of -1: 1% more makes lengths 1.0% and depths 1.5% smaller" in line.reason
    # What rays through the middle of the lens do between the focal plane and the volume's end.
    side, depth = np.abs(bench.bounds_mm[:2]).max(), np.abs(bench.bounds_mm[2]).max()
    moved = float(re.search(r"corners by ([\d.]+) um", line.reason)[1])
    other = replace(bench.camera, focal_length_mm=1.01 * bench.camera.focal_length_mm).focus_distance_mm
    seen = side * depth * bench.media.depth_ratio * (1.0 / bench.camera.focus_distance_mm - 1.0 / other)
    assert moved == pytest.approx(1e3 * seen, rel=0.06)
    deeper = bench.camera.scale(replace(bench.media, fluid=1.01 * index)).depth_mm
    assert deeper == pytest.approx(1.01 * bench.scale.depth_mm, rel=1e-12)


@pytest.mark.thorough
def test_errors_by_waves_are_those_of_the_whole_camera() -> None:
    """A view of each depth alone tells what one of all depths does, and more than by rays: light is less sharp."""
    tree = changed(SMALL, reconstruction={"wavelength_nm": 532.0}, volume__size_mm=[1.5, 1.3, 2.0])
    bench = bench_of(settings_of(tree), None)
    light = light_of(bench.settings, (-1.0, 1.0))
    view = raw_view(bench.camera, WATER, 0.025, light=light)
    (seen, *_), _ = bench.seen
    at = np.array([[0.003, -0.004, seen.depths_mm[0], 5e5]])
    alone, whole = (errors_alone_mm(each, at, bench.tracer().readout) for each in (seen.view, view))
    np.testing.assert_allclose(alone, whole, rtol=2e-2)
    by_rays = bench_of(settings_of(changed(tree, reconstruction__wavelength_nm=None)), None)
    # At the volume's ends; about the focal plane waves tell depths that rays do not.
    assert np.all(bench.errors_mm[[0, -1]] > 1.05 * by_rays.errors_mm[[0, -1]])


@pytest.mark.thorough
@pytest.mark.parametrize(("tree", "about", "verdict"), BAD_RIGS.values(), ids=BAD_RIGS)
def test_bad_rigs_are_told(tree: Tree, about: str, verdict: str) -> None:
    lines = rig_lines(bench_of(settings_of(tree), None))
    assert verdicts(lines)[about] == verdict
    assert worst(lines) in ("look", "no")


# Volume and windows in voxels of 0.1 mm: the shipped sample's, and others that cells do not fill.
WINDOWS: list[tuple[tuple[int, int, int], Tree]] = [
    ((30, 22, 40), {"windows": (24, 12), "overlap": 0.5}),
    ((30, 22, 40), {"window_mm": 0.9, "overlap": 0.6}),
    ((21, 13, 40), {"windows": (14, (9, 14, 12)), "overlap": 0.75}),
]


@pytest.mark.parametrize(("shape", "keys"), WINDOWS)
def test_vectors_are_counted_as_they_are_made(shape: tuple[int, int, int], keys: Tree) -> None:
    tree = changed(PLAIN, volume={"shape_xyz": list(shape), "voxel_mm": 0.1}, correlation=keys)
    bench, light = bench_of(settings_of(tree), None), np.random.default_rng(1).random(shape[::-1])
    made = list(correlate(light, light, voxel_mm=bench.grid.spacing_mm, **keys).grid.shape_xyz)
    assert rig_figures(bench)["vectors_xyz"] == made
    (reported,) = (line for line in rig_lines(bench) if line.about == "windows")
    assert f"give {made[0]} x {made[1]} x {made[2]} vectors" in reported.reason
    assert (reported.verdict == "no") == ("do not fit" in reported.reason) == (shape[1] == 13)


# A corner of Table 2's sensor; the whole chain of figures on it takes seconds.
SMALL = tree_of(RigNumbers(columns=400, rows=360, size_mm=(1.5, 1.3, 6.0)))
SMALL["simulation"]["particles"] = 100
SMALL["correlation"]["window_mm"] = [0.4, 0.4, 1.6]
READOUT = Readout()
NOISY = replace(READOUT, read_noise_counts=40.0)


@pytest.mark.thorough
def test_the_work_by_particles_goes_with_the_tracers_and_is_told_beside_that_by_volumes() -> None:
    bench = bench_of(settings_of(SMALL), None)
    tracers = 0.5 * 15 * 13
    figures = rig_figures(bench)
    # As in an image of the shipped sample, whose 582 tracers take 9.1 s of a core; microlenses here are as large.
    assert figures["estimated_particles_core_s"] == pytest.approx(9.1 / 582 * tracers, rel=0.5)
    (work,) = (line.reason for line in rig_lines(bench) if line.about == "work")
    assert f"{figures['estimated_image_core_s']:.2g} s by volumes, " in work
    assert f"{figures['estimated_particles_core_s']:.2g} s by particles" in work


@pytest.mark.parametrize("windows", [{"windows": [24, 12]}, {"window_mm": 1.6}, {"window_mm": [0.1, 0.1, 1.2]}])
def test_windows_are_named_that_suit_volume_and_tracers(windows: Tree) -> None:
    tree = changed(PLAIN, volume__size_mm=[3.0, 2.2, 4.0], correlation=windows)
    line = windows_line(bench_of(settings_of(tree), None))
    named = re.search(
        r"set correlation.window_mm: (\[.*?\])( in place of correlation.windows)?, for (\d+ x \d+ x \d+)", line.reason
    )
    assert (line.verdict, named is not None) == ("look", True)
    assert named is not None
    assert bool(named[2]) == ("windows" in windows)
    better = windows_line(bench_of(settings_of(changed(tree, correlation={"window_mm": json.loads(named[1])})), None))
    assert f"give {named[3]} vectors" in better.reason
    assert "set correlation.window_mm" not in better.reason


class Photographer:
    """Takes pictures with the small rig."""

    def __init__(self) -> None:
        self.settings = settings_of(SMALL)
        self.camera = self.settings.camera_model()
        self.rng = np.random.default_rng(5)

    def tracers(
        self,
        per_lens: float = 0.5,
        counts: float = 5e5,
        depth_mm: tuple[float, float] = (-3.0, 3.0),
        readout: Readout = READOUT,
        camera: Camera | None = None,
    ) -> Image:
        low, high = np.array([-2.2, -2.0, depth_mm[0]]), np.array([2.2, 2.0, depth_mm[1]])
        count = round(per_lens * float(np.prod((high - low)[:2])) / 0.01)
        balls = Balls(self.rng.uniform(low, high, (count, 3)), np.full(count, counts), 0.05)
        space = ObjectSpace(WATER, None, "paraxial")
        light = render_points(camera or self.camera, space, balls, self.rng, rays=4000)
        return readout.record(light, self.rng).astype(np.float32)

    def white(self, camera: Camera | None = None, peak: float = 40000.0) -> Image:
        light = render_white(camera or self.camera, peak, 4)
        return READOUT.record(light, self.rng).astype(np.float32)

    def dark(self, level: float = 96.0) -> Image:
        readout = replace(READOUT, dark_level_counts=level)
        return readout.record(np.zeros((360, 400)), self.rng).astype(np.float32)

    def moved(self, pixels: float) -> Camera:
        """Return the camera with its array moved along the columns."""
        lattice = self.camera.lattice
        by = np.array([pixels * self.camera.pixel_mm, 0.0])
        return replace(self.camera, lattice=Lattice(lattice.origin + by, lattice.basis, lattice.layout))

    @cached_property
    def cap_on(self) -> Image:
        return self.dark()

    @cached_property
    def lattice(self) -> tuple[Calibration | None, list[Line]]:
        return lattice_of(self.settings, Pictures({}, self.white(), self.cap_on))

    def verdicts(self, image: Image) -> dict[str, str]:
        """Return what is said of an image beside a white and a dark one."""
        found, lines = self.lattice
        reported, _ = image_lines(bench_of(self.settings, found), Pictures({"a.tif": image}, None, self.cap_on), found)
        return verdicts([*lines, *reported])


@pytest.fixture(scope="module")
def take() -> Photographer:
    return Photographer()


GOOD_IMAGES: dict[str, Callable[[Photographer], Image]] = {
    "half a tracer per lens": lambda take: take.tracers(),
    "few tracers": lambda take: take.tracers(0.1),
    "one per lens": lambda take: take.tracers(1.0),
    "dimmer": lambda take: take.tracers(counts=1e5),
    "in the upper half of the volume": lambda take: take.tracers(depth_mm=(0.5, 3.0)),
}
BAD_IMAGES: dict[str, tuple[Callable[[Photographer], Image], str, tuple[str, ...]]] = {
    "saturated": (lambda take: np.minimum(take.tracers(counts=4e6), 4095.0), "exposure", ("no",)),
    "black": (lambda take: take.dark(), "light", ("no",)),
    "noisy": (lambda take: take.tracers(counts=2e4, readout=NOISY), "light", ("look", "no")),
    "array moved since the white image": (lambda take: take.tracers(camera=take.moved(1.0)), "drift", ("look",)),
    "array moved far": (lambda take: take.tracers(camera=take.moved(5.0)), "drift", ("no",)),
    "light from behind the volume": (lambda take: take.tracers(depth_mm=(6.0, 9.0)), "light outside", ("no",)),
    "white image as a frame": (lambda take: take.white(), "tracers", ("no",)),
    "another dark level": (lambda take: take.tracers() + np.float32(200.0), "background", ("look",)),
}


@pytest.mark.thorough
@pytest.mark.parametrize("make", GOOD_IMAGES.values(), ids=GOOD_IMAGES)
def test_good_images_are_good(take: Photographer, make: Callable[[Photographer], Image]) -> None:
    found = take.verdicts(make(take))
    assert set(found.values()) == {"good"}, found


@pytest.mark.thorough
@pytest.mark.parametrize(("make", "about", "expected"), BAD_IMAGES.values(), ids=BAD_IMAGES)
def test_bad_images(
    take: Photographer, make: Callable[[Photographer], Image], about: str, expected: tuple[str, ...]
) -> None:
    assert take.verdicts(make(take))[about] in expected


@pytest.mark.slow
def test_crowded_tracers_are_told(take: Photographer) -> None:
    assert take.verdicts(take.tracers(6.0))["tracers"] == "no"


@pytest.mark.thorough
def test_a_white_image_of_another_camera_is_told(take: Photographer) -> None:
    other = replace(take.camera, lattice=Lattice.regular(0.12))
    pictures = Pictures({"a.tif": take.tracers(0.1)}, take.white(other), take.cap_on)
    found, lines = lattice_of(take.settings, pictures)
    assert verdicts(lines)["white image"] == "no"
    reported, _ = image_lines(bench_of(take.settings, found), pictures, found)
    assert verdicts(reported)["drift"] == "unknown"


@pytest.mark.thorough
@pytest.mark.parametrize("per_lens", [0.1, 0.5, 1.5])
def test_tracers_are_counted(per_lens: float) -> None:
    own = Photographer()
    pictures = Pictures({name: own.tracers(per_lens) for name in "abcd"}, None, own.cap_on)
    _, figures = image_lines(bench_of(own.settings, None), pictures, None)
    # Of four times 200 lenses, 80 tracers at least: to a ninth by chance.
    assert np.mean(figures["tracers_per_lens"]) == pytest.approx(per_lens, rel=0.3)
    assert np.median(figures["tracer_counts"]) == pytest.approx(5e5, rel=0.3)


def test_the_part_in_front_of_a_box_is_where_its_tracers_are(take: Photographer) -> None:
    bounds = np.array([[0.3, 0.9], [-0.8, -0.5], [2.0, 2.2]])
    balls = Balls(np.array([[0.6, -0.65, 2.1]]), np.array([5e5]), 0.05)
    light = render_points(take.camera, ObjectSpace(WATER, None, "paraxial"), balls, take.rng, rays=4000)
    rows, columns = planning.part_in_front(take.camera, WATER, bounds)
    row, column = (np.sum(light * each) / light.sum() for each in np.indices(light.shape))
    assert (rows.start + rows.stop) / 2 == pytest.approx(row, abs=3.0)
    assert (columns.start + columns.stop) / 2 == pytest.approx(column, abs=3.0)
    assert columns.stop - columns.start == pytest.approx(0.6 / 0.0055, rel=0.03)
    # The share in view is that of points.
    bounds = np.array([[-1.5, 1.5], [-0.5, 0.5], [-4.0, 4.0]])
    points = take.rng.uniform(bounds[:, 0], bounds[:, 1], (20000, 3))
    inside = np.abs(points[:, 0]) <= half_view_mm(take.camera, WATER, points[:, 2])[:, 0]
    # Of so many points a share is known to a hundredth.
    assert planning.share_in_view(take.camera, WATER, bounds) == pytest.approx(np.mean(inside), abs=0.012)


@pytest.mark.slow
def test_errors_are_those_that_are_measured() -> None:
    """Tracers that stand apart, found by the program, err by what was told before; rays make hardly any noise."""
    camera = Camera(-1.0, 100.0, 25.0, 0.8, 0.8, Lattice.regular(0.1), 0.0055, 560, 560)
    rig = Rig(camera, WATER, Channel(12.0, 2.0), refraction="paraxial")
    search, rng = Case(rig, rig, (2.6, 2.6, 8.4)), np.random.default_rng(3)
    depths, rays = np.array([-4.0, -2.5, 1.5, 3.0]), 400_000
    seen = in_miniature(camera, WATER, depths, 0.025)
    reported = errors_by_depth_mm(seen, Tracer(5e5, 0.025, READOUT), 5e5 / rays)
    ratios = []
    for _ in range(4):
        x, y = (each.ravel() for each in np.meshgrid([-0.85, 0.0, 0.85], [-0.85, 0.0, 0.85]))
        layer = rng.integers(0, 4, x.size)
        points = np.column_stack([x, y, depths[layer]])
        points[:, :2] += rng.uniform(-0.045, 0.045, (x.size, 2))
        balls = Balls(rig.reference.points_to_focal_point(points), np.full(x.size, 5e5), 0.05)
        image = READOUT.record(render_points(camera, rig.space, balls, rng, rays=rays), rng)
        pairs = pairs_of(search.particles(image.astype(np.float32) - np.float32(96.0)), points, 0.03)
        assert len(pairs.true) == x.size
        ratios.append(pairs.error_voxel / reported[layer[pairs.true]])
    lateral, depth = np.concatenate(ratios)[:, :2], np.concatenate(ratios)[:, 2]
    # Of 36 tracers a standard deviation is known to an eighth.
    assert np.sqrt(np.mean(lateral**2)) == pytest.approx(1.0, abs=0.3)
    assert np.sqrt(np.mean(depth**2)) == pytest.approx(1.0, abs=0.3)


@pytest.mark.thorough
def test_the_command_tells_all(tmp_path: Path) -> None:
    rig, image, picture = tmp_path / "rig.yaml", tmp_path / "a.tif", tmp_path / "rig.png"
    rig.write_text(rig_text(SMALL, "small"))
    write_tiff(image, Photographer().tracers().astype(np.uint16), False)
    done = CliRunner().invoke(cli, ["check", str(rig), str(image), "--picture", str(picture), "--json"])
    assert done.exit_code == 0, done.output
    reported = json.loads(done.stdout)
    # Windows that fit into so small a volume hold few tracers, and the rig is by rays.
    assert {line["about"] for line in reported["verdicts"] if line["verdict"] == "look"} == {"windows", "diffraction"}
    assert reported["verdict"] == "look"
    assert {line["about"] for line in reported["verdicts"]} >= {"field of view", "time step", "exposure", "tracers"}
    assert reported["best_dt_s"] == pytest.approx(5 * 0.1 / 3 / reported["expected_velocity_m_s"] / 1e3, rel=0.05)
    assert picture.read_bytes().startswith(b"\x89PNG")
    faster = CliRunner().invoke(cli, ["check", str(rig), "--velocity-m-s", "10"])
    assert faster.exit_code == 0
    assert re.search(r"time step +no +", faster.output)
