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
_OF_MEASURES = {"mean_square_backlog": "packets²", "penalty_cost": "packets²"}
"""Names without a unit at their end -> unit."""
_RATIOS = ("_over_", "ratio", "share")
"""What marks numbers without a unit."""
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
    """Return the name of a column as words with its unit: ``urllc_rate_mbps`` is URLLC rate."""
    rest, qualifier = name, ""
    for end in _QUALIFIERS:
        if name.endswith(end):
            rest, qualifier = name.removesuffix(end), end
    unit = "" if any(mark in rest for mark in _RATIOS) else _OF_MEASURES.get(rest, "")
    for end, text in _UNITS.items():
        if rest.endswith(f"_{end}") and not any(mark in rest for mark in ("_over_", "ratio")):
            rest, unit = rest.removesuffix(f"_{end}"), text
            break
    words = " ".join(_WORDS.get(word, word) for word in f"{rest}{qualifier}".split("_") if word)
    words = words[:1].upper() + words[1:] if not words.startswith("eMBB") else words
    return f"{words} [{unit}]" if unit else words
