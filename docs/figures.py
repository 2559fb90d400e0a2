"""Figures of the documents that are made from small simulations and from the sample: what words alone do not show.

Each function draws one figure, and its docstring is what the figure shows. `write_all` draws those that are missing.
"""

from __future__ import annotations

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
from scipy.stats import binned_statistic

from lfpiv_cli import load_rig, open_particles, read_image
from lfpiv_cli.cli.main import cli
from lfpiv_cli.fields.fit import fit_field
from lfpiv_cli.fields.structure import Samples
from lfpiv_cli.files.images import write_tiff
from lfpiv_cli.flow.outliers import validate_vectors
from lfpiv_cli.flow.windows import WEIGHTINGS
from lfpiv_cli.grid import Grid
from lfpiv_cli.optics.camera import Camera, Lattice
from lfpiv_cli.optics.tracing import ObjectSpace
from lfpiv_cli.particles.view import raw_view
from lfpiv_cli.pictures.style import BLUE, GREEN, GREY, ORANGE, VERMILION, Axes, new_panels, styled
from lfpiv_cli.reconstruction.solvers import SolverSettings, reconstruct
from lfpiv_cli.synthetic.flows import advect, random_modes, rigid_rotation, taylor_green
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
def tracer_by_depth(path: Path) -> None:
    """The light of one tracer of 50 µm under the microlenses, by its depth in mm (Table 2's camera)."""
    depths = (-4.0, -2.0, -1.0, -0.4, 0.4, 1.0, 2.0, 4.0)
    figure, axes = new_panels(7.2, 3.9, 2, 4)
    for each, z in zip(axes.ravel(), depths, strict=True):
        ball = Balls([[0.02, -0.03, z]], 1e6, 0.05)
        light = render_points(camera_of(130, 130), SPACE, ball, np.random.default_rng(1), rays=400_000)
        show(each, light, f"z = {z:g}")
    figure.savefig(path, dpi=150)


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
def covariances(path: Path, sample: Path) -> None:
    """Particles of the sample and ellipses of 20 standard errors of their places, across and in depth.

    The fifth of the particles whose depth is known worst is left out.
    """
    found = open_particles(sample / "particles" / "a.vtkhdf")
    matrix, known = found.arrays["covariance_mm2"], found.arrays["covariance_mm2"][:, 2]
    sure = known < np.quantile(known, 0.8)
    figure, axes = new_panels(7.2, 3.2, 1, 2)
    turn = np.linspace(0.0, 2.0 * np.pi, 40)
    circle = np.stack([np.cos(turn), np.sin(turn)])
    for each, (i, j, both), names in zip(axes, ((0, 1, 3), (0, 2, 5)), ("xy", "xz"), strict=True):
        for place, (*own, _, _, _), together in zip(
            found.position_mm[sure], matrix[sure], matrix[sure, both], strict=True
        ):
            root = np.linalg.cholesky([[own[i], together], [together, own[j]]])
            each.plot(*(place[[i, j], np.newaxis] + 20.0 * root @ circle), color=BLUE, linewidth=0.7)
        each.set(xlabel=f"{names[0]} (mm)", ylabel=f"{names[1]} (mm)", aspect="equal")
    figure.savefig(path, dpi=150)


def samples_of(flow: Callable[[Picture], Picture], points: Picture, sigma: Sequence[float], seed: int) -> Samples:
    """Return displacements in mm of a flow with errors of these standard deviations."""
    noise = np.random.default_rng(seed).normal(size=points.shape) * sigma
    covariance = np.broadcast_to(np.diag(np.square(sigma)), (len(points), 3, 3)).copy()
    return Samples(points, flow(points) + noise, covariance, np.ones(len(points)))


@styled
def kriging_and_bins(path: Path) -> None:
    """The depth component along a line through turbulence: true, by means of tracks in bins, by the fitted field."""
    turbulence = random_modes(1.0, longest_mm=8.0, shortest_mm=1.0, seed=4)
    rng = np.random.default_rng(5)
    points = rng.uniform((-4.0, -1.0, -1.0), (4.0, 1.0, 1.0), (700, 3))
    samples = samples_of(lambda places: 0.1 * turbulence(places), points, (0.01, 0.01, 0.03), 6)
    x = np.linspace(-4.0, 4.0, 200)
    line = np.stack([x, 0.0 * x, 0.0 * x], axis=1)
    value, variance = fit_field(samples, points.min(axis=0), points.max(axis=0)).estimate_at(line)
    near = np.all(np.abs(points[:, 1:]) < 0.4, axis=1)
    bins = np.linspace(-4.0, 4.0, 11)
    mean = binned_statistic(points[near, 0], samples.value_mm[near, 2], "mean", bins).statistic
    figure, axes = new_panels(6.4, 3.0)
    axes.plot(x, 0.1 * turbulence(line)[:, 2], color="black", label="truth")
    axes.step(bins, [*mean, mean[-1]], where="post", color=ORANGE, label="means of tracks in bins of 0.8 mm")
    sigma = np.sqrt(variance[:, 2])
    axes.fill_between(x, value[:, 2] - sigma, value[:, 2] + sigma, color=BLUE, alpha=0.25, linewidth=0.0)
    axes.plot(x, value[:, 2], color=BLUE, label="field, and its standard error")
    axes.set(xlabel="x (mm)", ylabel="displacement in depth (mm)")
    axes.legend()
    figure.savefig(path, dpi=150)


@styled
def divergence(path: Path) -> None:
    """The depth component in Taylor-Green vortices: the truth, and fields fitted to noisy tracks.

    Without and with what is known of a liquid's divergence. Depth is known ten times worse than the other components.
    """
    flow = taylor_green(1.0, 6.0)
    rng = np.random.default_rng(7)
    points = rng.uniform(-3.0, 3.0, (2500, 3))
    samples = samples_of(lambda places: 0.1 * flow(places), points, (0.004, 0.004, 0.06), 8)
    side = np.linspace(-2.8, 2.8, 41)
    x, z = np.meshgrid(side, side)
    plane = np.stack([x, 0.0 * x, z], axis=-1).reshape(-1, 3)
    true = 0.1 * flow(plane)[:, 2]
    fitted = {
        name: fit_field(samples, [-3.0] * 3, [3.0] * 3, kind).value_at(plane)[:, 2]
        for name, kind in (("divergence unknown", "off"), ("divergence penalised", "penalised"))
    }
    figure, axes = new_panels(7.2, 2.6, 1, 3)
    for each, (name, value) in zip(axes, ({"truth": true} | fitted).items(), strict=True):
        picture = each.pcolormesh(side, side, value.reshape(x.shape), cmap="RdBu_r", vmin=-0.12, vmax=0.12)
        rms = float(np.sqrt(np.mean((value - true) ** 2)))
        each.set(title=name + (f"\nrms {rms:.3f} mm" if rms else "\n"), xlabel="x (mm)", aspect="equal")
    axes[0].set_ylabel("z (mm)")
    figure.colorbar(picture, ax=axes, label="mm")
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


FROM_NOTHING: tuple[Callable[[Path], None], ...] = (
    tracer_by_depth,
    seeding,
    lattices,
    links,
    kriging_and_bins,
    divergence,
    solvers,
    bound,
    outliers,
    weightings,
    trajectories,
)
FROM_THE_SAMPLE: tuple[Callable[[Path, Path], None], ...] = (white_images, board_images, particle_images, covariances)


def write_all(folder: Path, sample: Path) -> None:
    """Draw all figures; `sample` is the folder of the sample's chain."""
    folder.mkdir(exist_ok=True)
    for draw in FROM_NOTHING:
        draw(folder / f"{draw.__name__}.png")
    for draw_sample in FROM_THE_SAMPLE:
        draw_sample(folder / f"{draw_sample.__name__}.png", sample)
