from __future__ import annotations

import pytest

from hiersched.scenario import load_scenario


@pytest.fixture(scope="session")
def config(project_root):
    return project_root / "src/hiersched/config"


@pytest.fixture
def load_text(tmp_path, config):
    """Load an overlay given as text; its path is `load_text.path`."""

    def load(text):
        load.path.write_text(text, encoding="utf-8")
        return load_scenario(load.path, defaults=config / "defaults.yaml")

    load.path = tmp_path / "case.yaml"
    return load
