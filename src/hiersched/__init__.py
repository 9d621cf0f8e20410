"""A reproducible laboratory for 5G teleoperation: slicing, delay-robust control, learning and logs."""

from importlib.metadata import version

__version__ = version("hiersched")
