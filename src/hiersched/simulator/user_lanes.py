"""Users side by side: the fields of a block of them in one flat array (see `models.queue.fifo`)."""

from __future__ import annotations

from hiersched.models.queue.fifo import LANES

(
    RATE,
    OFFERED,
    SENSITIVITY,
    PACKETS,
    OFFSET,
    MEAN_DUE,
    CLAMPED,
    AVERAGE,
    DELAY,
    DRIFT,
    PENALTY,
    SURPLUS,
    NUM_USER_LANES,
) = (LANES * place for place in range(13))
