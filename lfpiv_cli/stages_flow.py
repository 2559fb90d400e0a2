"""The stage of `validate flow`: vectors against a known flow, and Section 4.2 as a whole."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli import stages, stages_calibrate, stages_correlate, stages_reconstruct, stages_simulate
from lfpiv_cli.console import Console
from lfpiv_cli.errors import InputError, LimitMissedError, UsageError
from lfpiv_cli.files import vtkhdf
from lfpiv_cli.files.atomic import ensure_writable, write_json
from lfpiv_cli.files.batch import prepare_folder
from lfpiv_cli.files.config import load_config
from lfpiv_cli.files.inputs import given
from lfpiv_cli.files.particles import read_particles
from lfpiv_cli.files.pictures import ensure_drawing, write_picture
from lfpiv_cli.files.provenance import record
from lfpiv_cli.files.sections import FlowSection
from lfpiv_cli.flow.field import VectorField
from lfpiv_cli.validation.channel import Duct, table_4, worst_slice
from lfpiv_cli.validation.flow import flow_figures, limits_missed, truth_at_points
from lfpiv_cli.validation.pictures import flow_figure, slices_figure

# Boards over the depth of the volume: cubic polynomials need four, a fifth tells how well they fit. They leave this
# share of the depth free at both ends: there may be walls, and boards are tilted.
DLFC_BOARDS = 5
DLFC_MARGIN = 0.05


def validate_flow(
    config: Path, vectors: Path | None, particles: Path | None, output: Path, overwrite: bool, console: Console
) -> dict[str, Any]:
    """Judge a vector field by an analytic flow or by true particles; without one, make it from simulated images."""
    is_simulated = vectors is None
    if is_simulated and particles is not None:
        raise UsageError("--particles needs --vectors: the flow of a simulation is known")
    paths = {name: output / name for name in ("flow.json", "flow.png", "flow_slices.png")}
    prepare_folder(list(paths.values()))
    settings = load_config(config)
    duct = duct_of(settings.simulation.flow if is_simulated else settings.validation.flow or settings.simulation.flow)
    if duct is None:
        del paths["flow_slices.png"]
    for target in paths.values():
        ensure_writable(target, overwrite, given(config=config, vectors=vectors, particles=particles).values())
    ensure_drawing()
    if vectors is None:
        vectors = run_chain(config, output, overwrite, console)
    inputs = given(config=config, vectors=vectors, particles=particles)
    field = vtkhdf.open_vectors(vectors)
    if field.dt_s is None:
        raise InputError(f"{vectors}: holds displacements without a time; correlate again with --dt-s")
    centres = _window_centres_mm(field)
    if particles:
        truth, inside = _truth_of_particles(
            particles, centres, vtkhdf.read_header(vectors).attributes["reference_z_mm"]
        )
    else:
        flow = settings.simulated_flow() if is_simulated else settings.true_flow()
        truth = flow(centres.reshape(-1, 3)).reshape(centres.shape)
        inside = np.asarray(truth.any(axis=-1))
    figures = flow_figures(field, truth, inside)
    if duct is not None:
        figures["table_4"] = table_4(field, truth, inside, duct)
        figures["slice_mean_error"] = worst_slice(figures["table_4"])
        write_picture(paths["flow_slices.png"], slices_figure(field, truth, inside, duct), overwrite)
    missed = limits_missed(figures, settings.validation.limits.model_dump())
    made_by = record("validate flow", settings.resolved(), inputs)
    write_json(paths["flow.json"], {"figures": figures, "limits_missed": missed, "provenance": made_by}, overwrite)
    write_picture(paths["flow.png"], flow_figure(field, truth, inside), overwrite)
    summary = {name: value for name, value in figures.items() if not isinstance(value, (list, dict))}
    if missed:
        console.summary(summary)
        raise LimitMissedError(f"{paths['flow.json']}: {'; '.join(missed)}")
    return summary


def duct_of(flow: FlowSection | None) -> Duct | None:
    """Return the duct of a flow, None where it is another one."""
    if flow is None or flow.kind != "square_duct":
        return None
    return Duct(flow.width_mm, flow.centre_mm, flow.axis)


def run_chain(config: Path, output: Path, overwrite: bool, console: Console) -> Path:
    """Simulate the config's experiment, calibrate, reconstruct and correlate in a folder; return the vectors.

    From raw images with all imperfections on, through the same stages and files as recorded ones.
    """
    images, volumes = output / "images", output / "volumes"
    calibration, weights, vectors = (output / name for name in ("calibration.h5", "weights.h5", "vectors.vtkhdf"))
    common: dict[str, Any] = {"overwrite": overwrite, "console": console}
    stages_simulate.simulate_white(config=config, output=images, **common)
    stages_simulate.simulate_particles(config=config, output=images, **common)
    dark = images / "dark.tif"
    settings, depths = load_config(config), []
    boards = [images / "board.tif"]
    if settings.weights.method == "dlfc":
        low, high = settings.grid().bounds_mm(2)
        margin = DLFC_MARGIN * (high - low)
        depths = np.linspace(low + margin, high - margin, DLFC_BOARDS).round(2).tolist()
        boards = [images / stages_simulate.board_at(depth) for depth in depths]
        stages_simulate.simulate_boards(config=config, output=images, depth_mm=depths, **common)
    else:
        stages_simulate.simulate_board(config=config, output=images, **common)
    stages_calibrate.calibrate_snapshot(
        config=config,
        white=[images / "white.tif"],
        dark=dark,
        board=boards,
        depth_mm=depths,
        output=calibration,
        picture=None,
        views=None,
        **common,
    )
    stages.build_weights(
        config=config, calibration=calibration, method=None, refraction=None, sampling=None, output=weights, **common
    )
    pair = [images / "pair_a.tif", images / "pair_b.tif"]
    stages_reconstruct.reconstruct(
        weights=weights,
        images=pair,
        solver=None,
        iterations=None,
        relaxation=None,
        accelerate=None,
        start=None,
        dark=dark,
        background=None,
        mask=None,
        resume=False,
        keep_going=False,
        output=volumes,
        **common,
    )
    stages_correlate.correlate(
        volumes=[volumes / f"{image.stem}.vtkhdf" for image in pair],
        config=None,
        dt_s=None,
        windows=None,
        overlap=None,
        pairing=None,
        mask=None,
        ensemble=False,
        derived=False,
        mean=None,
        resume=False,
        output=vectors,
        **common,
    )
    return vectors


def _window_centres_mm(field: VectorField) -> NDArray[np.float64]:
    """Return the window centres (nz, ny, nx, 3) in the coordinates of the file."""
    z, y, x = np.meshgrid(*(field.grid.axis_mm(axis) for axis in (2, 1, 0)), indexing="ij")
    return np.stack([x, y, z], axis=-1)


def _truth_of_particles(
    path: Path, centres_mm: NDArray[np.float64], reference_z_mm: float
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return the true velocities at the window centres, and which of these lie among the particles."""
    particles = read_particles(path)
    centres = centres_mm + np.array([0.0, 0.0, reference_z_mm])
    low, high = particles.positions_mm.min(axis=0), particles.positions_mm.max(axis=0)
    inside = np.all((centres >= low) & (centres <= high), axis=-1)
    return truth_at_points(particles.positions_mm, particles.velocities_m_s, centres), inside
