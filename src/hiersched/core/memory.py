"""What the machine has to hold arrays in."""

from __future__ import annotations

import os


def physical_memory_bytes() -> int:
    """Return the memory of this machine [bytes]."""
    return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
