"""A file of each kind that commands write, written by the commands themselves: the whole chain on a small rig."""

import re
import shlex
import shutil
from pathlib import Path

from tests.hostile_files import ended

# The shipped sample on a quarter of its sensor and in half its depth, six frames long.
RIG = """
camera:
  main_lens:   {magnification: -1.0, focal_length_mm: 100.0, aperture_mm: 25.0}
  microlenses: {focal_length_mm: 0.8, pitch_mm: 0.1, layout: square}
  sensor:      {pixel_um: 5.5, columns: 300, rows: 224, microlens_distance_mm: 0.8, column_axis: x}
media:   {air: 1.0, window: 1.49, fluid: 1.33, fluid_density_kg_m3: 998.0, fluid_viscosity_pa_s: 0.001}
channel: {width_mm: 2.0, wall_mm: 2.0}
board:   {dots: [3, 3], spacing_mm: 0.4, dot_diameter_mm: 0.15, thickness_mm: 0.0, medium: air, polarity: bright}
volume:  {shape_xyz: [14, 10, 20], voxel_mm: 0.1, centre_mm: [0, 0, 0], reference: mid_plane}
reconstruction: {solver: em, iterations: 16, accelerate: true, particle_diameter_mm: 0.05}
correlation:    {windows: [6], overlap: 0.5, dt_s: 0.002}
simulation:
  flow: {kind: shear, along: x, across: z, rate_per_s: 30.0, velocity_m_s: [0.12, 0.0, 0.0]}
  particles: 80
  particle_diameter_mm: 0.05
  board_z_mm: 2.2
  rotation_deg: 0.3
  shift_px: [2.5, -1.5]
  frames: 6
  seed: 3
validation:
  flow: {kind: shear, along: x, across: z, rate_per_s: 30.0, velocity_m_s: [0.12, 0.0, 0.0]}
"""
SCENE = """scene:
  - {kind: cylinder, axis: x, radius_mm: 7.0, centre_mm: [0, 0, 0], behind: window}
  - {kind: cylinder, axis: x, radius_mm: 5.0, centre_mm: [0, 0, 0], behind: fluid}
"""
# What a person writes, by the name of the file: rigs for the weights of each kind, and points to ask a field at. The
# name of the first stands in every record, and has what not every format holds as it is.
BY_HAND = {
    "rig ü&.yaml": RIG,
    "plain.yaml": RIG.replace("mid_plane", "focal_point"),
    "counted.yaml": RIG.replace("[14, 10, 20]", "[3, 3, 3]")
    + "weights: {sampling: rays, points: 20, rays_per_point: 100}\n",
    "fluid_board.yaml": RIG.replace("medium: air", "medium: fluid"),
    "curved.yaml": re.sub("channel:.*\n", "", RIG).replace("mid_plane", "focal_point") + SCENE,
    "points.csv": "x,y,z\n0.1,0.0,0.2\n0.0,0.1,0.0\n",
}
PHOTOGRAPHS = "--white {white image} --dark {dark image}"
FRAMES = " ".join(f"{{simulated/frame_{number:04d}.tif}}" for number in range(6))
FOUND = " ".join(f"{{particles/frame_{number:04d}.vtkhdf}}" for number in range(6))
BOARDS = " ".join(f"--board {{boards/board_{depth}mm.tif}} --depth-mm {depth}" for depth in ("-0.6", "+0", "+0.6"))
# How the folders of files are written, a folder for each command: `{}` stands for it, names in braces for files.
STEPS = {
    "schema": "init --schema -o {}/rig.schema.json",
    "again": "init --from {calibration} -o {}/again.yaml",
    "white": "simulate white {rig} -o {}",
    "board": "simulate board {rig} -o {}",
    "boards": "simulate board {fluid_board.yaml} --depth-mm -0.6 --depth-mm 0 --depth-mm 0.6 -o {}",
    "simulated": "simulate particles {rig} -o {}",
    "calibration": f"calibrate-snapshot {{rig}} {PHOTOGRAPHS} --board {{board image}} -o {{}}/calibration.h5 "
    "--picture {}/calibration.png",
    "fitted": f"calibrate-snapshot {{fluid_board.yaml}} {PHOTOGRAPHS} {BOARDS} -o {{}}/fitted.h5",
    "refined": "refine-calibration {rig} {simulated/frame_0000.tif} {simulated/frame_0001.tif} "
    "--calibration {calibration} --dark {dark image} -o {}/refined.h5",
    "weights": "build-weights {rig} --calibration {calibration} -o {}/weights.h5",
    "plain": "build-weights {plain.yaml} -o {}/plain.h5",
    "on_demand": "build-weights {fluid_board.yaml} --calibration {fitted rays} --method dlfc -o {}/on_demand.h5",
    "counted": "build-weights {counted.yaml} --calibration {calibration} -o {}/counted.h5",
    "strips": "build-weights {curved.yaml} -o {}/strips.h5",
    "volumes": f"reconstruct {{weights}} {FRAMES} --dark {{dark image}} -o {{}}",
    "particles": f"reconstruct {{weights}} {FRAMES} --dark {{dark image}} --solver particles -o {{}}",
    "vectors": "correlate {first volume} {volume} --derived -o {}/vectors.vtkhdf",
    "mean": "correlate {volumes/frame_0000.vtkhdf} {volumes/frame_0001.vtkhdf} {volumes/frame_0002.vtkhdf} "
    "--pairing sequence --derived --mean {}/mean.vtkhdf -o {}/vectors",
    "statistics": "statistics {mean/vectors} -o {}/statistics.vtkhdf",
    "tracks": "track {first particles} {particles} --grid -o {}/tracks.vtkhdf",
    "sequence": f"track {FOUND} -o {{}}/sequence.vtkhdf",
    "combined": "combine {vectors} {tracks on a grid} -o {}/combined.vtkhdf",
    "field": "field {tracks} {vectors} --derived --at {points.csv} -o {}/field.vtkhdf",
    "followed": f"follow {{weights}} {FRAMES} --dark {{dark image}} -o {{}}",
    "pressure": "field {followed tracks} --pressure {followed/particles} -o {}/pressure.vtkhdf",
    "run": "run {rig} {simulated/frame_0000.tif} {simulated/frame_0001.tif} --white {white image} "
    "--dark {dark image} --board {board image} --method both -o {}",
    "judged": "validate flow {rig} --vectors {vectors} -o {}",
    "drawn": "plot {volume} -o {}/volume.pdf",
    "exported_volumes": "export {first volume} {volume} --to vtkhdf-series -o {}/volumes_series.vtkhdf",
    "exported": "export {vectors} --to netcdf -o {}/vectors.nc",
    "exported_mat": "export {tracks} --to mat -o {}/tracks.mat",
    "exported_csv": "export {tracks} --to csv -o {}/tracks.csv",
    "exported_text": "export {vectors} --to tecplot -o {}/vectors.dat",
    "exported_image": "export {vectors} --to vti -o {}/vectors.vti",
    "exported_points": "export {tracks} --to vtp -o {}/tracks.vtp",
}
# The kinds of files: where each lies, in the folder of the step that writes it.
KINDS = {
    "rig": "rig ü&.yaml",
    "rig by init": "again/again.yaml",
    "schema": "schema/rig.schema.json",
    "white image": "white/white.tif",
    "dark image": "white/dark.tif",
    "board image": "board/board.tif",
    "frame": "simulated/frame_0001.tif",
    "residual image": "particles/frame_0001_residual.tif",
    "truth": "simulated/particles.npz",
    "figures of truth": "simulated/particles.json",
    "calibration": "calibration/calibration.h5",
    "fitted rays": "fitted/fitted.h5",
    "refined calibration": "refined/refined.h5",
    "weights": "weights/weights.h5",
    "weights without calibration": "plain/plain.h5",
    "weights on demand": "on_demand/on_demand.h5",
    "counted weights": "counted/counted.h5",
    "weights in strips": "strips/strips.h5",
    "volume": "volumes/frame_0001.vtkhdf",
    "vectors": "vectors/vectors.vtkhdf",
    "mean vectors": "mean/mean.vtkhdf",
    "statistics": "statistics/statistics.vtkhdf",
    "tracks on a grid": "tracks/tracks_grid.vtkhdf",
    "combined vectors": "combined/combined.vtkhdf",
    "field": "field/field.vtkhdf",
    "field with pressure": "pressure/pressure.vtkhdf",
    "particles": "particles/frame_0001.vtkhdf",
    "followed particles": "followed/particles/frame_0001.vtkhdf",
    "tracks": "tracks/tracks.vtkhdf",
    "tracks of a sequence": "sequence/sequence.vtkhdf",
    "followed tracks": "followed/tracks.vtkhdf",
    "playback": "followed/playback.vtkhdf",
    "series": "exported_volumes/volumes_series.vtkhdf",
    "run.json": "run/run.json",
    "report": "run/report.html",
    "flow.json": "judged/flow.json",
    "picture": "calibration/calibration.png",
    "pages": "drawn/volume.pdf",
    "values at points": "field/field_at.csv",
    "NetCDF": "exported/vectors.nc",
    "MAT": "exported_mat/tracks.mat",
    "CSV": "exported_csv/tracks.csv",
    "Tecplot": "exported_text/vectors.dat",
    "VTK image": "exported_image/vectors.vti",
    "VTK points": "exported_points/tracks.vtp",
}
# Files that kinds are used together with.
OTHERS = {
    "first frame": "simulated/frame_0000.tif",
    "third frame": "simulated/frame_0002.tif",
    "first volume": "volumes/frame_0000.vtkhdf",
    "first particles": "particles/frame_0000.vtkhdf",
}


class WrittenFiles:
    """The files of a chain in a folder, each written when it is asked for."""

    def __init__(self, folder: Path) -> None:
        """Take an empty folder, and write into it what a person does."""
        self.folder = folder
        for name, text in BY_HAND.items():
            (folder / name).write_text(text)

    def path(self, name: str) -> Path:
        """Return the file of a kind, or at a place in the folder; the command that writes it is run once."""
        place = (KINDS | OTHERS).get(name, name)
        step = place.split("/")[0]
        if step in STEPS and not (self.folder / step).exists():
            words = self.words(STEPS[step], self.folder / f"{step}.part")
            (self.folder / f"{step}.part").mkdir()
            code, said = ended(*words, "-q")
            assert code == 0, (words, said)
            shutil.move(self.folder / f"{step}.part", self.folder / step)
        return self.folder / place

    def words(self, command: str, place: Path | str) -> list[str]:
        """Return the words of a command, with files in place of their names in braces, and `place` of `{}`."""

        def filled(word: re.Match[str]) -> str:
            return shlex.quote(str(self.path(word[1]) if word[1] else place))

        return shlex.split(re.sub(r"\{(.*?)\}", filled, command))
