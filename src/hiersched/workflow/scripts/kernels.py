"""Compile the slot loop; the machine code stays in the cache of the package."""

import argparse
import time
from pathlib import Path

from hiersched.core.files import write_bytes
from hiersched.experiments.kernels import compile_kernels
from hiersched.experiments.turns import join_run

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--output", type=Path, required=True)
    output = parser.parse_args().output
    join_run(Path(".snakemake"))
    began = time.perf_counter()
    compile_kernels()
    write_bytes(output, f"{time.perf_counter() - began:.1f} s\n".encode())
