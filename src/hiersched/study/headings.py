"""Names of columns as people read them: words and a unit."""

from __future__ import annotations

_UNITS = {
    "mbps": "Mbit/s",
    "packets": "packets",
    "samples": "samples",
    "steps": "samples",
    "per_s": "1/s",
    "cm": "cm",
    "rad": "rad",
    "ms": "ms",
    "m": "m",
    "s": "s",
}
"""End of a name, behind an underscore -> unit."""
_UNIT_OF = {"mean_square_backlog": "packets²", "penalty_cost": "packets²"}
"""Names without a unit at their end -> unit."""
_QUALIFIERS = ("_median", "_minus_own")
"""Ends behind a unit."""
_WORDS = {
    "urllc": "URLLC",
    "embb": "eMBB",
    "pf": "PF",
    "drl": "DRL",
    "rms": "RMS",
    "std": "standard deviation",
    "p": "p-value",
    "p50": "50 % quantile",
    "p95": "95 % quantile",
    "p99": "99 % quantile",
    "p999": "99.9 % quantile",
    "max": "greatest",
    "lo": "from",
    "hi": "up to",
}


def heading(name: str) -> str:
    """Return the name of a column as words with its unit.

    ``urllc_rate_mbps`` is URLLC rate [Mbit/s]; a ratio, ``tracking_error_cm_over_own``, has none.
    """
    qualifier = next((end for end in _QUALIFIERS if name.endswith(end)), "")
    parts = name.removesuffix(qualifier).split("_over_")
    unit = _UNIT_OF.get(parts[0], "")
    for place, part in enumerate(parts):
        end = next((end for end in _UNITS if part.endswith(f"_{end}")), "")
        parts[place] = part.removesuffix(f"_{end}") if end else part
        unit = _UNITS.get(end, unit)
    spoken = f"{'_over_'.join(parts)}{qualifier}".split("_")
    words = " ".join(_WORDS.get(word, word) for word in spoken if word)
    if not words.startswith("eMBB"):
        words = words[:1].upper() + words[1:]
    return f"{words} [{unit}]" if unit and len(parts) == 1 else words
