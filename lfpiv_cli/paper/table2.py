"""The camera of Table 2: what follows from its numbers against what the paper says."""

from __future__ import annotations

from lfpiv_cli.files.config import load_config
from lfpiv_cli.files.pages import Table
from lfpiv_cli.paper.parts import Findings, Row, Work
from lfpiv_cli.paper.rig import sections

# Derived quantities as Table 2 and Section 3.1 have them: the paper's value, and what it is called.
PAPER = {
    "f-number of the main lens": 4.0,
    "f-number of the microlenses": 8.0,
    "main lens to microlenses (mm)": 200.0,
    "aperture of the main lens (mm)": 25.0,
    "microlens pitch (mm)": 0.1,
    "pixel pitch (µm)": 5.5,
}
# The numbers are exact; only rounding in doubles is let through.
LARGEST_DEVIATION = 1e-9


def table2(work: Work) -> Findings:
    """Return the camera's derived quantities beside the paper's."""
    settings = load_config(work.config("table2", sections()))
    camera, scale = settings.camera_model(), settings.camera_model().scale(settings.media_model())
    pitch = float(camera.lattice.pitch.mean())
    ours = dict(
        zip(
            PAPER,
            (
                camera.focal_length_mm / camera.aperture_mm,
                camera.microlens_focal_length_mm / pitch,
                camera.image_distance_mm,
                camera.aperture_mm,
                pitch,
                1e3 * camera.pixel_mm,
            ),
            strict=True,
        )
    )
    deviation = max(abs(ours[name] / value - 1.0) for name, value in PAPER.items())
    derived = {
        "width of a lens image (pixels)": f"{pitch * camera.micro_image_scale / camera.pixel_mm:.3f}",
        "lens images on the sensor": f"{camera.columns * camera.pixel_mm / pitch / camera.micro_image_scale:.0f} x "
        f"{camera.rows * camera.pixel_mm / pitch / camera.micro_image_scale:.0f} (the array has 252 x 252)",
        "microlens in the scene (mm)": f"{scale.lens_mm:.3f}",
        "depth over which a point spreads by one microlens (mm)": f"{scale.depth_mm:.3f}",
    }
    rows = [(name, f"{value:g}", f"{ours[name]:g}") for name, value in PAPER.items()]
    return Findings(
        rows=(
            Row(
                quantity="largest relative deviation from Table 2",
                source="Table 2",
                limit=LARGEST_DEVIATION,
                best=deviation,
            ),
        ),
        tables=(
            Table(
                "Optical parameters",
                ("quantity", "paper", "ours"),
                (*rows, *((name, "–", value) for name, value in derived.items())),
            ),
        ),
        text=(
            "All parts work with this camera. At a magnification of -1 the main lens stands twice its focal length "
            f"from the array and works at f/{camera.image_distance_mm / camera.aperture_mm:g}, as the microlenses do: "
            f"lens images are {camera.lens_image_width:.2f} pitches wide and just touch.",
        ),
        commands=("lfpiv build-weights work/table2/table2.yaml -o weights.h5",),
    )
