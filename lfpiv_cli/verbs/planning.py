"""What to expect of a rig before it records anything: a verdict a line, from the configuration and a calibration.

A line is good, or worth a look, or says that the experiment cannot work so; or nobody can know.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from lfpiv_cli.arrays import Floats, Integers
from lfpiv_cli.calibration.model import Calibration
from lfpiv_cli.calibration.sheet import LARGE_F_RATIO, LARGEST_F_RATIO
from lfpiv_cli.errors import ConfigError, InputError
from lfpiv_cli.files.config import Config
from lfpiv_cli.files.sections import NM_TO_MM, UM_TO_MM
from lfpiv_cli.flow.windows import ROUNDING, WindowLayout
from lfpiv_cli.grid import Grid, Reference, Scale
from lfpiv_cli.notice import written
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.media import Media
from lfpiv_cli.synthetic.flows import MM_PER_M
from lfpiv_cli.validation import planning
from lfpiv_cli.validation.planning import Miniature, Tracer
from lfpiv_cli.verbs.checks import Line, Verdict
from lfpiv_cli.verbs.particles import light_of
from lfpiv_cli.verbs.simulate import readout_of
from lfpiv_cli.verbs.weights_cost import TRACER_S, Cost, check_rig, cost_notices, cost_of, ray_notices
from lfpiv_cli.weights.build import default_padding
from lfpiv_cli.weights.scene import Source

# Shares of the volume: in full view, and within the depth of field.
GOOD_VIEW, LEAST_VIEW = 0.97, 0.5
GOOD_DEPTH, LEAST_DEPTH = 0.99, 0.7
# Pixels of a lens image, which are the views from across the aperture.
GOOD_PIXELS, LEAST_PIXELS = 8.0, 5.0
# Error of a tracer's depth over the depth in which its light spreads by one lens.
GOOD_ERROR, LARGEST_ERROR = 0.05, 0.25
# Voxels in microlenses and in depths of one lens: particles lock to wider ones.
GOOD_VOXEL, LARGEST_VOXEL = 0.55, 1.05
# Sides of windows that differ by less are alike: they are written with few digits.
WINDOWS_ALIKE = 0.02
# Of the coarse window's side: beyond it displacements are hardly measured at all.
LARGEST_SHARE_OF_WINDOW = 0.5
# By waves each depth takes about a second.
DEPTHS, DEPTHS_BY_WAVES = 21, 11
# Light of frequency-doubled lasers, where no wavelength is given. A microlens that spreads it over less of a pixel than
# charge diffuses may be taken for sharp.
GREEN_NM, SHARP_PX = 532.0, 0.2
# Beyond so many depths of field a tracer's light covers the sensor, and its errors would take minutes to tell.
FARTHEST_FIELDS = 2.0
# Points along each axis at which a configured flow is asked for its speed, and the percentile that counts.
FLOW_POINTS, FAST_PERCENTILE = 9, 95.0
# Bytes of a raw image's pixel, and of a volume's voxel.
PIXEL_BYTES, VOXEL_BYTES = 2, 4


@dataclass(frozen=True, eq=False)
class Bench:
    """A rig as far as it is known.

    Attributes
    ----------
    settings, found : the config, and the calibration or None
    camera, media : calibrated where there is a calibration
    grid : the volume, z from the focal point
    velocity_m_s : to expect; None: nobody says
    """

    settings: Config
    found: Calibration | None
    camera: Camera
    media: Media
    grid: Grid
    velocity_m_s: float | None

    @property
    def scale(self) -> Scale:
        """The camera's lengths in the scene."""
        return self.camera.scale(self.media)

    @property
    def mid_plane_z_mm(self) -> float:
        """Depth of a channel's mid plane; where it is not known, the camera is focused on it."""
        return (self.found.mid_plane_z_mm if self.found else None) or 0.0

    @property
    def bounds_mm(self) -> Floats:
        """(3, 2) of the volume, z from the focal point."""
        return np.array([self.grid.bounds_mm(axis) for axis in range(3)])

    @property
    def depths_mm(self) -> Floats:
        """Depths of the volume, from the focal point."""
        count = DEPTHS if self.settings.reconstruction.wavelength_nm is None else DEPTHS_BY_WAVES
        return np.linspace(self.bounds_mm[2, 0], self.bounds_mm[2, 1], count)

    @property
    def sides_mm(self) -> Floats:
        """(3,) of the volume."""
        return np.diff(self.bounds_mm)[:, 0]

    @property
    def window_layout(self) -> WindowLayout:
        """The final interrogation windows."""
        return self.settings.correlation_settings(self.grid.spacing_mm).layout(self.grid.shape_xyz)

    @cached_property
    def errors_mm(self) -> Floats:
        """Smallest errors (n, 3) of simulated tracers at `depths_mm`."""
        return self.errors_of(self.tracer())

    def errors_of(self, tracer: Tracer) -> Floats:
        """Return the smallest errors (n, 3) of a tracer at `depths_mm`, beyond what can be refocused of its end."""
        seen, places = self.seen
        return planning.errors_by_depth_mm(seen, tracer)[places]

    @cached_property
    def seen(self) -> tuple[list[Miniature], Integers]:
        """How tracers look at `depths_mm`, by the light they are fitted with, and which of those depths each is."""
        far = FARTHEST_FIELDS * planning.depth_of_field_mm(self.camera, self.media)
        depths_mm, places = np.unique(np.clip(self.depths_mm, -far, far), return_inverse=True)
        light = light_of(self.settings, (-far, far))
        return planning.in_miniature(self.camera, self.media, depths_mm, self.tracer().radius_mm, light), places

    def tracer(self) -> Tracer:
        """Return a tracer as the config simulates it."""
        scene = self.settings.simulation
        return Tracer(scene.particle_counts, 0.5 * scene.particle_diameter_mm, readout_of(self.settings))


def bench_of(settings: Config, found: Calibration | None, velocity_m_s: float | None = None) -> Bench:
    """Return a rig; without a calibration the focal plane is taken to lie where it should.

    Raises
    ------
    ConfigError, InputError
        The configuration lacks camera, media or volume, or the calibration is of another sensor.
    """
    settings.ensure_plane_layers("planning an experiment")
    camera = settings.camera_model()
    if found is not None:
        camera = found.camera(camera)
    z_mm = 0.0 if found is None or found.mid_plane_z_mm is None else found.mid_plane_z_mm
    named = settings.volume.reference
    grid = settings.grid(Reference(named, z_mm if named == "mid_plane" else 0.0))
    if velocity_m_s is None:
        # That of the configured flow in the volume, where there is a flow.
        with contextlib.suppress(ConfigError):
            flow, volume = settings.true_flow(), settings.grid()
            axes = [np.linspace(*volume.bounds_mm(axis), FLOW_POINTS) for axis in range(3)]
            points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
            speed = float(np.percentile(np.linalg.norm(flow(points), axis=1), FAST_PERCENTILE))
            velocity_m_s = speed if speed > 0.0 else None
    return Bench(settings, found, camera, settings.media_model(), grid, velocity_m_s)


def rig_lines(bench: Bench) -> list[Line]:
    """Return what is to be expected of a rig, a line for each question."""
    questions: Sequence[Callable[[Bench], Line]] = (
        _field_of_view,
        _depth_of_field,
        _f_numbers,
        _lens_images,
        _rays,
        diffraction_line,
        _precision,
        _seeding,
        _voxels,
        windows_line,
        _time_step,
        believed_line,
        _cost,
    )
    return [question(bench) for question in questions]


def rig_figures(bench: Bench) -> dict[str, Any]:
    """Return what a rig's lines are about, as numbers."""
    view = 2.0 * planning.half_view_mm(bench.camera, bench.media, [0.0])[0]
    best = planning.tracers_in(bench.camera, planning.BEST_PER_LENS, bench.sides_mm)
    camera = bench.camera
    figures = {
        "field_of_view_mm": view.tolist(),
        "depth_of_field_mm": planning.depth_of_field_mm(camera, bench.media),
        "lens_image_width": camera.lens_image_width,
        "pixels_per_lens": planning.pixels_per_lens(camera),
        "sigma_mm": np.median(bench.errors_mm, axis=0).tolist(),
        "best_tracers": round(best),
        "best_tracers_per_lens": planning.BEST_PER_LENS,
        "best_tracers_per_mm3": best / float(np.prod(bench.sides_mm)),
        "best_ppp": planning.BEST_PER_LENS / camera.micro_image_lattice_px().cell_area,
        "voxels_xyz": list(bench.grid.shape_xyz),
        "voxel_mm": list(bench.grid.spacing_mm),
        "windows_voxel": [list(window) for window in bench.settings.windows_voxel(bench.grid.spacing_mm)],
        "vectors_xyz": list(bench.window_layout.count),
        "expected_velocity_m_s": bench.velocity_m_s,
        "best_dt_s": _best_time_s(bench),
    }
    figures["estimated_particles_core_s"] = TRACER_S * best
    # Bytes and seconds for one image, where the rig can be worked with at all.
    with contextlib.suppress(ConfigError, InputError):
        figures |= _cost_of(bench).summary() | {
            "image_file_bytes": PIXEL_BYTES * camera.columns * camera.rows,
            "volume_file_bytes": VOXEL_BYTES * int(np.prod(bench.grid.shape_xyz)),
        }
    return figures


def by_depth(bench: Bench) -> dict[str, Floats]:
    """Return errors and fields of view by depth, for a picture."""
    depths, camera, media = bench.depths_mm, bench.camera, bench.media
    return {
        "depth_mm": depths,
        "sigma_mm": bench.errors_mm,
        "full_view_mm": planning.half_view_mm(camera, media, depths),
        "any_view_mm": planning.half_view_mm(camera, media, depths, 1.0),
    }


def graded(value: float, good: float, limit: float) -> Verdict:
    """Return good up to one limit, no beyond another one, and look between them; the first may be the larger one."""
    if good > limit:
        value, good, limit = -value, -good, -limit
    return "good" if value <= good else "look" if value <= limit else "no"


def _field_of_view(bench: Bench) -> Line:
    share = planning.share_in_view(bench.camera, bench.media, bench.bounds_mm)
    width, height = 2.0 * planning.half_view_mm(bench.camera, bench.media, [0.0])[0]
    ends = planning.half_view_mm(bench.camera, bench.media, bench.bounds_mm[2]).min(axis=0)
    reason = f"{written(width)} x {written(height)} mm at the focal plane; {share:.0%} of the volume is in full view"
    verdict = graded(share, GOOD_VIEW, LEAST_VIEW)
    if verdict != "good":
        reason += f", {written(2.0 * ends[0])} x {written(2.0 * ends[1])} mm would be at all of its depths"
    return Line("field of view", verdict, reason)


def _depth_of_field(bench: Bench) -> Line:
    reach = planning.depth_of_field_mm(bench.camera, bench.media)
    (low, high), inside = bench.bounds_mm[2], np.clip(bench.bounds_mm[2], -reach, reach)
    share = float(inside[1] - inside[0]) / float(high - low)
    reason = (
        f"points can be refocused within {written(reach)} mm of the focal plane; the volume is {written(low)} to "
        f"{written(high)} mm from it"
    )
    return Line("depth of field", graded(share, GOOD_DEPTH, LEAST_DEPTH), reason)


def _f_numbers(bench: Bench) -> Line:
    width = bench.camera.lens_image_width
    main = bench.camera.image_distance_mm / bench.camera.aperture_mm
    reason = f"f/{written(main)} towards the array and f/{written(main * width)} of the microlenses: lens images "
    if width > LARGE_F_RATIO:
        reason += f"overlap, {width:.2f} of their pitch wide; stop the main lens down"
    elif width < 1.0 / LARGE_F_RATIO:
        reason += f"fill only {width:.2f} of their pitch; open the main lens"
    else:
        reason += "just touch"
    return Line("f-numbers", graded(max(width, 1.0 / width), LARGE_F_RATIO, LARGEST_F_RATIO), reason)


def _lens_images(bench: Bench) -> Line:
    pixels = planning.pixels_per_lens(bench.camera)
    reason = f"{written(pixels)} pixels across, as many views tell depths apart; {GOOD_PIXELS:g} or more are good"
    return Line("lens images", graded(pixels, GOOD_PIXELS, LEAST_PIXELS), reason)


def _rays(bench: Bench) -> Line:
    try:
        check_rig(bench.settings, bench.found)
        source = _source(bench)
        notices = ray_notices(bench.settings, bench.found, bench.camera, source, bench.grid)
    except (ConfigError, InputError) as error:
        return Line("rays", "no", str(error))
    if not notices:
        return Line("rays", "good", "paraxial lens and refraction are right to half a pixel")
    return Line("rays", "look", "; ".join(f"{notice.about} {notice.text}: {notice.remedy}" for notice in notices))


def diffraction_line(bench: Bench) -> Line:
    """Say what microlenses do to light that tracers are fitted without."""
    about, given_nm = "diffraction", bench.settings.reconstruction.wavelength_nm
    wavelength_nm, camera = given_nm or GREEN_NM, bench.camera
    width_mm = wavelength_nm * NM_TO_MM * camera.microlens_distance_mm / float(camera.lattice.pitch.mean())
    width_px = width_mm / camera.pixel_mm
    reason = (
        f"a microlens spreads light of {wavelength_nm:g} nm over {written(width_mm / UM_TO_MM, 2)} um, "
        f"{written(width_px, 2)} pixel"
    )
    if given_nm is not None:
        return Line(about, "good", f"{reason}; tracers are fitted by waves")
    if width_px <= SHARP_PX:
        return Line(about, "good", f"{reason}; rays are sharp enough")
    reason += (
        "; rays leave that out: tracers in a camera's images then err several times as much as told here; "
        "set reconstruction.wavelength_nm (simulated images are by rays unless simulation.light is waves)"
    )
    return Line(about, "look", reason)


def _source(bench: Bench) -> Source:
    """Return how rays are found; a channel's mid plane that is not known is where the camera is focused."""
    if bench.settings.weights.method == "dlfc":
        return bench.settings.ray_source(bench.found)
    return bench.settings.plane_space("planning", bench.mid_plane_z_mm)


def _precision(bench: Bench) -> Line:
    errors = bench.errors_mm
    lateral, depth = float(np.median(errors[:, :2])), float(np.median(errors[:, 2]))
    usable = float(np.mean(errors[:, 2] <= LARGEST_ERROR * bench.scale.depth_mm))
    reason = (
        f"{by_which_light(bench)} a tracer alone of {written(bench.tracer().light_counts)} counts is placed to "
        f"{written(1e3 * lateral, 2)} um across and {written(1e3 * depth, 2)} um in depth; depths are told in "
        f"{usable:.0%} of the volume"
    )
    return Line("precision", error_verdict(bench, depth), reason)


def by_which_light(bench: Bench) -> str:
    """Return in words by which light errors are told."""
    return "by rays" if bench.settings.reconstruction.wavelength_nm is None else "by waves"


def error_verdict(bench: Bench, depth_error_mm: float) -> Verdict:
    """Return the verdict on an error in depth."""
    return graded(depth_error_mm / bench.scale.depth_mm, GOOD_ERROR, LARGEST_ERROR)


def _seeding(bench: Bench) -> Line:
    # Of the microlenses that look into the volume.
    lenses = max(planning.tracers_in(bench.camera, 1.0, bench.sides_mm), 1.0)
    return seeding_line(bench, bench.settings.simulation.particles / lenses, "simulated")


def seeding_line(bench: Bench, per_lens: float, what: str) -> Line:
    """Return the verdict on tracers for each microlens, `what` says whose they are."""
    best = planning.tracers_in(bench.camera, planning.BEST_PER_LENS, bench.sides_mm)
    reason = (
        f"{written(per_lens, 2)} tracers per microlens are {what}; {planning.BEST_PER_LENS:g} are best, {best:.0f} in "
        f"the volume, {written(best / float(np.prod(bench.sides_mm)), 2)} per mm3, "
        f"{written(planning.BEST_PER_LENS / bench.camera.micro_image_lattice_px().cell_area, 2)} per pixel"
    )
    if per_lens < planning.SPARSE_PER_LENS:
        return Line("seeding", "look", reason + ": few vectors")
    if per_lens > planning.CROWDED_PER_LENS:
        reason += ": neighbours are taken for one another, volumes err less than particles"
    return Line("seeding", graded(per_lens, planning.CROWDED_PER_LENS, planning.MOST_PER_LENS), reason)


def _voxels(bench: Bench) -> Line:
    shape, voxel, scale = bench.grid.shape_xyz, bench.grid.spacing_mm, bench.scale
    share = max(max(voxel[:2]) / scale.lens_mm, voxel[2] / scale.depth_mm)
    reason = (
        f"{shape[0]} x {shape[1]} x {shape[2]} of {written(voxel[0])} x {written(voxel[1])} x {written(voxel[2])} mm; "
        f"a microlens is {written(scale.lens_mm)} mm wide and {written(scale.depth_mm)} mm deep"
    )
    verdict = graded(share, GOOD_VOXEL, LARGEST_VOXEL)
    if verdict != "good":
        reason += ": tracers lock to voxels as large, volume.size_mm leaves them to the program"
    return Line("voxels", verdict, reason)


def windows_line(bench: Bench) -> Line:
    """Return whether windows give a field that is worth looking at, or which would."""
    final, vectors = bench.window_layout.size, bench.window_layout.count
    density = planning.tracers_in(bench.camera, planning.BEST_PER_LENS, bench.sides_mm) / float(np.prod(bench.sides_mm))
    tracers = density * float(np.prod(np.multiply(final, bench.grid.spacing_mm)))
    reason = (
        f"{final[0]} x {final[1]} x {final[2]} voxels give {vectors[0]} x {vectors[1]} x {vectors[2]} vectors, with "
        f"{written(tracers, 2)} tracers each at the best seeding"
    )
    if any(size > voxels for size, voxels in zip(final, bench.grid.shape_xyz, strict=True)):
        return Line("windows", "no", f"{reason}: they do not fit into the volume; {_better_windows(bench)}")
    few = min(vectors) < planning.WORTH_VECTORS
    if not few and tracers >= planning.FEWEST_TRACERS:
        return Line("windows", "good", reason)
    return Line("windows", "look", f"{reason}: {_better_windows(bench)}")


def _better_windows(bench: Bench) -> str:
    """Return in words which windows suit volume and tracers, and why even they give few vectors if they do."""
    chosen, sides = bench.settings.correlation, bench.sides_mm
    window = planning.proposed_window_mm(bench.camera, bench.media, sides, chosen.overlap)
    steps = window * (1.0 - np.asarray(chosen.overlap))
    vectors = np.maximum(np.floor(np.asarray(sides) / steps + ROUNDING), 1.0).astype(np.int64)
    reported = []
    if chosen.window_mm is None or not np.allclose(chosen.window_mm, window, rtol=WINDOWS_ALIKE):
        instead = " in place of correlation.windows" if chosen.windows is not None else ""
        reported.append(f"set correlation.window_mm: {window.tolist()}{instead}, for {' x '.join(map(str, vectors))}")
    few = [axis for axis, count in zip("xyz", vectors, strict=True) if count < planning.WORTH_VECTORS]
    if few:
        limit = f"smaller windows hold fewer than {planning.FEWEST_TRACERS:g}"
        if few == ["z"] and window[2] <= bench.scale.depth_mm:
            limit = f"they are about {written(bench.scale.depth_mm)} mm long in a volume"
        reported.append(f"tracers allow fewer than {planning.WORTH_VECTORS} along {', '.join(few)}: {limit}")
    return "; ".join(reported)


def _best_time_s(bench: Bench) -> float | None:
    if bench.velocity_m_s is None:
        return None
    return planning.time_step_s(bench.velocity_m_s, min(bench.grid.spacing_mm[:2]))


def _time_step(bench: Bench) -> Line:
    about, given, best = "time step", bench.settings.correlation.dt_s, _best_time_s(bench)
    if bench.velocity_m_s is None or best is None:
        return Line(about, "unknown", "no flow is configured; --velocity-m-s tells what to expect")
    advice = f"{written(best, 2)} s let {written(bench.velocity_m_s)} m/s cross {planning.BEST_STEP:g} voxels"
    if given is None:
        return Line(about, "unknown", f"{advice}; correlation.dt_s is not set")
    voxel = min(bench.grid.spacing_mm[:2])
    crossed = bench.velocity_m_s * MM_PER_M * given / voxel
    coarse = min(bench.settings.windows_voxel(bench.grid.spacing_mm)[0][:2])
    reason = (
        f"{written(given)} s cross {written(crossed, 2)} voxels, {planning.SMALLEST_STEP:g} to "
        f"{planning.LARGEST_STEP:g} are good"
    )
    if planning.SMALLEST_STEP <= crossed <= planning.LARGEST_STEP:
        return Line(about, "good", reason)
    beyond = crossed > max(LARGEST_SHARE_OF_WINDOW * coarse, planning.LARGEST_STEP)
    return Line(about, "no" if beyond else "look", f"{reason}; {advice}")


def believed_line(bench: Bench) -> Line:
    """Say what one snapshot does not tell of a rig, and how far off depths and velocities are where it is off."""
    camera, index, known = bench.camera, bench.media.fluid, bench.found is not None and bench.found.pose is not None
    reasons = [] if known else ["no board tells camera.main_lens.magnification"]
    if not known:
        other = replace(camera, magnification=1.01 * camera.magnification).scale(bench.media)
        across, along = 1.0 - other.lens_mm / bench.scale.lens_mm, 1.0 - other.depth_mm / bench.scale.depth_mm
        reasons[0] += f" of {camera.magnification:g}: 1% more makes lengths {across:.1%} and depths {along:.1%} smaller"
    if index != 1.0:
        reasons.append(f"no snapshot tells media.fluid of {index:g}: 1% more makes depths and w 1% larger")
    # Rays through the middle of the lens meet a depth z, as seen in air, by x z / s_o beside where they meet the focus.
    corner = np.abs(bench.bounds_mm).max(axis=1)
    moved_mm = 0.01 * corner[:2].max() * corner[2] * bench.media.depth_ratio / camera.focus_distance_mm
    reasons.append(
        f"no snapshot tells camera.main_lens.focal_length_mm of {camera.focal_length_mm:g}: 1% more moves places at "
        f"the volume's corners by {written(moved_mm / UM_TO_MM, 2)} um across"
    )
    reasons.append("boards at several depths tell these")
    reasons.append("nothing tells which image of a pair is the first: exchanged, velocities change their sign")
    return Line("believed", "unknown", "; ".join(reasons))


def _cost_of(bench: Bench) -> Cost:
    settings, camera = bench.settings, bench.camera
    padding = settings.reconstruction.padding_voxel or default_padding(camera, bench.media, bench.grid)
    return cost_of(settings, camera, _source(bench), bench.grid.padded(padding))


def _cost(bench: Bench) -> Line:
    try:
        cost = _cost_of(bench)
    except (ConfigError, InputError) as error:
        return Line("work", "no", str(error))
    best = planning.tracers_in(bench.camera, planning.BEST_PER_LENS, bench.sides_mm)
    files = PIXEL_BYTES * bench.camera.columns * bench.camera.rows + VOXEL_BYTES * int(np.prod(bench.grid.shape_xyz))
    reason = (
        f"weights {written(cost.weights_core_s, 2)} s of a core, each image {written(cost.image_core_s, 2)} s by "
        f"volumes, {written(TRACER_S * best, 2)} s by particles at the best seeding; "
        f"{written(max(cost.weights_bytes, cost.image_bytes) / 1e9, 2)} GB of memory, {written(files / 1e6, 2)} MB of "
        "disk an image"
    )
    return Line("work", "look" if cost_notices(cost) else "good", reason)
