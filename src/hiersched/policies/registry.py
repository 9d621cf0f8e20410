"""Schedulers with keys of their own, by the name that a scenario gives as `model`."""

from __future__ import annotations

from hiersched.models.model import Model, Section


class Rule(Model):
    """A scheduler whose kernel is compiled; its `faults` do not name its own place."""


RULES = Section("policies.*", Rule)
