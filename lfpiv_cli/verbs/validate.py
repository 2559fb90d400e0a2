"""The stages of `validate`: weights, volumes, flows, and boards (Section 3.3), held against what is known.

Boards at seventeen depths are rendered, reconstructed and measured.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from lfpiv_cli.arrays import Floats, Singles
from lfpiv_cli.calibration.board import dots_in_world
from lfpiv_cli.calibration.model import Photographs, calibrate
from lfpiv_cli.console import CONSOLE, Console, readable
from lfpiv_cli.errors import ConfigError, InputError, LimitMissedError, UsageError
from lfpiv_cli.files import vtkhdf
from lfpiv_cli.files.atomic import ensure_writable, write_json
from lfpiv_cli.files.config import Config, load_rig
from lfpiv_cli.files.inputs import given
from lfpiv_cli.files.pages import ensure_drawing, write_picture
from lfpiv_cli.files.particle_file import MM_PER_M, read_particles
from lfpiv_cli.files.provenance import record
from lfpiv_cli.files.sections_work import ColumnLimits, FlowSection
from lfpiv_cli.flow.field import VectorField
from lfpiv_cli.flow.windows import RoundWall
from lfpiv_cli.names import FlowMethod, Moment
from lfpiv_cli.notice import Notice
from lfpiv_cli.optics.curved_space import CurvedSpace
from lfpiv_cli.optics.tracing import ObjectSpace
from lfpiv_cli.reconstruction.images import Image, light
from lfpiv_cli.reconstruction.solvers import ALL_ITERATIONS, Reconstruction, normalisers, reconstruct
from lfpiv_cli.synthetic.board import BoardPlacement, render_board
from lfpiv_cli.synthetic.flows import Flow
from lfpiv_cli.synthetic.scenes import RecordingCamera, simulate_board, simulate_white
from lfpiv_cli.validation import board as of_boards
from lfpiv_cli.validation import methods as of_methods
from lfpiv_cli.validation import weights as of_weights
from lfpiv_cli.validation.flow import Duct, Measured, limits_missed, truth_at_points
from lfpiv_cli.validation.volume import volume_figures
from lfpiv_cli.verbs.frames import Progress
from lfpiv_cli.verbs.run import run
from lfpiv_cli.verbs.run_steps import RunOptions
from lfpiv_cli.verbs.simulate import (
    board_at,
    board_depths,
    ensure_experiment,
    frame_names,
    misalignment_of,
    placement_of,
    readout_of,
    simulate_images,
)
from lfpiv_cli.weights.build import factorise_through, scene_distortion
from lfpiv_cli.weights.model import Weights

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Of boards, the ideal camera is the data sheet's, its pictures free of noise and their light refracted paraxially. The
# real one has an array that is turned and shifted, a main lens that distorts, a sensor with noise, and light refracted
# exactly; it is calibrated from a white picture and one of a board in air, and nothing else is known of it. Weights are
# those of equivalent points, or of rays fitted to the very boards (DLFC).

# The board that calibrates the real camera stands so far behind the focal plane, in air, where depth shows well.
CALIBRATION_BOARD_Z_MM = 0.3
# Two make a step in depth, a third the polynomials of fitted rays.
FEWEST_DEPTHS = 3


def validate_board(
    config: Path, output: Path, *, overwrite: bool = False, console: Console = CONSOLE
) -> dict[str, Any]:
    """Reconstruct the configured board at the paper's depths, with the configured solver.

    The pictures are those of the data sheet's camera without noise (ideal), of one with the faults that the section
    simulation gives it (recorded), or both, as validation.board.images has it.
    """
    settings = load_rig(config)
    chosen = settings.validation.board
    halves = ("ideal", "recorded") if chosen.images == "both" else (chosen.images,)
    depths = depths_in_volume(settings)
    solved = [method for method in chosen.methods if method != "discs"]
    report = output / "board.json"
    drawings = {(half, method): output / f"board_{half}_{method}.png" for half in halves for method in solved}
    for path in (report, *drawings.values()):
        ensure_writable(path, overwrite, [config])
    ensure_drawing()
    figures: dict[str, dict[str, Any]] = {half: {} for half in halves}
    drawn = np.zeros(settings.grid().shape_zyx, np.float32)
    steps = len(halves) * (len(solved) * settings.reconstruction.iterations + len(chosen.methods) - len(solved))
    with console.progress(steps * len(depths), "boards") as advance:
        for half in halves:
            bench = bench_of(settings, half)
            board = bench.rig.board
            pictures = [bench.picture(placement_of(settings, depth)) for depth in depths]
            for method in chosen.methods:
                if method == "discs":
                    # The errors of place of dots that are fitted to the pictures as discs.
                    calibration, places = bench.weights.calibration, []
                    rotation = 0.0 if calibration is None else calibration.rectification.rotation_rad
                    for picture in pictures:
                        places.append(dots_in_world(picture, bench.rig.camera, board, bench.rig.media, rotation))
                        advance(1)
                    x, z = ([each[..., axis] for each in places] for axis in (0, 2))
                    figures[half][method] = of_boards.place_figures(x, z, depths, board.spacing_mm)
                    continue
                judged = bench if method == "ert" else bench.with_fitted_rays(pictures, depths)
                solve, dots = board_solver(judged, settings), []
                for depth, picture in zip(depths, pictures, strict=True):
                    found, volume, residual = of_boards.board_in(
                        judged, solve, picture, placement_of(settings, depth), advance
                    )
                    dots.append(found)
                    drawn = volume if depth == 0.0 else drawn
                    console.detail(f"board at {depth:+z.0f} mm: residual {residual:z.3f}")
                measured = of_boards.board_figures(dots, depths, board.dots, board.spacing_mm)
                figures[half][method] = measured | {"paper": of_boards.PAPER[half, method]}
                write_picture(
                    drawings[half, method], of_boards.board_figure(measured, drawn, settings.grid()), overwrite
                )
    provenance = record("validate board", settings.resolved(), {"config": config})
    write_json(report, {"figures": figures, "provenance": provenance}, overwrite)
    return {
        f"{half}.{method}.{name}": value
        for half, methods in figures.items()
        for method, measured in methods.items()
        for name, value in measured.items()
        if isinstance(value, float)
    }


def depths_in_volume(settings: Config) -> tuple[float, ...]:
    """Return those of the paper's depths that lie in the volume (ConfigError: they are too few)."""
    low, high = settings.grid().bounds_mm(2)
    depths = tuple(depth for depth in of_boards.DEPTHS_MM if low < depth < high)
    if len(depths) < FEWEST_DEPTHS:
        raise ConfigError(
            f"{settings.source}: volume: reaches from z = {low:g} to {high:g} mm and holds {len(depths)} of the "
            f"boards, 1 mm apart each; expected at least {FEWEST_DEPTHS}"
        )
    return depths


def bench_of(settings: Config, half: str) -> of_boards.BoardBench:
    """Return the camera before which the boards of a half of Table 3 are held.

    The ideal one is the data sheet's; the other one departs from it, and is calibrated from pictures that it took.
    """
    scene, level = settings.simulation, settings.simulation.peak_counts
    settings.ensure_plane_layers("validating boards")
    rig, grid, rng = settings.rig(), settings.grid(), np.random.default_rng(scene.seed)
    if half == "ideal":
        paraxial = ObjectSpace(rig.media, None, "paraxial")
        weights = Weights(grid, (0, 0, 0), factorise_through(rig.camera, paraxial, grid), rig.camera.column_axis)
        rendered = partial(render_board, rig.camera, paraxial, rig.board, level=level, rng=rng)
        nothing = np.zeros(weights.image_shape, np.bool_)
        return of_boards.BoardBench(rig, weights, lambda placement: rendered(placement).astype(np.float32), nothing)
    space = ObjectSpace(rig.media, settings.window_model(), scene.refraction)
    assumed = settings.plane_space("validating boards")
    real = RecordingCamera(misalignment_of(settings).apply(rig.camera), readout_of(settings), scene.light.waves())
    dark = real.dark_frame(rng)
    white = simulate_white(real, level, rng).image
    board = replace(rig.board, medium="air")
    air = ObjectSpace(rig.media.in_air(), None, "paraxial")
    snapshot = simulate_board(real, air, board, BoardPlacement(CALIBRATION_BOARD_Z_MM), level, rng).image
    calibration = calibrate(Photographs([white], dark, snapshot), replace(rig, board=board))
    camera = calibration.camera(rig.camera)
    bend, operator = scene_distortion(camera, rig.media, grid), factorise_through(camera, assumed, grid)
    calibrated = Weights(grid, (0, 0, 0), operator, camera.column_axis, calibration, bend)

    def picture(placement: BoardPlacement) -> Image:
        recorded = simulate_board(real, space, rig.board, placement, level, rng).image
        return calibrated.prepare(light(recorded.astype(np.float32), dark.astype(np.float32)))

    return of_boards.BoardBench(replace(rig, camera=camera), calibrated, picture, ~calibration.rectification.inside)


def board_solver(bench: of_boards.BoardBench, settings: Config) -> of_boards.BoardSolver:
    """Return what reconstructs a picture of the bench with the configured solver and calls back at each iteration.

    The volume is in the solver's axes. All iterations are made, so that methods and depths can be compared.
    """
    solver = replace(settings.solver_settings(), stopping=ALL_ITERATIONS)
    sums = None if bench.weights.on_demand else normalisers(bench.weights.padded, bench.excluded)

    def solve(picture: Singles, advance: Progress) -> Reconstruction:
        operator = bench.weights.padded.for_image(picture)
        return reconstruct(
            operator, picture, solver, sums=sums or normalisers(operator, bench.excluded), progress=advance
        )

    return solve


# When the frames of a pair are taken, in units of the time between them, counted from the middle of the pair.
MOMENTS: dict[Moment, float] = {"a": -0.5, "middle": 0.0, "b": 0.5}


def validate_volume(
    config: Path,
    output: Path,
    *,
    volume: Path,
    particles: Path,
    frame: Moment,
    overwrite: bool = False,
    console: Console = CONSOLE,
) -> dict[str, Any]:
    """Judge a volume by the true particles, which are known at the middle of a pair."""
    inputs = given(config=config, volume=volume, particles=particles)
    report = output / "volume.json"
    ensure_writable(report, overwrite, inputs.values())
    settings = load_rig(config)
    found, true = vtkhdf.open_volume(volume), read_particles(particles)
    dt_s = settings.correlation.dt_s
    if MOMENTS[frame] and dt_s is None:
        raise ConfigError(f"{config}: correlation.dt_s: is missing, and --frame {frame} needs it")
    moved = MOMENTS[frame] * (dt_s or 0.0) * MM_PER_M * true.velocities_m_s
    position = found.reference.points_from_focal_point(true.positions_mm + moved)
    camera = settings.camera_model()
    microlens_mm = float(camera.lattice.pitch.mean()) / abs(camera.magnification)
    figures = volume_figures(found.array, found.grid, position, true.brightness, microlens_mm) | {
        "residual": found.attributes["residual"][-1],
        "iterations": len(found.attributes["residual"]) - 1,
    }
    provenance = record(f"validate volume, frame {frame}", settings.resolved(), inputs)
    write_json(report, {"figures": figures, "provenance": provenance}, overwrite)
    return figures


def validate_weights(
    config: Path, output: Path, *, overwrite: bool = False, console: Console = CONSOLE
) -> dict[str, Any]:
    """Hold the weights of the paper's voxels and of a random sample against each other and against integrals.

    Through a scene all voxels are random ones of the fluid.
    """
    paths = {name: output / f"weights{name}" for name in (".json", "_columns.png", "_similarity.png")}
    for target in paths.values():
        ensure_writable(target, overwrite, [config])
    ensure_drawing()
    settings = load_rig(config)
    chosen = settings.validation.weights
    camera, grid = settings.camera_model(), settings.grid()
    rng = np.random.default_rng(chosen.seed)
    scene = settings.scene_space()
    space: ObjectSpace | CurvedSpace
    if scene is not None:
        space = scene
    else:
        try:
            window = settings.window_model()
        except ConfigError:
            window = None  # there is nothing to trace directly
        space = ObjectSpace(settings.media_model(), window)
    centres, counted = of_weights.judged_voxels(camera, space, grid, chosen.sample, rng)
    long_count = np.where(counted, chosen.long_count_rays, 0)
    with console.progress(len(centres), "validate weights") as advance:
        columns = of_weights.make_columns(camera, space, grid, centres, rng, long_count, advance)
    figures = of_weights.weights_figures(columns, long_count)
    judged = {name: each for name, each in figures.items() if isinstance(each, dict)}
    summary, limits = (
        {f"{name}.{figure}": value for name, each in table.items() for figure, value in each.items()}
        for table in (judged, chosen.limits.model_dump())
    )
    missed = limits_missed(summary, limits)
    provenance = record("validate weights", settings.resolved(), {"config": config})
    write_json(paths[".json"], {"figures": figures, "limits_missed": missed, "provenance": provenance}, overwrite)
    shown = min(len(of_weights.TABLE1_MM), len(columns))
    names = of_weights.SHOWN if scene is None else of_weights.SHOWN_BEHIND_FACES
    write_picture(paths["_columns.png"], of_weights.columns_figure(columns[:shown], names), overwrite)
    write_picture(paths["_similarity.png"], of_weights.similarity_figure(figures, shown), overwrite)
    summary = {name: value for name, value in summary.items() if name.rpartition(".")[2] in ColumnLimits.model_fields}
    if missed:
        raise LimitMissedError(f"{paths['.json']}: {'; '.join(missed)}", summary)
    return {"voxels": len(columns)} | summary


PICTURES: dict[str, Callable[[Mapping[str, Measured]], Figure]] = {
    "flow.png": of_methods.flow_figure,
    "flow_errors.png": of_methods.errors_figure,
    "flow_profiles.png": of_methods.profiles_figure,
}
# Of a square duct, and of a round pipe.
SLICES, RADII = "flow_slices.png", "flow_radii.png"
# Particles follow a flow where they differ from it by less (rms over rms): a mid plane that is off by a tenth of a mm
# makes 2 % in a channel of 10 mm.
SAME_FLOW = 0.05


def validate_flow(
    config: Path,
    output: Path,
    *,
    vectors: Path | None = None,
    particles: Path | None = None,
    overwrite: bool = False,
    console: Console = CONSOLE,
) -> dict[str, Any]:
    """Judge a vector field by an analytic flow, else by true particles; without one, make it from simulated images.

    The analytic flow is exact; between particles the truth is interpolated, and worse than a good measurement.
    """
    is_simulated = vectors is None
    if is_simulated and particles is not None:
        raise UsageError("--particles needs --vectors: the flow of a simulation is known")
    settings = load_rig(config)
    if is_simulated:
        ensure_experiment(settings)
        console.warn(light_notices(settings))
    named = settings.simulation.flow if is_simulated else settings.validation.flow or settings.simulation.flow
    duct, pipe = duct_of(named), named if named is not None and named.kind == "pipe" else None
    walls = None if pipe is None else RoundWall(pipe.radius_mm, pipe.centre_mm, pipe.axis)
    drawn = [*PICTURES, *([] if duct is None else [SLICES]), *([] if pipe is None else [RADII])]
    paths = {name: output / name for name in ("flow.json", *drawn)}
    for target in paths.values():
        ensure_writable(target, overwrite, given(config=config, vectors=vectors, particles=particles).values())
    ensure_drawing()
    if vectors:
        made = {"measured": vectors}
    else:
        # With all imperfections on, which every method gets alike; of a longer sequence the first two images.
        simulate_images(config, output / "images", overwrite=overwrite, console=console)
        made = measure_images(config, output / "images", output, overwrite=overwrite, console=console)
    inputs = given(config=config, particles=particles) | (given(vectors=vectors) if vectors else made)
    methods = {name: measured_of(path, settings, particles, is_simulated) for name, path in made.items()}
    if particles and named is not None and methods["measured"].flow is None:
        text = f"the particles of {particles.name} do not move as the flow that it names, and are taken for the truth"
        console.warn([Notice("truth-contradicts", config.name, text, "validation.flow of this experiment, or none")])
    truth = "analytic flow" if all(measured.flow for measured in methods.values()) else "particles"
    figures = {name: measured.figures(duct, walls) for name, measured in methods.items()}
    limits = settings.validation.limits.model_dump()
    missed = [
        text if vectors else f"{name}: {text}"
        for name, found in figures.items()
        for text in limits_missed(found, limits)
    ]
    report: dict[str, Any] = {
        "figures": figures["measured"] if vectors else figures,
        "limits_missed": missed,
        "truth": truth,
    }
    if len(methods) > 1:
        report["lower_error"] = of_methods.lower_error(methods, figures)
    report["provenance"] = record("validate flow", settings.resolved(), inputs)
    write_json(paths["flow.json"], report, overwrite)
    for name, draw in PICTURES.items():
        write_picture(paths[name], draw(methods), overwrite)
    if duct is not None:
        write_picture(paths[SLICES], of_methods.slices_figure(methods, duct), overwrite)
    if pipe is not None and walls is not None:
        fields = {name: measured.field for name, measured in methods.items()}
        write_picture(paths[RADII], of_methods.radius_figure(fields, walls, pipe.mean_velocity_m_s), overwrite)
    # The figures that are numbers; of a simulation each with the value of every method.
    first = next(iter(figures.values()))
    summary: dict[str, Any] = {name: value for name, value in first.items() if not isinstance(value, (list, dict))}
    if is_simulated:
        summary = {name: {method: found[name] for method, found in figures.items()} for name in summary}
    else:
        summary["summary"] = _in_words(summary, truth, output)
    summary["truth"] = truth
    if len(methods) > 1:
        summary["lower_error"] = report["lower_error"]
    if missed:
        raise LimitMissedError(f"{paths['flow.json']}: {'; '.join(missed)}", summary)
    return summary


def _in_words(found: Mapping[str, Any], truth: str, output: Path) -> list[str]:
    """Return what a person wants to know of vectors beside the truth."""
    error, within = found["streamwise_mean_error"], found["within_25_percent_vector"]
    rms = ", ".join(readable(found[f"rms_{name}_voxel"], digits=2) for name in "uvw")
    mean = "" if error is None else f"mean along the flow {readable(100.0 * error, digits=2)} % off; "
    shares = "" if within is None else f"{within:.0%} of the vectors within 25 % of the true ones; "
    return [
        f"{found['vectors_valid']} of {found['vectors']} vectors valid; beside the {truth}: {mean}{shares}"
        f"rms of u, v, w {rms} voxel.",
        f"all figures: -v, --json, or {output / 'flow.json'}",
    ]


def measure_images(
    config: Path, images: Path, output: Path, *, overwrite: bool = False, console: Console = CONSOLE
) -> dict[str, Path]:
    """Measure the flow in images that `simulate_images` made, as `run` does; return the vectors by method."""
    settings = load_rig(config)
    methods = cast(tuple[FlowMethod, ...], settings.flow_methods())
    depths = board_depths(settings) if settings.weights.method == "dlfc" else ()
    recorded = RunOptions(
        images=[images / name for name in frame_names(settings.simulation.frames)[:2]],
        white=[images / "white.tif"],
        dark=images / "dark.tif",
        board=[images / board_at(depth) for depth in depths] or [images / "board.tif"],
        depth_mm=depths,
        method="both" if len(methods) > 1 else methods[0],
        report=False,
    )
    run(config, output, recorded, overwrite=overwrite, console=console)
    names: dict[FlowMethod, str] = {"volumes": "vectors", "particles": "tracks_grid"}
    return {method: output / f"{names[method]}.vtkhdf" for method in methods}


def duct_of(flow: FlowSection | None) -> Duct | None:
    """Return the duct of a flow, None where it is another one."""
    if flow is None or flow.kind != "square_duct":
        return None
    return Duct(flow.width_mm, flow.centre_mm, flow.axis, flow.mean_velocity_m_s)


def measured_of(vectors: Path, settings: Config, particles: Path | None, is_simulated: bool) -> Measured:
    """Return vectors with the true flow at their places."""
    field = vtkhdf.open_vectors(vectors)
    if field.dt_s is None:
        raise InputError(f"{vectors}: holds displacements without a time; correlate again with --dt-s")
    if particles:
        # Judged where there are particles, with the config's flow if these follow it, else with theirs.
        reference, true = vtkhdf.read_header(vectors).reference, read_particles(particles)
        centres_mm = reference.points_to_focal_point(field.grid.centres_mm())
        lit = true.brightness[:, np.newaxis] > 0.0
        low = true.positions_mm.min(axis=0, where=lit, initial=np.inf)
        high = true.positions_mm.max(axis=0, where=lit, initial=-np.inf)
        inside = np.all((centres_mm >= low) & (centres_mm <= high), axis=-1)
        truth = truth_at_points(true.positions_mm, true.velocities_m_s, centres_mm)
        if settings.validation.flow is None and settings.simulation.flow is None:
            return Measured(field, truth, inside)
        flow = settings.true_flow()
        difference = flow(reference.points_from_focal_point(true.positions_mm)) - true.velocities_m_s
        if np.linalg.norm(difference) > SAME_FLOW * np.linalg.norm(true.velocities_m_s):
            return Measured(field, truth, inside)
        analytic = _at_windows(flow, field)
        return Measured(field, analytic, inside & analytic.any(axis=-1), flow)
    flow = settings.simulated_flow() if is_simulated else settings.true_flow()
    truth = _at_windows(flow, field)
    return Measured(field, truth, np.asarray(truth.any(axis=-1)), flow)


def _at_windows(flow: Flow, field: VectorField) -> Floats:
    centres = field.grid.centres_mm()
    return flow(centres.reshape(-1, 3)).reshape(centres.shape)


def light_notices(settings: Config) -> list[Notice]:
    """Return where tracers are fitted with other light than they are simulated with."""
    simulated, fitted_nm = settings.simulation.light, settings.reconstruction.wavelength_nm
    simulated_nm = None if simulated.kind == "rays" else simulated.wavelength_nm
    if simulated_nm == fitted_nm:
        return []
    made, fitted = ("by rays" if each is None else f"by waves of {each:g} nm" for each in (simulated_nm, fitted_nm))
    text = f"images are simulated {made}, and tracers are fitted {fitted}: particles err more than with the same light"
    remedy = "reconstruction.wavelength_nm as simulation.light has it, or neither"
    return [Notice("light-differs", "simulation.light", text, remedy)]


def validate_all(config: Path, output: Path, *, overwrite: bool = False, console: Console = CONSOLE) -> dict[str, Any]:
    """Write every report into one folder; a limit that one of them misses does not keep the others from being made."""
    # What the last of the reports needs, before the first is made.
    settings = load_rig(config)
    depths_in_volume(settings)
    ensure_experiment(settings)
    stages: dict[str, Callable[..., dict[str, Any]]] = {
        "weights": validate_weights,
        "board": validate_board,
        "flow": validate_flow,
    }
    summary: dict[str, Any] = {}
    missed = []
    for name, stage in stages.items():
        try:
            found = stage(config, output, overwrite=overwrite, console=console)
        except LimitMissedError as error:
            missed.append(str(error))
            found = error.figures
        summary |= {f"{name}.{figure}": value for figure, value in found.items()}
    if missed:
        raise LimitMissedError("; ".join(missed), summary)
    return summary
