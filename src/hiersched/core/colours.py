"""The colour of a user: the same in viewers and in pictures of environments."""

from __future__ import annotations

import colorsys

import numpy as np
from numpy.typing import NDArray


def user_colours(num_urllc: int, num_embb: int) -> NDArray[np.uint8]:
    """One colour a user, shape (U, 3): URLLC from red to yellow, eMBB from cyan to blue."""
    hues = [
        start + width * (i + 0.5) / count
        for start, width, count in ((0.0, 0.17, num_urllc), (0.5, 0.2, num_embb))
        for i in range(count)
    ]
    value = [0.65 + 0.35 * (i % 2) for i in range(len(hues))]
    rgb = [colorsys.hsv_to_rgb(hue, 0.85, v) for hue, v in zip(hues, value, strict=True)]
    return np.round(255 * np.array(rgb)).astype(np.uint8).reshape(-1, 3)
