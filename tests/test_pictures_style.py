"""The one style of all figures."""

from __future__ import annotations

import numpy as np
import pytest

from lfpiv_cli.pictures.style import COLOURS, MARKERS, SETTINGS, new_figure, styled, symmetric_limit

matplotlib = pytest.importorskip("matplotlib")


def test_the_style_holds_within_and_leaves_the_callers_settings() -> None:
    @styled
    def draw():
        figure = new_figure(3.0, 2.0)
        axis = figure.subplots()
        lines = [axis.plot([0, 1], [k, k])[0] for k in range(2)]
        return figure, axis, lines

    with matplotlib.rc_context({"axes.titlesize": 33.0, "font.size": 44.0, "lines.linewidth": 7.0, "axes.grid": True}):
        figure, axis, lines = draw()
        assert matplotlib.rcParams["font.size"] == 44.0
    assert axis.title.get_fontsize() == SETTINGS["axes.titlesize"]
    assert [line.get_color() for line in lines] == list(COLOURS[:2])
    assert lines[0].get_linewidth() == SETTINGS["lines.linewidth"]
    assert not axis.xaxis.get_gridlines()[0].get_visible()
    assert tuple(figure.get_size_inches()) == (3.0, 2.0)


def test_every_colour_has_a_marker_of_its_own() -> None:
    assert len(set(MARKERS)) == len(set(COLOURS)) == len(COLOURS) == len(MARKERS)


def test_a_scale_about_zero_reaches_the_largest_known_size() -> None:
    assert symmetric_limit([1.0, -3.0, np.nan], np.array([[2.0, np.inf]])) == 3.0
    assert symmetric_limit([0.0, np.nan]) == symmetric_limit() == 1.0
