"""A reproducible laboratory for 5G teleoperation: slicing, robust control, learning, logs."""

from importlib.metadata import version

__version__ = version("hiersched")
