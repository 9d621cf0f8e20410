"""Options that several commands have."""

from __future__ import annotations

import argparse


def add_overwrite(parser: argparse.ArgumentParser) -> None:
    """Add the option without which no file is overwritten."""
    text = "replace files that are there already"
    parser.add_argument("--overwrite", action="store_true", help=text)
