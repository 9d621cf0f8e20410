"""Colours of users and slices: the same in viewers, on pages and in pictures of environments."""

from __future__ import annotations

import colorsys

import numpy as np
from numpy.typing import NDArray

SLICE_COLOURS: NDArray[np.uint8] = np.array([(240, 150, 40), (70, 150, 240)], np.uint8)
"""Of URLLC and eMBB, where something is of a whole slice."""


def user_colours(num_urllc: int, num_embb: int) -> NDArray[np.uint8]:
    """One colour a user, shape (U, 3): URLLC from red to yellow, eMBB from green-blue to violet.

    Neighbours differ in lightness, and all can be seen on black.
    """
    hues = [
        (start + width * (i + 0.5) / count, dark + 0.17 * (i % 2))
        for start, width, dark, count in ((0.0, 0.16, 0.5, num_urllc), (0.47, 0.3, 0.58, num_embb))
        for i in range(count)
    ]
    rgb = [colorsys.hls_to_rgb(hue, lightness, 0.85) for hue, lightness in hues]
    return np.round(255 * np.array(rgb)).astype(np.uint8).reshape(-1, 3)
