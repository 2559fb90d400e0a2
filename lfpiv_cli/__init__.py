"""lfpiv: from raw light-field camera images to three-dimensional velocity fields.

`open_weights`, `open_volume` and `open_vectors` read the files that the commands write.
"""

from __future__ import annotations

from typing import Any

__version__ = "0.1.0"
__all__ = ["__version__", "open_vectors", "open_volume", "open_weights"]


def __getattr__(name: str) -> Any:
    """Import the readers when they are asked for, so that `lfpiv --help` need not wait for them."""
    if name == "open_weights":
        from lfpiv_cli.files.weights_file import open_weights

        return open_weights
    if name in ("open_volume", "open_vectors"):
        from lfpiv_cli.files import vtkhdf

        return getattr(vtkhdf, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
