"""`report` and `plot`: what is found in a folder, the figures of each kind of file, the page made of them."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from click.testing import CliRunner

from lfpiv_cli.arrays import Floats
from lfpiv_cli.cli.main import cli
from lfpiv_cli.console import Console
from lfpiv_cli.errors import InputError, OutputExistsError, UsageError
from lfpiv_cli.files.config import load_rig
from lfpiv_cli.files.hdf5 import write_tree
from lfpiv_cli.files.images import write_tiff
from lfpiv_cli.files.pages import Page
from lfpiv_cli.files.particle_file import PARTICLES_FORMAT, TRACKS_FORMAT, TRAJECTORIES_FORMAT, Points, write_points
from lfpiv_cli.files.provenance import sha256
from lfpiv_cli.files.vtkhdf import open_vectors, write_vectors, write_volume
from lfpiv_cli.flow.windows import ParallelWalls
from lfpiv_cli.grid import Grid, Reference
from lfpiv_cli.pictures.points import Lines, has_views, lines_view, wall_dots
from lfpiv_cli.verbs import checks
from lfpiv_cli.verbs import report as stage
from lfpiv_cli.verbs.contents import contents_of, judged
from lfpiv_cli.verbs.plot import figures_of
from lfpiv_cli.verbs.report import ReportOptions, report
from tests import vector_fields
from tests.browser import CHROMIUM, opened
from tests.commands import ROOT, run, summary_of, table2_rig
from tests.vector_fields import SHAPE, SIGMA_VOXEL, field_of, noise_mm, pair_tracks, points_of, rotation_mm, steady_mm

QUIET = Console(quiet=True)
REFERENCE = Reference("focal_point", 0.0)
WARNING = {"code": "few-tracers", "about": "a <b>", "text": "too few", "remedy": "seed more", "measured": None}
TRACKS = 40


def record(command: str, *warnings: dict[str, Any]) -> dict[str, Any]:
    made: dict[str, Any] = {
        "command": command,
        "version": "0.1.0",
        "libraries": {"numpy": "2"},
        "config": {"camera": {"pitch_mm": 0.125}},
        "inputs": {"volume_a": {"name": "a.vtkhdf", "sha256": "0123456789abcdef" * 4}},
    }
    return made | ({"warnings": list(warnings)} if warnings else {})


def put(path: Path, moved_mm: Floats, made: dict[str, Any], sigma_voxel: Floats = SIGMA_VOXEL) -> None:
    """Write vectors of a flow with errors of stated size."""
    write_vectors(path, field_of(moved_mm, sigma_voxel), REFERENCE, provenance=made, overwrite=False)


@pytest.fixture
def results(tmp_path: Path) -> Path:
    """A folder with vectors by volumes, vectors by tracks in a folder below, and the tracks."""
    folder = tmp_path / "results"
    (folder / "tracked").mkdir(parents=True)
    flow = 20.0 * rotation_mm()
    put(folder / "vectors.vtkhdf", flow + noise_mm(0), record("correlate"))
    put(folder / "tracked" / "grid.vtkhdf", flow + noise_mm(1), record("correlate", WARNING))
    position, along = np.random.default_rng(0).uniform(-2.0, 2.0, (TRACKS, 3)), np.tile([0.3, 0.0, 0.1], (TRACKS, 1))
    points = pair_tracks(position, along, 0.01, 1e-3, record("track"), REFERENCE)
    write_points(folder / "tracks.vtkhdf", TRACKS_FORMAT, points, overwrite=False)
    return folder


@pytest.fixture(autouse=True)
def few_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """One figure of each file: drawing them all takes long, and tests of their own look at them."""
    monkeypatch.setattr(stage, "figures_of", lambda *given: dict([next(iter(figures_of(*given).items()))]))


def test_contents_are_in_the_order_of_the_chain_and_broken_files_are_named(results: Path, tmp_path: Path) -> None:
    found = contents_of(results)
    assert [path.name for path in found.of("vectors")] == ["grid.vtkhdf", "vectors.vtkhdf"]
    assert list(found.records) == ["tracked/grid.vtkhdf", "vectors.vtkhdf", "tracks.vtkhdf"]
    (results / "volume.vtkhdf").write_bytes(b"\x89HDF\r\n\x1a\n broken")
    with pytest.raises(InputError, match=r"volume\.vtkhdf"):
        contents_of(results)
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="holds no file of lfpiv"):
        contents_of(tmp_path / "empty")
    with pytest.raises(InputError, match="is no folder"):
        contents_of(tmp_path / "none")


@pytest.mark.thorough
def test_the_page_holds_all(results: Path, tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    summary = report(results, page, console=QUIET)
    assert summary["verdict"] == {"calibration": "look", "images": "look", "vectors": "look"}
    text = page.read_text(encoding="utf-8")
    for words in ("Vectors", "Tracks", "Warnings", "Settings", "Provenance", "pitch_mm: 0.125", "few-tracers"):
        assert words in text
    assert "a &lt;b&gt;: too few" in text
    assert text.count('><img src="data:image/png;base64,') == summary["pictures"]
    outcome = CliRunner().invoke(cli, ["report", str(results), "-o", str(tmp_path / "again.html")])
    assert outcome.exit_code == 0, outcome.output
    assert re.search(r"verdict +calibration look, images look, vectors look", outcome.stdout)


def test_a_page_is_made_once_and_shows_some_of_many_lines(results: Path, tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    page.write_text("mine")
    with pytest.raises(OutputExistsError):
        report(results, page, console=QUIET)
    assert page.read_text() == "mine"
    with pytest.raises(UsageError, match=r"ends in \.html"):
        report(results, tmp_path / "page.pdf", console=QUIET)
    pytest.importorskip("plotly")
    few, many = (lines_view(parallel_lines(count), with_script=False) for count in (4000, 12_000))
    assert len(many) == pytest.approx(len(few), rel=0.01)
    assert lines_view(parallel_lines(0))


def parallel_lines(count: int) -> Lines:
    places = [np.array([[k, 0.0, 0.0], [k, 1.0, 0.0]]) for k in range(count)]
    return Lines(places, [np.full(2, 0.1 * k) for k in range(count)], np.ones(count))


def test_a_view_has_faint_lines_where_errors_are_large_walls_and_one_script() -> None:
    pytest.importorskip("plotly")
    lines, walls = parallel_lines(5), ParallelWalls(4.0)
    faint = replace(lines, sigma_m_s=np.array([1.0, 1.0, 1.0, 1.0, 9.0]))
    plain, seen = (lines_view(each, with_script=False) for each in (lines, faint))
    empty = '"x":[],"y":[]'
    assert empty in plain
    assert empty not in seen
    # from the least speed to the largest but for a percent at each end
    assert '"cmin":0.0' in plain
    assert '"cmax":0.4' in plain
    with_walls = lines_view(lines, walls, name="second", with_script=False)
    assert len(with_walls) > len(plain)
    assert 'id="second"' in with_walls
    dots = wall_dots(lines.places_mm, walls)
    assert set(dots[:, 2]) == {-2.0, 2.0}
    np.testing.assert_array_equal((dots.min(axis=0)[:2], dots.max(axis=0)[:2]), ([0.0, 0.0], [4.0, 1.0]))
    assert "<script src" not in plain
    assert len(lines_view(lines)) > len(plain) + 1_000_000


def test_pictures_are_drawn_on_their_raw_image(results: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    image, other = results / "image.tif", results / "other.tif"
    for counts, path in enumerate((image, other)):
        write_tiff(path, np.full((2, 3), counts, np.uint8), overwrite=False)
    made = {"inputs": {"image": {"name": "image.tif", "sha256": sha256(image)}}}
    arrays = {"intensity": np.ones(3), "covariance_mm2": np.ones((3, 6)), "chi2": np.ones(3), "seen": np.ones(3)}
    points = Points(np.zeros((3, 3)), arrays | {"flag": np.zeros(3, np.uint8)}, REFERENCE, {}, made)
    write_points(results / "particles.vtkhdf", PARTICLES_FORMAT, points, overwrite=False)
    drawn_on: dict[str, Path | None] = {}

    def none_of(path: Path, raw: Path | None = None) -> dict[str, Any]:
        drawn_on[path.name] = raw
        return {}

    monkeypatch.setattr(stage, "figures_of", none_of)
    report(results, tmp_path / "page.html", ReportOptions(raw=[other, image]), console=QUIET)
    assert {name for name, raw in drawn_on.items() if raw} == {"particles.vtkhdf"}
    assert drawn_on["particles.vtkhdf"] == image


@pytest.mark.thorough
@pytest.mark.parametrize(("commands", "word"), [(("track", "correlate"), "good"), (("correlate", "correlate"), "look")])
def test_poor_vectors_count_unless_better_ones_do(commands: tuple[str, str], word: str, tmp_path: Path) -> None:
    for name, command, sigma in zip("ab", commands, (SIGMA_VOXEL, [0.05, 0.02, 1.2]), strict=True):
        put(tmp_path / f"{name}.vtkhdf", steady_mm(), record(command), np.asarray(sigma))
    summary = report(tmp_path, tmp_path / "page.html", console=QUIET)
    assert summary["verdict"]["vectors"] == word
    assert "w is known to 0.36 mm" in (tmp_path / "page.html").read_text(encoding="utf-8")


@pytest.mark.thorough
def test_vectors_of_different_times_are_not_held_against_each_other(tmp_path: Path) -> None:
    for number in range(3):
        put(tmp_path / f"{number}.vtkhdf", steady_mm(1.0 + number), record("correlate"))
    assert report(tmp_path, tmp_path / "page.html", console=QUIET)["verdict"]["vectors"] == "good"


@pytest.mark.thorough
def test_all_but_the_best_have_one_figure(results: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stage, "figures_of", figures_of)
    grid = results / "tracked" / "grid.vtkhdf"
    write_vectors(grid, open_vectors(grid), REFERENCE, provenance=record("track"), overwrite=True)
    report(results, tmp_path / "page.html", console=QUIET)
    drawn = re.findall(r"<figcaption>([\w.]+):", (tmp_path / "page.html").read_text(encoding="utf-8"))
    # alike in all else, the one whose name is first
    assert (drawn.count("grid.vtkhdf"), drawn.count("vectors.vtkhdf")) == (3, 1)


def test_the_first_line_tells_all_at_once(results: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pages: list[Page] = []
    monkeypatch.setattr(stage, "write_pages", lambda page, *_given: pages.append(page))
    report(results, tmp_path / "page.html", console=QUIET)
    number = 2 * np.prod(SHAPE)
    size = "8.8 x 6 x 9.9 mm"
    assert pages[0].title.startswith(f"{number:,} vectors of 2 pairs in {size}; ")
    # 0.05 voxel of 0.1 mm, 0.4 of 0.3 mm in 1 ms
    assert "known to 0.005 m/s across and 0.12 m/s in depth; 3 faults speak against it." in pages[0].title
    faults, remarks = pages[0].sections[:2]
    assert [word for word, _ in faults.points] == ["look"] * 3
    assert "a <b>: too few; seed more" in [text for _, text in faults.points]
    assert [word for word, _ in remarks.points] == [""] * len(remarks.points)


def few_planes(planes: int) -> set[str]:
    """Return what a field of some planes across z says against itself."""
    moved = steady_mm()[:planes] / vector_fields.VOXEL_MM
    grid = Grid((*SHAPE[:0:-1], planes), (0.8, 0.6, 1.1), (0.0,) * 3)
    few = vector_fields.field_on(grid, moved, None, np.broadcast_to(SIGMA_VOXEL, moved.shape), vector_fields.VOXEL_MM)
    return {line.reason for line in checks.of_vectors(few, "f") if line.verdict != "good"}


def test_two_planes_are_not_good() -> None:
    assert few_planes(3) == set()
    assert any("planes of vectors along z: 2" in reason for reason in few_planes(2))


def test_the_verdict_is_of_tracks_where_volumes_beside_them_are_poor(tmp_path: Path) -> None:
    put(tmp_path / "tracks_grid.vtkhdf", steady_mm(), record("track"))
    put(tmp_path / "vectors.vtkhdf", steady_mm() + 5.0 * noise_mm(1), record("correlate", WARNING))
    contents = contents_of(tmp_path)
    fields = {path: open_vectors(path) for path in contents.of("vectors")}
    said = {line.reason: line.verdict for line in judged(contents, fields)["vectors"]}
    assert set(said.values()) == {"good"}
    assert "a <b>: too few; seed more" in said
    assert any(reason.startswith("the verdict on vectors is of those by track") for reason in said)
    # alone, what is said of volumes counts
    (tmp_path / "tracks_grid.vtkhdf").unlink()
    alone = contents_of(tmp_path)
    assert "look" in {line.verdict for line in judged(alone, dict(list(fields.items())[1:]))["vectors"]}
    # The worst comes first, here after what is said for information.
    (tmp_path / "vectors.vtkhdf").unlink()
    put(tmp_path / "vectors.vtkhdf", noise_mm(1), record("correlate", WARNING | {"code": "heavy-work"}))
    alone = contents_of(tmp_path)
    fields = {path: open_vectors(path) for path in alone.of("vectors")}
    assert [line.verdict for line in judged(alone, fields)["vectors"]] == ["look", "good", "good"]


def test_many_pairs_stand_in_order_without_empty_settings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pages: list[Page] = []
    monkeypatch.setattr(stage, "write_pages", lambda page, *_given: pages.append(page))
    made = record("correlate")
    made["config"] = {"camera": {"pitch_mm": 0.125, "name": None}, "pipe": {"axis": None}, "windows": [None, 8]}
    for number in (10, 9, 1):
        put(tmp_path / f"p{number}.vtkhdf", steady_mm(0.1 * number), made, SIGMA_VOXEL / number)
    summary = report(tmp_path, tmp_path / "page.html", console=QUIET)
    sections = {section.title: section for section in pages[0].sections}
    table = sections["Vectors"].tables[0]
    assert [row[0] for row in table.rows] == ["p1.vtkhdf", "p9.vtkhdf", "p10.vtkhdf"]
    assert table.head[3] == "mean u ± usual σ of one (m/s)"
    assert [row[3] for row in table.rows] == ["0.1000 ± 0.0050", "0.90000 ± 0.00056", "1.00000 ± 0.00050"]
    # the series, and planes, profiles and errors of the mean
    assert len(sections["Vectors"].pictures) == summary["pictures"] == 4
    assert list(sections["Settings"].commands) == ["camera: {pitch_mm: 0.125}", "windows: [null, 8]"]
    assert "the vectors of their mean" in sections["Vectors"].view or not has_views()
    # of more files the first; of those by another command the series and planes of their mean
    monkeypatch.setattr(stage, "LONGEST_TABLE", 2)
    for number in (10, 9, 1):
        put(tmp_path / f"t{number}.vtkhdf", steady_mm(0.1), record("track"), 9.0 * SIGMA_VOXEL)
    assert report(tmp_path, tmp_path / "page.html", console=QUIET)["pictures"] == 4 + 2
    vectors = next(section for section in pages[1].sections if section.title == "Vectors")
    assert vectors.text == ("The first 2 of 3 files.",)
    assert [row[0] for row in vectors.tables[0].rows] == ["p1.vtkhdf", "p9.vtkhdf"]


@pytest.mark.thorough
def test_a_browser_sees_the_page_and_loads_nothing(results: Path, tmp_path: Path) -> None:
    if CHROMIUM is None:
        pytest.skip("no Chromium on this machine")
    pytest.importorskip("plotly")
    page = tmp_path / "page.html"
    summary = report(results, page, console=QUIET)
    with opened(page, tmp_path / "profile") as browser:
        widths = browser.evaluate("[...document.images].map(image => image.complete ? image.naturalWidth : 0)")
        # Drawn by JavaScript: the view of the tracks, which is not on paper.
        assert browser.evaluate("document.querySelectorAll('.view canvas').length") > 0
        browser.print(tmp_path / "page.pdf")
        asked = [address for address in browser.requests if not address.startswith(("data:", "blob:"))]
    assert len(widths) == summary["pictures"]
    assert min(widths) > 400
    shown = "[...document.querySelectorAll('.view, figure.paper')].map(each => each.offsetHeight > 0)"
    for more, seen in (((), [True, True, False]), (("--disable-3d-apis",), [False, False, True])):
        with opened(page, tmp_path / f"profile{len(more)}", *more) as browser:
            assert browser.evaluate(shown) == seen, more
    assert asked == [page.resolve().as_uri()]
    assert (tmp_path / "page.pdf").read_bytes().startswith(b"%PDF")


pytest.importorskip("matplotlib")


@pytest.fixture
def config(tmp_path):
    path = tmp_path / "rig.yaml"
    path.write_text(table2_rig(240, 200, volume={"shape_xyz": [5, 4, 3], "voxel_mm": [0.1, 0.1, 0.4]}))
    return path


@pytest.fixture
def volume(tmp_path):
    path = tmp_path / "volume.vtkhdf"
    grid = Grid.centred((2, 3, 4), (0.1, 0.1, 0.1), (0.0, 0.0, 0.0))
    array = np.arange(24.0).reshape(4, 3, 2)
    write_volume(path, array, grid, REFERENCE, provenance={}, attributes={}, overwrite=True)
    return path


@pytest.mark.thorough
def test_pdf_and_png_have_a_figure_for_each_name_and_the_same_bytes_again(volume, tmp_path, capsys):
    assert summary_of(capsys, "plot", volume, "-o", tmp_path / "v.pdf")["figures"] == ["projections", "depths"]
    content = (tmp_path / "v.pdf").read_bytes()
    assert len(re.findall(rb"/Type /Page\b(?!s)", content)) == 2
    run("plot", volume, "-o", tmp_path / "v.pdf", "--overwrite")
    assert (tmp_path / "v.pdf").read_bytes() == content
    run("plot", volume, "-o", tmp_path / "one.png", "--only", "depths")
    assert cv2.imread(str(tmp_path / "one.png")) is not None
    found = summary_of(capsys, "plot", volume, "-o", tmp_path / "p.png")
    assert found["files"] == [str(tmp_path / f"p_{name}.png") for name in ("projections", "depths")]
    assert sorted(path.name for path in tmp_path.glob("p*.png")) == ["p_depths.png", "p_projections.png"]


def test_wrong_names_outputs_and_images_are_refused_before_drawing(volume, tmp_path):
    for name, options, words in (
        ("p.png", ("--only", "planes"), "projections, depths"),
        ("p.jpg", (), r"\.png or \.pdf"),
        ("p.png", ("--raw", volume), "--raw"),
    ):
        with pytest.raises(UsageError, match=words):
            run("plot", volume, "-o", tmp_path / name, *options)
    other = tmp_path / "other.h5"
    write_tree(other, {"a_mm": np.zeros(9)}, format_name="x", format_version=1, provenance={}, overwrite=True)
    with pytest.raises(InputError, match="x has no figures"):
        figures_of(other)
    rows = re.findall(r"^\| ([\w ]+) \| (`.*`) \|$", (ROOT / "docs" / "files.md").read_text(), re.MULTILINE)
    listed = {what: [name.strip("`") for name in names.split(", ")] for what, names in rows}
    path, rng, names = tmp_path / "t.vtkhdf", np.random.default_rng(1), ["velocities", "links", "sigma"]
    for what, of_format, first in (
        ("tracks of a pair", TRACKS_FORMAT, ["space"]),
        ("tracks of a sequence", TRAJECTORIES_FORMAT, ["space", "lengths"]),
    ):
        write_points(path, of_format, points_of(of_format, rng), overwrite=True)
        assert listed[what] == list(figures_of(path)) == first + names
    assert figures_of(path)["space"].draw().axes[0].get_title() == "4 trajectories"
    assert listed["volume"] == list(figures_of(volume))
    assert len(listed) == 7


def test_particles_bring_their_residual_and_weights_their_middle_voxel(config, tmp_path):
    path, raw = tmp_path / "a.vtkhdf", tmp_path / "raw.tif"
    made = {"command": "reconstruct", "config": load_rig(config).resolved()}
    write_points(
        path, PARTICLES_FORMAT, points_of(PARTICLES_FORMAT, np.random.default_rng(1), provenance=made), overwrite=True
    )
    assert list(figures_of(path)) == ["places", "depths", "chi2"]
    write_tiff(tmp_path / "a_residual.tif", np.ones((200, 240), np.float32), overwrite=True)
    write_tiff(raw, np.ones((200, 240), np.uint16), overwrite=True)
    figures = figures_of(path, raw)
    assert list(figures) == ["places", "image", "residual", "depths", "chi2"]
    assert len(figures["image"].draw().axes[0].collections[0].get_offsets()) == 12
    write_tiff(raw, np.ones((20, 20), np.uint16), overwrite=True)
    with pytest.raises(InputError, match=r"raw\.tif"):
        figures_of(path, raw)
    path = tmp_path / "weights.h5"
    run("build-weights", config, "-o", path)
    figures = figures_of(path)
    assert list(figures) == ["column", "light"]
    title = figures["column"].draw().get_suptitle()
    assert title.startswith("voxel 2, 2, 1 at (0, 0.05, 0) mm")
    light = figures["light"].draw().axes[0].lines
    assert [line.get_label() for line in light] == ["middle", "half-way out", "corner"]
    np.testing.assert_allclose(light[0].get_xdata(), [-0.4, 0.0, 0.4], atol=1e-12)
    np.testing.assert_allclose(light[0].get_ydata(), 1.0, atol=0.01)
