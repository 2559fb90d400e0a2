"""The stage of `validate flow`: vectors against a known flow, and Section 4.2 as a whole."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.console import CONSOLE, Console
from lfpiv_cli.errors import InputError, LimitMissedError, UsageError
from lfpiv_cli.files import vtkhdf
from lfpiv_cli.files.atomic import ensure_writable, write_json
from lfpiv_cli.files.batch import prepare_folder
from lfpiv_cli.files.config import Config, load_config
from lfpiv_cli.files.inputs import given
from lfpiv_cli.files.particles import read_particles
from lfpiv_cli.files.pictures import ensure_drawing, write_picture
from lfpiv_cli.files.provenance import record
from lfpiv_cli.files.sections_simulated import FlowSection
from lfpiv_cli.stages.chain import run_chain
from lfpiv_cli.stages.simulate import ensure_experiment
from lfpiv_cli.validation.channel import Duct
from lfpiv_cli.validation.flow import limits_missed, truth_at_points
from lfpiv_cli.validation.methods import Measured, lower_error
from lfpiv_cli.validation.pictures import flow_figure, slices_figure


def validate_flow(
    config: Path,
    output: Path,
    *,
    vectors: Path | None = None,
    particles: Path | None = None,
    overwrite: bool = False,
    console: Console = CONSOLE,
) -> dict[str, Any]:
    """Judge a vector field by an analytic flow or by true particles; without one, make it from simulated images."""
    is_simulated = vectors is None
    if is_simulated and particles is not None:
        raise UsageError("--particles needs --vectors: the flow of a simulation is known")
    paths = {name: output / name for name in ("flow.json", "flow.png", "flow_slices.png")}
    prepare_folder(list(paths.values()))
    settings = load_config(config)
    if is_simulated:
        ensure_experiment(settings)
    duct = duct_of(settings.simulation.flow if is_simulated else settings.validation.flow or settings.simulation.flow)
    if duct is None:
        del paths["flow_slices.png"]
    for target in paths.values():
        ensure_writable(target, overwrite, given(config=config, vectors=vectors, particles=particles).values())
    ensure_drawing()
    made = {"measured": vectors} if vectors else run_chain(config, output, overwrite=overwrite, console=console)
    inputs = given(config=config, particles=particles) | (given(vectors=vectors) if vectors else made)
    methods = {name: measured_of(path, settings, particles, is_simulated) for name, path in made.items()}
    figures = {name: measured.figures(duct) for name, measured in methods.items()}
    limits = settings.validation.limits.model_dump()
    missed = [
        text if vectors else f"{name}: {text}"
        for name, found in figures.items()
        for text in limits_missed(found, limits)
    ]
    report: dict[str, Any] = {"figures": figures["measured"] if vectors else figures, "limits_missed": missed}
    if len(methods) > 1:
        report["lower_error"] = lower_error(methods, figures)
    report["provenance"] = record("validate flow", settings.resolved(), inputs)
    write_json(paths["flow.json"], report, overwrite)
    write_picture(paths["flow.png"], flow_figure(methods), overwrite)
    if duct is not None:
        write_picture(paths["flow_slices.png"], slices_figure(methods, duct), overwrite)
    summary = _summary(figures) if is_simulated else _scalars(figures["measured"])
    if len(methods) > 1:
        summary["lower_error"] = report["lower_error"]
    if missed:
        raise LimitMissedError(f"{paths['flow.json']}: {'; '.join(missed)}", summary)
    return summary


def duct_of(flow: FlowSection | None) -> Duct | None:
    """Return the duct of a flow, None where it is another one."""
    if flow is None or flow.kind != "square_duct":
        return None
    return Duct(flow.width_mm, flow.centre_mm, flow.axis)


def measured_of(vectors: Path, settings: Config, particles: Path | None, is_simulated: bool) -> Measured:
    """Return vectors with the true flow at their places."""
    field = vtkhdf.open_vectors(vectors)
    if field.dt_s is None:
        raise InputError(f"{vectors}: holds displacements without a time; correlate again with --dt-s")
    centres = field.grid.centres_mm()
    if particles:
        centres = vtkhdf.read_header(vectors).reference.points_to_focal_point(centres)
        return Measured(field, *_truth_of_particles(particles, centres))
    flow = settings.simulated_flow() if is_simulated else settings.true_flow()
    truth = flow(centres.reshape(-1, 3)).reshape(centres.shape)
    return Measured(field, truth, np.asarray(truth.any(axis=-1)))


def _scalars(figures: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in figures.items() if not isinstance(value, (list, dict))}


def _summary(figures: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Return the figures that are numbers, each with the value of every method."""
    names = _scalars(next(iter(figures.values())))
    return {name: {method: found[name] for method, found in figures.items()} for name in names}


def _truth_of_particles(path: Path, centres_mm: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return the true velocities at the window centres, z from the focal point, and which lie among the particles."""
    particles = read_particles(path)
    lit = particles.brightness[:, np.newaxis] > 0.0
    low = particles.positions_mm.min(axis=0, where=lit, initial=np.inf)
    high = particles.positions_mm.max(axis=0, where=lit, initial=-np.inf)
    inside = np.all((centres_mm >= low) & (centres_mm <= high), axis=-1)
    return truth_at_points(particles.positions_mm, particles.velocities_m_s, centres_mm), inside
