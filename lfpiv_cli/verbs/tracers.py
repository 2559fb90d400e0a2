"""The tracers' size as it is given or seen, and what speaks against it and against the particles found."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from lfpiv_cli.files.config import Config
from lfpiv_cli.files.particle_file import Points
from lfpiv_cli.notice import Notice, written
from lfpiv_cli.optics.line_responses import USUAL_DIFFUSION_PX
from lfpiv_cli.particles.camera_light import USUAL_SIGMA_PX
from lfpiv_cli.particles.diameter import LIMIT_SIGMAS, UNKNOWN_LENSES, Diameter
from lfpiv_cli.particles.stated import MUCH_ALIKE, MUCH_LEFT
from lfpiv_cli.verbs.frames import haze_notices

# More than this share of an image's light, its noise taken off, is too much to leave unexplained.
LARGEST_UNEXPLAINED = 0.2
# Where more than this is left that is alike in pixels side by side, by the root of its share, the model of light is
# wrong: fitted by rays, images by rays leave up to 0.05, crowded ones, those by waves 0.065 to 0.11, and near the focal
# plane 0.65 to 0.7 of their depths are covered. Where hardly any is alike, what is left is noise.
MUCH_LEFT_ALIKE, LEAST_ALIKE = 0.06, 0.05
# Of 2 tracers for each microlens .87 to .94 of stated errors are covered and .92 to .96 of what a pair shows are
# tracers, of 3 .85 of what a frame shows. Of five random rigs whose focal plane holds 1.2 to 1.45 for each microlens
# .84 to .96 are covered, of two that hold 2.8 .77 to .86.
LARGEST_CROWD, LARGEST_CROWD_IN_FOCUS = 2.0, 1.5
# Of tracers at all depths of a usual volume one in seven at most has another depth that fits about as well, in crowds.
MOST_AMBIGUOUS = 0.25
# Of tracers in a volume that holds all of them hardly one in a hundred is taken to lie outside its margin; of few one
# or two are.
MOST_BEYOND, FEWEST_BEYOND = 0.03, 2.5
# Microlenses whose focal length is off by a larger share are told: depths are off by some three stated errors for each
# per cent. Good ones seem up to 0.002 off, and more the more light is left, and the more tracers there are for each
# microlens from one on.
LARGEST_FOCUS_ERROR = 0.005
# Beyond so many standard errors what is seen is not by chance.
CERTAIN_SIGMAS = 5.0
# Beyond so many standard errors a given diameter contradicts the images.
CONTRADICTING_SIGMAS = 4.0


@dataclass(frozen=True)
class Diffusion:
    """The sensor's charge diffusion.

    Attributes
    ----------
    px : that particles are fitted with by waves
    measured_px, sigma_px : by the tracers' images, and its standard error; None where no image shows it
    given : whether it is given
    reported : whether the images tell it, not what is usual
    """

    px: float
    measured_px: float | None = None
    sigma_px: float | None = None
    given: bool = False
    reported: bool = False

    def attributes(self) -> dict[str, float]:
        """Return what files say of it: its standard error where it is not given."""
        usual = USUAL_SIGMA_PX if self.sigma_px is None else self.sigma_px
        return {"diffusion_px": self.px} | ({} if self.given else {"diffusion_sigma_px": usual})

    def summary(self) -> dict[str, float | None]:
        """Return what is told of it; None where it is not known."""
        return {"diffusion_px": self.px, "diffusion_measured_px": self.measured_px, "diffusion_sigma_px": self.sigma_px}


@dataclass(frozen=True)
class TracerSize:
    """The tracers' diameter.

    Attributes
    ----------
    diameter_mm : that they are fitted with
    measured_mm, sigma_mm : by their images, and its standard error; None where no image shows it
    resolved : whether more than an upper limit is known by the images
    diffusion : by waves, how far charge diffuses in the sensor
    frames : what single images show of it, where several do
    """

    diameter_mm: float
    measured_mm: float | None = None
    sigma_mm: float | None = None
    resolved: bool = False
    diffusion: Diffusion | None = None
    frames: tuple[TracerSize, ...] = ()

    @property
    def at_most_mm(self) -> float | None:
        """What it is not above, by the images."""
        if self.measured_mm is None or self.sigma_mm is None:
            return None
        return self.measured_mm + LIMIT_SIGMAS * self.sigma_mm

    def attributes(self) -> dict[str, float]:
        """Return what files say of it: its standard error where it is by the images."""
        reported = {"particle_diameter_mm": self.diameter_mm}
        if self.sigma_mm is not None and self.diameter_mm == self.measured_mm:
            reported["particle_diameter_sigma_mm"] = self.sigma_mm
        return reported | (self.diffusion.attributes() if self.diffusion else {})

    def summary(self) -> dict[str, float | None]:
        """Return what is told of it; None where it is not known."""
        return {
            "particle_diameter_mm": self.diameter_mm,
            "particle_diameter_measured_mm": self.measured_mm,
            "particle_diameter_sigma_mm": self.sigma_mm,
        } | (self.diffusion.summary() if self.diffusion else {})


def tracer_size(
    found: Diameter | None, given: float | None, given_px: float | None, lens_mm: float, by_waves: bool
) -> TracerSize:
    """Return the tracers' size, as given or by what images show of it, by waves with diffusion."""
    diffusion = None
    if by_waves:
        # As given, by the images, or as is usual.
        shown = None if found is None else found.held if given_px is None else found.shown
        usual = USUAL_DIFFUSION_PX if shown is None else shown.diffusion_px
        diffusion = Diffusion(usual if given_px is None else given_px, given=given_px is not None)
        if shown is not None:
            diffusion = replace(
                diffusion, measured_px=shown.diffusion_px, sigma_px=shown.sigma_px, reported=shown.reported
            )
    if found is None:
        return TracerSize(given or UNKNOWN_LENSES * lens_mm, diffusion=diffusion)
    measured = lens_mm * found.lenses
    return TracerSize(given or measured, measured, lens_mm * found.sigma_lenses, found.resolved, diffusion)


def size_notices(settings: Config, size: TracerSize) -> list[Notice]:
    """Return where diameter and diffusion as given contradict the images, these each other, or where none tells."""
    reported = [
        *_diameter_notices(settings, size),
        *([] if size.diffusion is None else _diffusion_notices(size.diffusion)),
    ]
    diameters = [(each.measured_mm, each.sigma_mm) for each in size.frames]
    diffusions = [(each.diffusion.measured_px, each.diffusion.sigma_px) for each in size.frames if each.diffusion]
    for key, unit, values in (("particle_diameter_mm", "mm", diameters), ("diffusion_px", "px", diffusions)):
        known = [(value, sigma) for value, sigma in values if value is not None and sigma is not None]
        for (one, sigma), (other, other_sigma) in combinations(known, 2):
            if abs(one - other) > CONTRADICTING_SIGMAS * np.hypot(sigma, other_sigma):
                text = (
                    f"{written(one)} ± {written(sigma, 2)} {unit} by one image and "
                    f"{written(other)} ± {written(other_sigma, 2)} {unit} by another, which contradict each other"
                )
                remedy = "check focus, exposure and the laser's light in either image; or give it, if it is known"
                reported.append(
                    Notice("images-differ", f"reconstruction.{key}", text, remedy, one, f"{written(other)} {unit}")
                )
    return reported


def _diffusion_notices(found: Diffusion) -> list[Notice]:
    """Return where a given diffusion contradicts the images, or where they do not tell it."""
    key = "reconstruction.diffusion_px"
    if found.measured_px is None or found.sigma_px is None or not found.reported:
        text = f"the images do not tell how far charge diffuses: {written(found.px)} px is taken"
        remedy = "give it, or tracers that stand alone at several depths"
        return [] if found.given else [Notice("diffusion-unknown", key, text, remedy, found.sigma_px, None)]
    if found.given and abs(found.px - found.measured_px) > CONTRADICTING_SIGMAS * found.sigma_px:
        text = (
            f"{found.px:g} px, but by the images it is {written(found.measured_px)} ± {written(found.sigma_px, 2)} px"
        )
        remedy = "leave it out, and it is taken from the images; or check wavelength_nm and calibration"
        return [Notice("diffusion", key, text, remedy, found.px, f"{written(found.measured_px)} px")]
    return []


def _diameter_notices(settings: Config, size: TracerSize) -> list[Notice]:
    given, key = settings.reconstruction.particle_diameter_mm, "reconstruction.particle_diameter_mm"
    if size.measured_mm is None or size.sigma_mm is None:
        if given is not None:
            return []
        text = (
            "too few tracers stand alone for the images to show their size; "
            f"{written(size.diameter_mm)} mm is taken, half a microlens in the scene"
        )
        return [Notice("particle-diameter-unknown", key, text, "give it", None, "tracers that stand alone")]
    if given is not None and abs(given - size.measured_mm) > CONTRADICTING_SIGMAS * size.sigma_mm:
        text = f"{given:g} mm, but by the images it is {written(size.measured_mm)} ± {written(size.sigma_mm, 2)} mm"
        remedy = "leave it out, and it is taken from the images; or check calibration and focus"
        return [Notice("particle-diameter", key, text, remedy, given, f"{written(size.measured_mm)} mm")]
    if given is None and not size.resolved and (at_most_mm := size.at_most_mm) is not None:
        text = f"tracers are smaller than the images show: at most {written(at_most_mm, 2)} mm"
        return [Notice("particle-diameter-limit", key, text, "give it, if it is known", at_most_mm, None)]
    return []


def light_notices(points: Points, name: str) -> list[Notice]:
    """Return where none were found, there is haze, they crowd, or leave more of the light than noise makes."""
    measured = points.attributes
    noise_share = measured["read_noise_counts"] / max(measured["residual_rms_counts"], measured["read_noise_counts"])
    # Noise that is not known well is none of the light that is alike in pixels side by side.
    not_noise = measured["residual"] * float(np.sqrt(1.0 - min(noise_share, 1.0) ** 2))
    unexplained = min(not_noise, measured.get("residual_smooth", 1.0))
    count, notices = len(points.position_mm), haze_notices(measured, name)

    def against(code: str, text: str, remedy: str, figure: float, expected: str) -> None:
        notices.append(Notice(code, name, text, remedy, figure, expected))

    found = measured["particles_per_lens"]
    crowd = max(found, measured.get("tracers_per_lens", 0.0))
    # Of crowds particles that are none end anywhere.
    beyond = measured.get("beyond_depths", 0.0) if crowd <= LARGEST_CROWD else 0.0
    # What lies beside all particles is light of others, as at the sensor's edge, and not the model's.
    left, alike = min(unexplained, measured.get("residual_lit", 1.0)), measured.get("residual_alike", MUCH_ALIKE)
    if unexplained > LARGEST_UNEXPLAINED:
        against(
            "light-unexplained",
            f"{count or 'no'} particles found, and {unexplained:.0%} of the light is not explained by them, at "
            f"most {LARGEST_UNEXPLAINED:.0%} of a good image's",
            "check the calibration (refine-calibration), particle_diameter_mm, --dark, --background and the volume",
            unexplained,
            f"at most {LARGEST_UNEXPLAINED:g}",
        )
    elif beyond > max(MOST_BEYOND, FEWEST_BEYOND / max(count, 1)):
        against(
            "light-unexplained",
            f"{beyond:.0%} of the particles end at the first or last depth in which they are sought, at most "
            f"{MOST_BEYOND:.0%} of a good volume's: tracers from further away light the image",
            "a deeper volume, or a thinner light sheet",
            beyond,
            f"at most {MOST_BEYOND:g}",
        )
    elif (left > MUCH_LEFT and alike > LEAST_ALIKE) or left * np.sqrt(alike) > MUCH_LEFT_ALIKE:
        against(
            "light-model",
            f"{left:.0%} of the light is not that of the particles found by {measured['light']}, and "
            f"{alike:.0%} of what is left is alike in pixels side by side; at most {MUCH_LEFT:.0%} is left, or "
            "noise, where the model is right and few are missing: stated errors may be too small",
            "give reconstruction.wavelength_nm, as lenses diffract"
            if measured["light"] == "rays"
            else "check the calibration, wavelength_nm and diffusion_px",
            left,
            f"at most {MUCH_LEFT:g}",
        )
    if crowd > LARGEST_CROWD:
        counted = (
            f", {written(found)} found of {written(crowd)} by how unevenly they light them" if crowd > found else ""
        )
        against(
            "particles-crowded",
            f"{written(crowd)} particles for each microlens{counted}, at most {LARGEST_CROWD:g}: beyond, "
            "neighbours are taken for one another, and standard errors do not know of it",
            "fewer tracers, or volumes and their correlation; --background, where other light is in the image",
            crowd,
            f"at most {LARGEST_CROWD:g}",
        )
    elif (in_focus := measured.get("per_lens_in_focus", 0.0)) > LARGEST_CROWD_IN_FOCUS:
        against(
            "particles-crowded",
            f"next to the focal plane {written(in_focus)} particles light each microlens, at most "
            f"{LARGEST_CROWD_IN_FOCUS:g}: beyond, neighbours are taken for one another, and standard errors do not "
            "know of it",
            "fewer tracers, or a volume that lies beside the focal plane",
            in_focus,
            f"at most {LARGEST_CROWD_IN_FOCUS:g}",
        )
    ambiguous = measured.get("depth_ambiguous", 0.0)
    if ambiguous > MOST_AMBIGUOUS:
        against(
            "depth-ambiguous",
            f"another depth explains the light of {ambiguous:.0%} of the particles about as well, at most "
            f"{MOST_AMBIGUOUS:.0%} of usual tracers': near the focal plane one lens or two hold it all. Their "
            "stated errors cover both depths",
            "a volume that lies beside the focal plane, or more light; reconstruction.wavelength_nm, as lenses "
            "diffract",
            ambiguous,
            f"at most {MOST_AMBIGUOUS:g}",
        )
    off, largest = measured.get("microlens_focus", 0.0), LARGEST_FOCUS_ERROR * max(unexplained / MUCH_LEFT, crowd, 1.0)
    if abs(off) > max(largest, CERTAIN_SIGMAS * measured.get("microlens_focus_sigma", 0.0)):
        least = "at least " if measured.get("light") == "waves" else ""
        against(
            "microlens-focus",
            f"by the tracers' light under single microlenses their focal length is {least}{abs(off):.1%} "
            f"{'longer' if off > 0.0 else 'shorter'} than the rig says, at most {largest:.1%} of a good one, or "
            "microlens_distance_mm is as much off the other way: depths are off, and stated errors too small",
            f"microlenses.focal_length_mm {written(1.0 + off, 4)} times as large, and build the weights again "
            "until it stays",
            off,
            f"within {largest:g}",
        )
    if not count and all(each.code == "haze" for each in notices):
        text = "no particles found: nothing stands out of the noise"
        against("no-particles", text, "check exposure, --dark and --mask", 0.0, "some")
    return notices
