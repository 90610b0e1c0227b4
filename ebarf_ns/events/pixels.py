"""Hot and dead pixels, found by comparing each pixel with its neighbours.

Moving edges pass over neighbouring pixels alike. So a pixel with several times the events of its neighbours is hot,
however busy the rest of the sensor is, and one without events among active ones is dead.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Bool, Int64

_REACH = 2
_HOT_FACTOR, _NEVER_HOT = 3, 20
_BUSY, _LEAST_ACTIVE = 5, 0.2


def hot_pixels(counts: Int64[np.ndarray, "pixels"], width: int) -> Bool[np.ndarray, "pixels"]:
    """Pixels with more than 3 times the events of the second busiest of their 24 neighbours, plus 20.

    The second busiest, so that two adjacent hot pixels do not hide each other. An edge along a row of pixels has busy
    neighbours in that row.
    """
    if len(counts) < 3:
        return np.zeros(len(counts), bool)
    return counts > _HOT_FACTOR * _second_busiest(counts, width) + _NEVER_HOT


def dead_pixels(counts: Int64[np.ndarray, "pixels"], width: int) -> Bool[np.ndarray, "pixels"]:
    """Pixels without events, surrounded by pixels with 5 or more, or in a dead block of columns or rows.

    Some sensors lack event pixels along a border. Such a block ends at a line that is as active as the others over its
    whole length. A blank wall or sky does not.
    """
    silent = counts == 0
    alone = silent & (-_second_busiest(-counts, width) >= _BUSY)
    active = ~silent.reshape(-1, width)
    lines = _dead_lines(active.mean(axis=0))[None, :] | _dead_lines(active.mean(axis=1))[:, None]
    return alone | lines.ravel()


def _dead_lines(active_share: np.ndarray) -> np.ndarray:
    """Lines of silent pixels between a border and a line more than half as active as usual."""
    found = np.zeros(len(active_share), bool)
    somewhere = np.nonzero(active_share)[0]
    if not len(somewhere):
        return found
    usual = np.median(active_share[somewhere])
    first, last = somewhere[[0, -1]]
    if usual < _LEAST_ACTIVE:
        return found
    if active_share[first] > usual / 2:
        found[:first] = True
    if active_share[last] > usual / 2:
        found[last + 1 :] = True
    return found


def _second_busiest(counts: np.ndarray, width: int) -> np.ndarray:
    """The second largest count among the neighbours of each pixel, with mirrored borders."""
    picture = counts.reshape(-1, width)
    reach = [min(_REACH, side - 1) for side in picture.shape]
    padded = np.pad(picture, [(side, side) for side in reach], mode="reflect")
    most = second = np.full(picture.shape, np.iinfo(counts.dtype).min)
    for down in range(2 * reach[0] + 1):
        for right in range(2 * reach[1] + 1):
            if (down, right) != tuple(reach):
                one = padded[down : down + picture.shape[0], right : right + picture.shape[1]]
                most, second = np.maximum(most, one), np.maximum(second, np.minimum(most, one))
    return second.ravel()
