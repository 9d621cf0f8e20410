"""The two agents and how they learn (torch is used in this package only)."""

from hiersched.core.extras import naming_extras

with naming_extras():
    import torch as torch
