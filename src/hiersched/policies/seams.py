"""Seams of the slot loop that policies fill."""

from __future__ import annotations

from hiersched.core.seam import Seam

WEIGH = Seam(
    "weights of a policy",
    reads="constants; of state what the features take (`policies.features`)",
    writes="state.weight[env] (U,)",
)
