"""Compile the slot loop; the machine code stays in the cache of the package."""

import argparse
import os
import time
from pathlib import Path

from hiersched.runs.kernels import compile_kernels


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--output", type=Path, required=True)
    args = parser.parse_args()
    began = time.perf_counter()
    compile_kernels()
    part = args.output.with_name(args.output.name + ".part")
    part.write_text(f"{time.perf_counter() - began:.1f} s\n", encoding="utf-8")
    os.replace(part, args.output)


if __name__ == "__main__":
    main()
