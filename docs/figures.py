"""Figures of the documents that are made from small simulations and from the sample: what words alone do not show.

Each function draws one figure, and its docstring is what the figure shows. `write_all` draws those that are missing.
"""

from __future__ import annotations

import csv
import re
import shutil
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from click.testing import CliRunner
from numpy.typing import NDArray
from scipy import ndimage

from lfpiv_cli import load_rig, read_image
from lfpiv_cli.cli.main import cli
from lfpiv_cli.files.images import write_tiff
from lfpiv_cli.flow.outliers import validate_vectors
from lfpiv_cli.flow.windows import WEIGHTINGS
from lfpiv_cli.grid import Grid
from lfpiv_cli.optics.camera import Camera, Lattice
from lfpiv_cli.optics.tracing import ObjectSpace
from lfpiv_cli.particles.view import raw_view
from lfpiv_cli.pictures.style import BLUE, GREEN, GREY, ORANGE, VERMILION, Axes, new_panels, styled
from lfpiv_cli.reconstruction.solvers import SolverSettings, reconstruct
from lfpiv_cli.synthetic.flows import advect, rigid_rotation, taylor_green
from lfpiv_cli.synthetic.render import Balls, Readout, render_points, render_white
from lfpiv_cli.tracks.candidates import Seen
from lfpiv_cli.tracks.sequences import follow
from lfpiv_cli.tracks.tracking import track
from lfpiv_cli.validation.planning import errors_alone_mm
from lfpiv_cli.verbs.simulate import readout_of
from lfpiv_cli.weights.build import factorise

Picture = NDArray[np.float64]
ROOT = Path(__file__).parent.parent
RIG = load_rig(ROOT / "configs" / "table2.yaml")
MEDIA = RIG.media_model()
SPACE = ObjectSpace(MEDIA, None, "paraxial")
DT_S = 1e-3


def camera_of(rows: int, columns: int) -> Camera:
    """Return Table 2's camera with a small sensor."""
    return replace(RIG.camera_model(), rows=rows, columns=columns)


def show(axes: Axes, image: Picture, title: str = "", **how: object) -> None:
    """Show an image in steps of its square root, without numbers at its sides."""
    axes.imshow(np.sqrt(np.maximum(image, 0.0)), interpolation="nearest", **how)
    axes.set(xticks=[], yticks=[], title=title)


@styled
def seeding(path: Path) -> None:
    """A part of raw images with 0.05, 0.65, 2 and 4 tracers for each microlens, 8 mm deep."""
    figure, axes = new_panels(7.2, 2.1, 1, 4)
    camera, rng = camera_of(240, 240), np.random.default_rng(2)
    half = 0.5 * 240 * 5.5e-3 + 0.4
    for each, density in zip(axes, (0.05, 0.65, 2.0, 4.0), strict=True):
        count = round(density * (2.0 * half / 0.1) ** 2)
        places = rng.uniform((-half, -half, -4.0), (half, half, 4.0), (count, 3))
        light = render_points(camera, SPACE, Balls(places, 5e5, 0.05), rng, rays=20_000)
        show(each, Readout().record(light, rng) - 96.0, f"{density:g}")
    figure.savefig(path, dpi=150)


@styled
def lattices(path: Path) -> None:
    """White images of a square and of a hexagonal array, and the lens images' centres (crosses)."""
    figure, axes = new_panels(7.2, 3.6, 1, 2)
    for each, layout in zip(axes, ("square", "hexagonal"), strict=True):
        camera = camera_of(120, 120)
        camera = replace(camera, lattice=Lattice.regular(camera.lattice.pitch[0], layout, np.deg2rad(0.5)))
        each.imshow(render_white(camera, 1.0, 3), cmap="gray", interpolation="nearest")
        micro_images = camera.micro_image_lattice_px()
        i, j = np.meshgrid(np.arange(-8, 9), np.arange(-8, 9))
        centres = micro_images.points(np.stack([i, j], axis=-1).reshape(-1, 2))
        inside = np.all((centres > -0.5) & (centres < 119.5), axis=1)
        each.plot(*centres[inside].T, "+", color=VERMILION)
        each.set(xticks=[], yticks=[], title=layout)
    figure.savefig(path, dpi=150)


def said_of(folder: Path, *words: str) -> str:
    """Run a command in a folder and return the codes of its warnings, or that it refuses."""
    paths = [str(folder / word) if re.search(r"\.(tif|yaml|h5|vtkhdf)$", word) else word for word in words]
    ended = CliRunner().invoke(cli, [*paths, "--overwrite"])
    codes = dict.fromkeys(re.findall(r"\[([a-z-]+)\]$", ended.stderr, re.MULTILINE))
    return "refused" if ended.exit_code else "\n".join(codes) or "nothing"


def spoilt(path: Path, sample: Path, name: str, changes: dict[str, Callable[[Picture], Picture]], *words: str) -> None:
    """Draw a photograph of the sample as it is and after changes of its light, and what a command says to each."""
    dark, good = (read_image(sample / f"{each}.tif").astype(np.float64) for each in ("dark", name))
    figure, axes = new_panels(7.2, 2.6, 1, len(changes))
    rng = np.random.default_rng(13)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        for file in sample.glob("*.*"):
            shutil.copyfile(file, folder / file.name)
        for each, (what, change) in zip(axes, changes.items(), strict=True):
            noise = rng.normal(0.0, dark.std(), dark.shape)
            image = np.clip(np.rint(np.median(dark) + change(good - dark) + noise), 0, 2**16 - 1)
            write_tiff(folder / f"{name}.tif", image.astype(np.uint16), overwrite=True)
            middle = tuple(slice(size // 2 - 60, size // 2 + 60) for size in image.shape)
            each.imshow(image[middle], cmap="gray", interpolation="nearest")
            each.set(xticks=[], yticks=[], title=what)
            each.set_xlabel(said_of(folder, *words))
    figure.savefig(path, dpi=150)


CALIBRATE = (
    *("calibrate-snapshot", "rig.yaml", "--white", "white.tif", "--dark", "dark.tif"),
    *("--board", "board.tif", "-o", "calibration.h5"),
)


@styled
def white_images(path: Path, sample: Path) -> None:
    """The middle of the sample's white image, spoilt, and the codes of what `calibrate-snapshot` says to it."""
    scene = read_image(sample / "a.tif").astype(np.float64)
    changes: dict[str, Callable[[Picture], Picture]] = {
        "as it should be": lambda light: light,
        "overexposed": lambda light: 4.0 * light,
        "hardly any light": lambda light: light / 2000.0,
        "blurred by motion": lambda light: ndimage.uniform_filter1d(light, 9, axis=1),
        "tracers instead": lambda light: scene,
    }
    spoilt(path, sample, "white", changes, *CALIBRATE)


@styled
def board_images(path: Path, sample: Path) -> None:
    """The middle of the sample's board, spoilt, and the codes of what `calibrate-snapshot` says to it."""
    changes: dict[str, Callable[[Picture], Picture]] = {
        "as it should be": lambda light: light,
        "camera moved by 3 px": lambda light: ndimage.shift(light, (3.0, 0.0), order=1, mode="nearest"),
        "mirrored": lambda light: light[:, ::-1],
        "hardly any light": lambda light: light / 5000.0,
        "half of it hidden": lambda light: light * (np.arange(light.shape[1]) > 0.5 * light.shape[1]),
    }
    spoilt(path, sample, "board", changes, *CALIBRATE)


@styled
def particle_images(path: Path, sample: Path) -> None:
    """The middle of an image of the sample's tracers, spoilt, and the codes of what `reconstruct` says to it."""
    changes: dict[str, Callable[[Picture], Picture]] = {
        "as it should be": lambda light: light,
        "overexposed": lambda light: 30.0 * light,
        "camera moved by 3 px": lambda light: ndimage.shift(light, (3.0, 0.0), order=1, mode="nearest"),
        "upside down": lambda light: light[::-1],
        "no light": lambda light: 0.0 * light,
    }
    quick = ("--dark", "dark.tif", "--solver", "sart", "--iterations", "1", "-o", "volume.vtkhdf")
    spoilt(path, sample, "a", changes, "reconstruct", "weights.h5", "a.tif", *quick)


@styled
def links(path: Path) -> None:
    """Particles of two frames of a vortex (blue, orange), all pairs within reach (grey), and the links (green)."""
    rng, flow = np.random.default_rng(14), rigid_rotation((0.0, 0.0, 0.15 / DT_S))
    first = rng.uniform((-2.0, -2.0, -0.6), (2.0, 2.0, 0.6), (260, 3))
    second = np.concatenate([advect(flow, first, DT_S)[26:], rng.uniform((-2.0, -2.0, -0.6), (2.0, 2.0, 0.6), (26, 3))])
    linked = track(Seen(first), Seen(second), RIG.camera_model().scale(MEDIA), 0.4)
    figure, axes = new_panels(4.6, 4.4)
    for start in first:
        for end in second[np.abs(second - start).max(axis=1) < 0.4]:
            axes.plot(*np.stack([start, end])[:, :2].T, color="0.88", linewidth=0.7, zorder=0)
    for i, j in zip(linked.first, linked.second, strict=True):
        axes.plot(*np.stack([first[i], second[j]])[:, :2].T, color=GREEN, linewidth=1.6)
    axes.plot(*first[:, :2].T, "o", color=BLUE, markersize=2.5)
    axes.plot(*second[:, :2].T, "o", color=ORANGE, markersize=2.5)
    axes.set(xlabel="x (mm)", ylabel="y (mm)", aspect="equal")
    figure.savefig(path, dpi=150)


@styled
def solvers(path: Path) -> None:
    """The light of a tracer at z = 4 mm in reconstructed volumes along its depth, by solver and number of steps."""
    camera, grid = camera_of(200, 200), Grid.centred((25, 25, 61), (0.05, 0.05, 0.1), (0.0, 0.0, 4.0))
    weights = factorise(camera, MEDIA, grid)
    ball = Balls([[0.02, -0.03, 4.0]], 1e6, 0.05)
    image = render_points(camera, SPACE, ball, np.random.default_rng(9), rays=1_000_000)
    figure, axes = new_panels(5.0, 3.0)
    for name, steps in (("sart", 200), ("em", 20), ("em", 60)):
        volume = reconstruct(weights, image, SolverSettings(name, steps)).volume
        profile = volume.sum(axis=(1, 2))
        axes.plot(grid.axis_mm(2), profile / profile.max(), label=f"{name.upper()}, {steps} steps")
    axes.axvline(4.0, color=GREY, linewidth=0.8)
    axes.set(xlabel="z (mm)", ylabel="light over its largest")
    axes.legend()
    figure.savefig(path, dpi=150)


@styled
def bound(path: Path) -> None:
    """The smallest standard errors that any method can have, across and in depth, of a tracer alone in an image.

    The Cramér–Rao bound, by rays, of half a million counts of light; medians over places under a microlens.
    """
    depths, rng = np.linspace(-5.0, 5.0, 41), np.random.default_rng(12)
    figure, axes = new_panels(5.4, 3.2)
    for diameter, colour in ((0.03, BLUE), (0.05, ORANGE), (0.1, GREEN)):
        view = raw_view(camera_of(220, 220), MEDIA, 0.5 * diameter)
        across = rng.uniform(-0.05, 0.05, (60, 41, 2))
        rest = np.broadcast_to(np.stack([depths, np.full(41, 5e5)], axis=1), (60, 41, 2))
        tracers = np.concatenate([across, rest], axis=2).reshape(-1, 4)
        alone = errors_alone_mm(view, tracers, readout_of(RIG)).reshape(60, 41, 3)
        errors = np.sqrt(np.median(alone**2, axis=0))
        axes.plot(depths, 1e3 * errors[:, 2], color=colour, label=f"{1e3 * diameter:g} µm: z")
        axes.plot(depths, 1e3 * errors[:, 0], "--", color=colour, label=f"{1e3 * diameter:g} µm: x")
    axes.set(xlabel="z (mm)", ylabel="standard error (µm)", yscale="log")
    axes.legend(ncols=3)
    figure.savefig(path, dpi=150)


@styled
def outliers(path: Path) -> None:
    """A plane of a shear with one false vector in twenty, and what the median test makes of it.

    Orange vectors are replaced by what their neighbours predict.
    """
    rng = np.random.default_rng(10)
    shape = (5, 12, 16)
    y = np.arange(12.0)[np.newaxis, :, np.newaxis]
    raw = np.zeros((*shape, 3))
    raw[..., 0] = 0.3 * y + rng.normal(0.0, 0.05, shape)
    false = rng.random(shape) < 0.05
    raw[false] = rng.uniform(-4.0, 4.0, (int(false.sum()), 3))
    yes, no = np.ones(shape, dtype=np.bool_), np.zeros(shape, dtype=np.bool_)
    kept, flag = validate_vectors(raw, np.full(raw.shape, np.nan), yes, no, np.full(3, 0.1))
    figure, axes = new_panels(7.2, 2.7, 1, 2)
    for each, field, colours in zip(axes, (raw, kept), (no, flag != 0), strict=True):
        shown = np.where(colours[2], ORANGE, BLUE).ravel()
        each.quiver(field[2, :, :, 0], field[2, :, :, 1], color=shown, scale=60.0)
        each.set(xticks=[], yticks=[])
    figure.savefig(path, dpi=150)


@styled
def weightings(path: Path) -> None:
    """What a window leaves of a flow that varies as a sine, by the wavelength over the window's size.

    The mean of the sine under the weights of a uniform and of a Gaussian window.
    """
    offset = (np.arange(400) + 0.5) / 400.0 - 0.5
    ratios = np.linspace(0.5, 6.0, 200)
    figure, axes = new_panels(5.0, 3.0)
    for name, weighting in WEIGHTINGS.items():
        share = weighting(offset) / weighting(offset).sum()
        axes.plot(ratios, np.cos(2.0 * np.pi * offset / ratios[:, np.newaxis]) @ share, label=name)
    axes.axhline(0.0, color=GREY, linewidth=0.8)
    axes.set(xlabel="wavelength / window", ylabel="share that is left")
    axes.legend()
    figure.savefig(path, dpi=150)


@styled
def trajectories(path: Path) -> None:
    """Tracks through eight frames of vortices, from particles of which every frame has lost a tenth."""
    flow = taylor_green(0.16, 6.0, plane="xy")
    rng = np.random.default_rng(11)
    places = rng.uniform((-3.0, -3.0, -0.5), (3.0, 3.0, 0.5), (500, 3))
    frames = []
    for number in range(8):
        moved = advect(flow, places, number * DT_S) + rng.normal(0.0, (0.003, 0.003, 0.03), places.shape)
        frames.append(Seen(moved[rng.random(len(moved)) > 0.1]))
    found = follow(frames, 0.4, 4, RIG.camera_model().scale(MEDIA))
    figure, axes = new_panels(4.8, 4.4)
    paths: list[list[Picture]] = [[] for _ in range(found.count)]
    for frame, seen in enumerate(frames):
        for number, place in zip(found.labels[frame], seen.position_mm, strict=True):
            if number >= 0:
                paths[number].append(place)
    for each in paths:
        axes.plot(*np.array(each)[:, :2].T, "-", linewidth=0.9, color=BLUE)
        axes.plot(*each[-1][:2], "o", markersize=1.8, color=VERMILION)
    axes.set(xlabel="x (mm)", ylabel="y (mm)", aspect="equal")
    figure.savefig(path, dpi=150)


def table(name: str) -> list[dict[str, str]]:
    """Return the rows of a table of the page Accuracy."""
    with open(ROOT / "docs" / "accuracy" / f"{name}.csv", encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def column(rows: list[dict[str, str]], name: str) -> Picture:
    """Return a column of numbers, NaN where a cell is empty."""
    return np.array([float(row[name] or "nan") for row in rows])


def dots(axes: Axes, rows: list[dict[str, str]], name: str, labels: Sequence[str], orange: Sequence[bool]) -> None:
    """Draw a column as dots on lines with their labels, the first one on top."""
    places = np.arange(len(rows))[::-1]
    axes.hlines(places, 0.0, 1.0, transform=axes.get_yaxis_transform(), color="0.9", linewidth=0.8)
    axes.scatter(column(rows, name), places, color=[ORANGE if each else BLUE for each in orange], zorder=2)
    axes.set_yticks(places, labels)
    axes.set(xlabel=name, xscale="log")


@styled
def accuracy_boards(path: Path) -> None:
    """How far the depths between a board's planes are off (Table 3), and the flow in a channel (Section 4.2)."""
    figure, axes = new_panels(9.0, 3.4, 1, 2)
    for each, name, figures, sort in zip(
        axes, ("boards", "channel"), ("depth error, %", "mean error, %"), ("camera", "images"), strict=True
    ):
        rows = table(name)
        labels = [f"{row['by']} ({row[sort]})" for row in rows]
        dots(each, rows, figures, labels, ["paper" in row["by"] for row in rows])
    figure.savefig(path, dpi=150)


@styled
def accuracy_seeding(path: Path) -> None:
    """What is found, and how well, by the number of tracers for each microlens; full sensor, and crowded cuts of it."""
    figure, axes = new_panels(9.0, 3.0, 1, 3)
    full, crowded = table("seeding"), table("crowded")
    groups = {"whole sensor, rays": (full, "-")}
    groups |= {f"a cut, {light}": ([r for r in crowded if r["light"] == light], ":") for light in ("rays", "waves")}
    within = {"whole sensor, rays": "within 1.96 σ, z"}
    for (name, (rows, line)), colour in zip(groups.items(), (BLUE, ORANGE, GREEN), strict=True):
        density = column(rows, "per microlens")
        axes[0].plot(density, column(rows, "recall"), f"o{line}", color=colour, label=f"{name}: recall")
        axes[0].plot(density, column(rows, "precision"), f"^{line}", color=colour, label="precision")
        axes[2].plot(density, column(rows, within.get(name, "within 1.96 σ, worst axis")), f"o{line}", color=colour)
    for name, marker in (("spread x, voxel", "o"), ("spread z, voxel", "^")):
        axes[1].plot(column(full, "per microlens"), column(full, name), f"{marker}-", color=BLUE, label=name)
    axes[2].axhline(0.95, color=GREY, linewidth=0.8)
    axes[1].set(yscale="log")
    for each, label in zip(axes, ("share", "voxel of 0.1 mm", "within 1.96 σ, worst axis or z"), strict=True):
        each.set(xlabel="tracers for each microlens", ylabel=label)
    axes[0].legend(fontsize=6)
    axes[1].legend()
    figure.savefig(path, dpi=150)


@styled
def accuracy_waves(path: Path) -> None:
    """The scatter in depth of tracers fitted by rays and by waves, by the light that the images were made of."""
    figure, axes = new_panels(7.2, 2.8)
    rows = table("waves")
    by_rays = [row["fitted by"] == "rays" for row in rows]
    dots(axes, rows, "spread z", [f"{row['tracers']} (images by {row['images by']})" for row in rows], by_rays)
    axes.set_xlabel("spread in depth, voxels of 0.1 mm")
    figure.savefig(path, dpi=150)


@styled
def accuracy_sequences(path: Path) -> None:
    """What `follow` finds, and how well, by the distance from the focal plane."""
    figure, axes = new_panels(7.2, 2.6, 1, 2)
    rows = table("sequences")
    names, places = [row["distance from the focal plane"] for row in rows], np.arange(len(rows))[::-1]
    for offset, name, colour in ((0.18, "recall", BLUE), (-0.18, "precision", ORANGE)):
        axes[0].barh(places + offset, 1.0 - column(rows, name), 0.36, color=colour, label=f"1 - {name}")
    for offset, name, colour in ((0.18, "rms x, voxel", BLUE), (-0.18, "rms z, voxel", ORANGE)):
        axes[1].barh(places + offset, column(rows, name), 0.36, color=colour, label=name)
    axes[0].set_yticks(places, names)
    axes[1].set(yticks=[], xscale="log", xlabel="voxel of 0.1 mm")
    axes[0].set_xlabel("share")
    for each in axes:
        each.set_ylim(-0.6, len(rows) + 0.5)
        each.legend(loc="upper right", ncols=2)
    figure.savefig(path, dpi=150)


FROM_NOTHING: tuple[Callable[[Path], None], ...] = (
    seeding,
    lattices,
    links,
    solvers,
    bound,
    outliers,
    weightings,
    trajectories,
    accuracy_boards,
    accuracy_seeding,
    accuracy_waves,
    accuracy_sequences,
)
FROM_THE_SAMPLE: tuple[Callable[[Path, Path], None], ...] = (white_images, board_images, particle_images)


def write_all(folder: Path, sample: Path) -> None:
    """Draw all figures; `sample` is the folder of the sample's chain."""
    folder.mkdir(exist_ok=True)
    for draw in FROM_NOTHING:
        print(f"docs: figure {draw.__name__}", flush=True)
        draw(folder / f"{draw.__name__}.png")
    for draw_sample in FROM_THE_SAMPLE:
        print(f"docs: figure {draw_sample.__name__}", flush=True)
        draw_sample(folder / f"{draw_sample.__name__}.png", sample)
