"""Work shared out to threads: every item once, in order, and no error lost."""

from __future__ import annotations

from time import sleep

import numpy as np
import pytest
from numpy.typing import NDArray

from lfpiv_cli.threads import blocks, in_threads, share_out


@pytest.mark.parametrize(
    ("count", "expected"), [(0, [(0, 0)]), (1, [(0, 1)]), (4, [(0, 2), (2, 4)]), (5, [(0, 2), (2, 4), (4, 5)])]
)
def test_blocks_hold_every_item_once(count: int, expected: list[tuple[int, int]]) -> None:
    assert [(block.start, block.stop) for block in blocks(count, 2)] == expected


def test_results_are_in_order_and_errors_come_through() -> None:
    assert in_threads(lambda k: 10 // k, [1, 2, 5]) == [10, 5, 2]
    with pytest.raises(ZeroDivisionError):
        in_threads(lambda k: 10 // k, [1, 0, 5])


@pytest.mark.parametrize("count", [0, 1, 2, 100])
def test_every_piece_of_work_is_shared_out_once(count: int) -> None:
    done = np.zeros(count)

    def work(part: tuple[int, int], much: float, onto: NDArray[np.float64]) -> None:
        onto[part[0] : part[1]] += much

    share_out(work, count, 2.0, done)
    assert done.tolist() == [2.0] * count


def test_nothing_more_is_begun_after_an_error() -> None:
    begun = []

    def work(piece: int) -> None:
        begun.append(piece)
        sleep(1e-3)
        if piece == 0:
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        in_threads(work, range(50))
    assert len(begun) < 25


def test_loops_within_loops_end() -> None:
    sums = in_threads(lambda row: sum(in_threads(lambda k: row * k, range(5))), range(5))
    assert sums == [10 * row for row in range(5)]
