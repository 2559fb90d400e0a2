"""What results do of themselves in Python: tell what they are, draw, save and convert themselves.

Results of the core know nothing of files and pictures. How each kind does this stands in one table, `verbs.results`,
which the package names here before anything else is imported.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar


class Result:
    """What a step returns, or a reader opens."""

    # Gives the module that holds the table.
    ways: ClassVar[Callable[[], Any]]

    def __repr__(self) -> str:
        """Return what it is in two lines: its extent, units and medians."""
        return str(Result.ways().described(self))

    def save(self, path: Any, *, overwrite: bool = False) -> None:
        """Write the file that the command writes.

        Parameters
        ----------
        path : str or Path
            Where to.
        overwrite : bool, optional
            Whether a file that is there is replaced.

        Raises
        ------
        OutputExistsError, OutputError
            It is there already, or cannot be written.
        """
        Result.ways().save(self, path, overwrite)

    def plot(self, name: str | None = None) -> Any:
        """Draw one of the figures that `lfpiv plot` draws of its file.

        Parameters
        ----------
        name : str, optional
            Which, as `lfpiv plot --only` names it; the first one when not given.

        Returns
        -------
        matplotlib.figure.Figure

        Raises
        ------
        UsageError
            It has no such figure, or matplotlib is not installed.
        """
        return Result.ways().draw(self, name)


class ArrayResult(Result):
    """A result of arrays on a grid, or of points with their quantities."""

    def to_xarray(self) -> Any:
        """Return all arrays as an `xarray.Dataset`.

        Returns
        -------
        xarray.Dataset
            Over z, y, x (mm), or over `point`; a last axis of components is named. Each array has the attributes
            `units` and `long_name`; those of the whole are the file's.

        Raises
        ------
        UsageError
            xarray is not installed.
        """
        return Result.ways().as_dataset(self)

    def to_pandas(self) -> Any:
        """Return all arrays as a `pandas.DataFrame`.

        Returns
        -------
        pandas.DataFrame
            A row for each point, or place on the grid (x fastest), a column for each component. `attrs["units"]` has
            the columns' units, `attrs["long_name"]` what the arrays are, `attrs` besides what the file says of itself.

        Raises
        ------
        UsageError
            pandas is not installed.
        """
        return Result.ways().as_table(self)
