"""Our files, read by the MCAP project's TypeScript library."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

from hiersched.log import log_digest

FOLDER = Path(__file__).with_name("node")


@pytest.mark.parametrize("compression", ["zstd", "none"])
def test_mcap_core_reads_every_message(
    tmp_path: Path, random_fields: Any, write_log: Any, compression: str
) -> None:
    node = shutil.which("node")
    # Elsewhere than beside the script, if HIERSCHED_NODE says where `npm install` was run.
    modules = Path(os.environ.get("HIERSCHED_NODE", FOLDER)) / "node_modules"
    if node is None or not (modules / "@mcap/core").exists():
        pytest.skip(f"needs node and @mcap/core: npm install in {FOLDER.name}/ beside this test")
    path = write_log(tmp_path / "a.mcap", random_fields(100), compression=compression)
    shutil.copy(FOLDER / "digest.mjs", tmp_path)
    (tmp_path / "node_modules").symlink_to(modules.resolve())
    result = subprocess.run(
        [node, str(tmp_path / "digest.mjs"), str(path)], capture_output=True, text=True, check=True
    )
    found = json.loads(result.stdout)
    assert found["digest"] == log_digest(path)
    assert found["metadata"]["hiersched"]["policy"] == "pf"
    assert found["attachments"] == ["hiersched.proto", "policy.pt", "scenario.yaml"]
