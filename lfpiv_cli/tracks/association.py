"""The probability of each link where a particle has one partner at most: exclusive choices, by belief propagation.

After Williams and Lau, *Approximate evaluation of marginal association probabilities with belief propagation*, IEEE
Trans. Aerosp. Electron. Syst. 50 (2014): messages between the particles of two frames along the pairs that are
possible, exact where these form no loops and near it where they do.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# Messages settle in some ten rounds; a change of this size is none.
MOST_ROUNDS = 200
SETTLED = 1e-6


def marginals(
    first: NDArray[np.int64], second: NDArray[np.int64], odds: NDArray[np.float64], sizes: tuple[int, int]
) -> NDArray[np.float64]:
    """Return the probability of each pair (c,).

    Parameters
    ----------
    first, second : (c,) numbers of the particles in the two frames
    odds : (c,) of the pair being one against both having no partner
    sizes : how many particles the frames have
    """
    back = np.ones(len(odds))
    for _ in range(MOST_ROUNDS):
        offered = odds * back
        forth = odds / (1.0 + np.bincount(first, offered, sizes[0])[first] - offered)
        earlier, back = back, 1.0 / (1.0 + np.bincount(second, forth, sizes[1])[second] - forth)
        if not len(odds) or np.abs(back - earlier).max() < SETTLED:
            break
    offered = odds * back
    return np.asarray(offered / (1.0 + np.bincount(first, offered, sizes[0])[first]))
