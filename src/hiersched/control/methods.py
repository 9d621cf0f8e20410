"""Names of the ways to choose a gain, and of what came of it."""

from __future__ import annotations

from typing import Literal

Method = Literal["krasovskii", "razumikhin", "predictor", "latency_compensated", "h2"]
"""C3, C1 (certified by design); state prediction, K (A - B K)^T, H2-optimal (tried afterwards)."""

CERTIFYING: tuple[Method, ...] = ("krasovskii", "razumikhin")
"""Methods that put no gain into force but one that is certified, or the nominal one."""

Status = Literal["nominal", "adjusted", "uncertified", "infeasible"]
"""The nominal gain, certified; another one, certified; another one that no certificate covers; the
nominal gain for want of a better one, not certified."""

DEFAULT_DECAY_RATE = 0.02
"""Decay of V per sample that C1 certifies where nothing else is asked."""
