"""`simulate particles` as a command: a sequence of frames."""

from __future__ import annotations

from pathlib import Path

import pytest

from lfpiv_cli.cli import cli
from lfpiv_cli.files.images import read_image
from lfpiv_cli.files.particles import read_particles

SAMPLE = Path(__file__).parent.parent / "configs" / "sample.yaml"


def particles_of(folder: Path, frames: int) -> tuple[float, float]:
    """Simulate the sample's flow with few rays; return where its tracers end along x."""
    rig = folder / f"rig_{frames}.yaml"
    few = f"simulation:\n  frames: {frames}\n  rays: 1\n"
    rig.write_text(SAMPLE.read_text().replace("simulation:\n", few).replace("rate_per_s: 30.0", "rate_per_s: 0.0"))
    output = folder / str(frames)
    cli.main(["simulate", "particles", str(rig), "-o", str(output)], standalone_mode=False)
    x = read_particles(output / "particles.npz").positions_mm[:, 0]
    return float(x.min()), float(x.max())


def test_tracers_of_a_sequence_are_there_before_they_are_carried_in(tmp_path: Path) -> None:
    pair, sequence = (particles_of(tmp_path, frames) for frames in (2, 6))
    # 0.12 m/s for four times 2 ms, half of it upstream; a few hundred tracers fill 5 mm to some 0.02 mm.
    assert sequence == pytest.approx((pair[0] - 0.48, pair[1] + 0.48), abs=0.1)
    names = sorted(path.name for path in (tmp_path / "6").glob("*.tif"))
    assert names == [f"frame_{number:04d}.tif" for number in range(6)]
    assert read_image(tmp_path / "6" / names[-1]).max() > read_image(tmp_path / "6" / names[-1]).min()
    assert sorted(path.name for path in (tmp_path / "2").glob("*.tif")) == ["pair_a.tif", "pair_b.tif"]
