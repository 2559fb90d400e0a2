"""The stage of `validate flow`: vectors against a known flow, and Section 4.2 as a whole."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.console import CONSOLE, Console
from lfpiv_cli.errors import InputError, LimitMissedError, UsageError
from lfpiv_cli.files import vtkhdf
from lfpiv_cli.files.atomic import ensure_writable, write_json
from lfpiv_cli.files.config import Config, load_config
from lfpiv_cli.files.inputs import given
from lfpiv_cli.files.particles import read_particles
from lfpiv_cli.files.pictures import ensure_drawing, write_picture
from lfpiv_cli.files.provenance import record
from lfpiv_cli.files.sections_simulated import FlowSection
from lfpiv_cli.flow.field import VectorField
from lfpiv_cli.flow.masks import RoundWall
from lfpiv_cli.notice import Notice
from lfpiv_cli.reference import Reference
from lfpiv_cli.stages.chain import run_chain
from lfpiv_cli.stages.simulate import ensure_experiment
from lfpiv_cli.synthetic.flows import Flow
from lfpiv_cli.validation.channel import Duct
from lfpiv_cli.validation.flow import limits_missed, truth_at_points
from lfpiv_cli.validation.methods import Measured, lower_error
from lfpiv_cli.validation.pictures import errors_figure, flow_figure, profiles_figure, slices_figure
from lfpiv_cli.validation.pipe import radius_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PICTURES: dict[str, Callable[[Mapping[str, Measured]], Figure]] = {
    "flow.png": flow_figure,
    "flow_errors.png": errors_figure,
    "flow_profiles.png": profiles_figure,
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
    paths = {name: output / name for name in ("flow.json", *PICTURES, SLICES, RADII)}
    settings = load_config(config)
    if is_simulated:
        ensure_experiment(settings)
        console.warn(light_notices(settings))
    named = settings.simulation.flow if is_simulated else settings.validation.flow or settings.simulation.flow
    duct, pipe = duct_of(named), named if named is not None and named.kind == "pipe" else None
    walls = None if pipe is None else RoundWall(pipe.radius_mm, pipe.centre_mm, pipe.axis)
    if duct is None:
        del paths[SLICES]
    if pipe is None:
        del paths[RADII]
    for target in paths.values():
        ensure_writable(target, overwrite, given(config=config, vectors=vectors, particles=particles).values())
    ensure_drawing()
    made = {"measured": vectors} if vectors else run_chain(config, output, overwrite=overwrite, console=console)
    inputs = given(config=config, particles=particles) | (given(vectors=vectors) if vectors else made)
    methods = {name: measured_of(path, settings, particles, is_simulated) for name, path in made.items()}
    if particles and named is not None and methods["measured"].flow is None:
        console.warn([_other_flow(config, particles)])
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
        report["lower_error"] = lower_error(methods, figures)
    report["provenance"] = record("validate flow", settings.resolved(), inputs)
    write_json(paths["flow.json"], report, overwrite)
    for name, draw in PICTURES.items():
        write_picture(paths[name], draw(methods), overwrite)
    if duct is not None:
        write_picture(paths[SLICES], slices_figure(methods, duct), overwrite)
    if pipe is not None and walls is not None:
        fields = {name: measured.field for name, measured in methods.items()}
        write_picture(paths[RADII], radius_figure(fields, walls, pipe.mean_velocity_m_s), overwrite)
    summary = _summary(figures) if is_simulated else _scalars(figures["measured"])
    summary["truth"] = truth
    if len(methods) > 1:
        summary["lower_error"] = report["lower_error"]
    if missed:
        raise LimitMissedError(f"{paths['flow.json']}: {'; '.join(missed)}", summary)
    return summary


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
        return _beside_particles(field, vtkhdf.read_header(vectors).reference, settings, particles)
    flow = settings.simulated_flow() if is_simulated else settings.true_flow()
    truth = _at_windows(flow, field)
    return Measured(field, truth, np.asarray(truth.any(axis=-1)), flow)


def _at_windows(flow: Flow, field: VectorField) -> NDArray[np.float64]:
    centres = field.grid.centres_mm()
    return flow(centres.reshape(-1, 3)).reshape(centres.shape)


def _beside_particles(field: VectorField, reference: Reference, settings: Config, particles: Path) -> Measured:
    """Return vectors, judged where there are particles, with the config's flow if these follow it, else with theirs."""
    centres = reference.points_to_focal_point(field.grid.centres_mm())
    truth, inside = _truth_of_particles(particles, centres)
    if settings.validation.flow is None and settings.simulation.flow is None:
        return Measured(field, truth, inside)
    flow, true = settings.true_flow(), read_particles(particles)
    difference = flow(reference.points_from_focal_point(true.positions_mm)) - true.velocities_m_s
    if np.linalg.norm(difference) > SAME_FLOW * np.linalg.norm(true.velocities_m_s):
        return Measured(field, truth, inside)
    analytic = _at_windows(flow, field)
    return Measured(field, analytic, inside & analytic.any(axis=-1), flow)


def _other_flow(config: Path, particles: Path) -> Notice:
    return Notice(
        "truth-contradicts",
        config.name,
        f"the particles of {particles.name} do not move as the flow that it names, and are taken for the truth",
        "validation.flow of this experiment, or none",
    )


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
