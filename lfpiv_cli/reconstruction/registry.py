"""The solvers that `reconstruction.solver` can name: what each steps by, and what else differs between them.

To add one: write its step (see `reconstruction.solvers`), give it a line here, and test it. Nothing heavy is imported,
as `--help` shows the names; a step is imported when it is first used.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any, Literal


@dataclass(frozen=True)
class Solver:
    """A solver for volumes.

    Attributes
    ----------
    step_at : where its step stands, as module:function
    exponent : power of its volumes' intensities that is correlated where the configuration says none
    """

    step_at: str
    exponent: float = 1.0

    def step(self) -> Callable[..., Any]:
        """Return the step: a function of the problem, the volume, its projection and the relaxation."""
        module, _, name = self.step_at.partition(":")
        step: Callable[..., Any] = getattr(import_module(module), name)
        return step


# Of the root of their intensities EM's volumes gave a third less noise in depth, and a depth velocity with 0.94 of its
# slope in place of 0.81; MART's two fifths less noise.
SOLVERS = {
    "em": Solver("lfpiv_cli.reconstruction.solvers:em_step", exponent=0.5),
    "sart": Solver("lfpiv_cli.reconstruction.solvers:sart_step"),
    "smart": Solver("lfpiv_cli.reconstruction.solvers:smart_step", exponent=0.5),
    "mart": Solver("lfpiv_cli.reconstruction.solvers:mart_step", exponent=0.5),
}
# In place of a volume, particles fitted to the image (see the package `particles`).
PARTICLES = "particles"
SOLVER_NAMES = (*SOLVERS, PARTICLES)

if TYPE_CHECKING:
    SolverName = str
else:
    SolverName = Literal[SOLVER_NAMES]
