"""Pixels that are broken, told from their neighbours: those that fire without a cause, and those that never do.

What moves across the sensor passes over neighbouring pixels alike, so that a pixel which has several times the events
of those around it is hot however busy the rest of the sensor is, and one without events amid busy ones is dead.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import rank_filter

if TYPE_CHECKING:
    from jaxtyping import Bool, Int64

_SIDE = 5
_HOT_FACTOR, _NEVER_HOT = 3, 20
_BUSY = 5


def hot_pixels(counts: Int64[np.ndarray, "pixels"], width: int) -> Bool[np.ndarray, "pixels"]:
    """Pixels with over 3 times the events of the third busiest of the 24 around them, and 20 more.

    The third, so that a pair of hot pixels does not excuse each other. An edge that runs along a row of pixels has
    busy neighbours in that row.
    """
    return counts > _HOT_FACTOR * _of_neighbours(counts, width, -3) + _NEVER_HOT


def dead_pixels(counts: Int64[np.ndarray, "pixels"], width: int) -> Bool[np.ndarray, "pixels"]:
    """Pixels without any event, in the middle of pixels with 5 or more, or in a column or row that is dead throughout.

    A column or row is dead where it has no event while a tenth of the sensor's pixels have 5 or more, and it reaches
    from border to border: sensors with an unequal number of event and frame pixels have such blocks.
    """
    silent = counts == 0
    alone = silent & (_of_neighbours(counts, width, 2) >= _BUSY)
    picture = silent.reshape(-1, width)
    if np.mean(counts >= _BUSY) < 0.1:
        return alone
    lines = picture.all(axis=0)[None, :] | picture.all(axis=1)[:, None]
    return alone | (lines & picture).ravel()


def _of_neighbours(counts: np.ndarray, width: int, rank: int) -> np.ndarray:
    """The count at ``rank`` among the neighbours of each pixel."""
    picture = counts.reshape(-1, width)
    size = tuple(min(_SIDE, side) for side in picture.shape)
    around = np.ones(size, bool)
    around[size[0] // 2, size[1] // 2] = False
    if around.sum() < abs(rank):
        return counts
    return rank_filter(picture, rank, footprint=around, mode="mirror").ravel()
