"""Numbers in human text as people write them."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import numpy as np
import pytest

from lfpiv_cli.console import readable
from lfpiv_cli.notice import written

PACKAGE = Path(__file__).parents[1] / "lfpiv_cli"
# What becomes part of a file's name, or a number again.
NOT_FOR_PEOPLE = {"paper/sensitivities.py", "pictures/vectors.py"}
TABLE = [
    (0.0, 3, "0"),
    (-0.0, 3, "0"),
    (110.0, 2, "110"),
    (5e5, 2, "500000"),
    (2345.0, 2, "2300"),
    (99999.5, 3, "100000"),
    (999999.0, 3, "1 million"),
    (1.25e7, 3, "12.5 million"),
    (-6.4e10, 2, "-64 billion"),
    (2.5e12, 2, "2.5 trillion"),
    (3.2e15, 2, "3.2 x 10^15"),
    (0.5, 3, "0.5"),
    (0.05004, 3, "0.05"),
    (1.23e-5, 3, "0.0000123"),
    (-2e-5, 2, "-0.00002"),
    (4.56e-9, 2, "4.6 x 10^-9"),
    (9.999, 3, "10"),
    (1.5, 6, "1.5"),
    (74915.7, 6, "74915.7"),
    (1.0, 1, "1"),
    (np.inf, 3, "inf"),
    (np.nan, 3, "nan"),
]


@pytest.mark.parametrize(("value", "digits", "text"), TABLE)
def test_numbers_are_written_as_people_do(value: float, digits: int, text: str) -> None:
    assert written(value, digits) == text
    assert written(np.float32(value), digits) == text
    assert readable([value, value], digits) == f"{text}, {text}"


def test_numbers_of_usual_size_are_as_python_writes_them() -> None:
    for value in 10.0 ** np.linspace(-4.0, 2.99, 100):
        assert written(value) == f"{value:.3g}"
        assert written(-value) == f"{-value:.3g}"


def test_no_text_has_numbers_that_computers_write() -> None:
    # With few digits Python writes 110 as 1.1e+02, and with a fixed number of decimals -0.0001 as -0.000.
    found = [
        f"{name}: {ast.unparse(node)}"
        for module in sorted(PACKAGE.rglob("*.py"))
        if (name := module.relative_to(PACKAGE).as_posix()) not in NOT_FOR_PEOPLE
        for node in ast.walk(ast.parse(module.read_text(encoding="utf-8")))
        if isinstance(node, ast.FormattedValue)
        and node.format_spec is not None
        and re.search(r"\.\dg'$", ast.unparse(node.format_spec))
    ]
    assert not found
