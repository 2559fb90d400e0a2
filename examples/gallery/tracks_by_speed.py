"""Tracks in space, coloured by speed.

Every result has the figures that `lfpiv plot` draws of its file; `space` is one of those of tracks. It is a plain
matplotlib figure: turn it, crop it, put it beside another one.
"""

import lfpiv_cli as lf

tracks = lf.open_tracks("tracks.vtkhdf")
print(tracks)
figure = tracks.plot("space")
figure.axes[0].view_init(elev=20, azim=-60)
figure.savefig("tracks_by_speed.png", dpi=100)
