"""The models that are built in: importing this module registers them."""

from hiersched.models.channel import block_rayleigh, path_loss, rayleigh, truth
from hiersched.models.link import shannon
from hiersched.models.plant import linear, unicycle
from hiersched.models.queue import fifo
from hiersched.models.traffic import poisson

__all__ = [
    "path_loss",
    "rayleigh",
    "block_rayleigh",
    "truth",
    "shannon",
    "poisson",
    "fifo",
    "unicycle",
    "linear",
]
