"""A small study through Snakemake: swept keys that no code knows, and parts that are left out."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from hiersched.experiments import files
from hiersched.log import LogReader
from hiersched.scenario import load_scenario
from hiersched.study.built_in import shown
from hiersched.study.page import write_study_page
from hiersched.study.registry import CLAIMS, FIGURES, TABLES
from hiersched.study.show import show

AXES = {
    "traffic.packet_bits": ["10000.0", "20000.0"],
    "loss": ["none", "my_power_law-exponent-3"],
    "both": ["2_1", "2_2", "3_1", "3_2"],
}
"""Axis -> its values as the table shows them."""


@pytest.fixture
def sweeps(finished: Path) -> pd.DataFrame:
    return pd.read_csv(finished / "tables/sweeps.csv", dtype={"value": str})


@pytest.mark.nightly
def test_every_point_of_every_axis_is_a_row(sweeps: pd.DataFrame) -> None:
    assert list(dict.fromkeys(sweeps["axis"])) == list(AXES)
    for axis, values in AXES.items():
        own = sweeps[sweeps["axis"] == axis]
        policies = ["pf"] if axis == "both" else ["pf", "edf"]
        found = list(zip(own["policy"], own["value"], strict=True))
        assert found == [(policy, value) for policy in policies for value in values]
    assert (sweeps["seeds"] == 2).all()


@pytest.mark.nightly
def test_rows_show_what_the_swept_key_does(sweeps: pd.DataFrame) -> None:
    """Without loss rates are higher; the same loss twice is the same; eMBB users take PRBs."""
    pf = sweeps[sweeps["policy"] == "pf"].set_index(["axis", "value"])["urllc_rate_mbps"]
    assert pf["loss"]["none"] > pf["both"]["2_2"] > pf["both"]["3_2"]
    assert pf["loss"]["my_power_law-exponent-3"] == pf["both"]["3_2"]
    assert pf["both"]["3_1"] > pf["both"]["3_2"]
    late = sweeps[sweeps["policy"] == "edf"].set_index(["axis", "value"])["urllc_late_share"]
    bits = late["traffic.packet_bits"]
    assert bits["10000.0"] != bits["20000.0"]


@pytest.mark.nightly
def test_logs_of_points_carry_the_scenario_of_their_point(finished: Path) -> None:
    for point, exponent in (("loss/my_power_law-exponent-3", 3.0), ("both/2_1", 2.0)):
        with LogReader(finished / f"runs/{point}/pf/seed21.mcap") as log:
            text = log.attachments["scenario.yaml"].decode()
        assert f"exponent: {exponent}" in text
    with LogReader(finished / "runs/both/2_2/pf/seed22.mcap") as log:
        assert (log.metadata["axis"], log.metadata["value"]) == ("both", "2_2")
        assert log.dims.num_embb == 2


@pytest.mark.nightly
def test_a_table_of_a_plugin_is_made(finished: Path) -> None:
    table = pd.read_csv(finished / "tables/mine.csv")
    assert list(table["policy"]) == ["edf", "pf"]
    assert "Mine." in (finished / "tables/mine.md").read_text(encoding="utf-8")


@pytest.mark.nightly
def test_the_report_shows_tables_to_read(finished: Path, study: Path, snakemake: Any) -> None:
    """Not the files to compute with; under their titles, with a caption that is no markup."""
    wanted = [f"results/mine/tables/{name}.html" for name in ("sweeps", "mine")]
    done = snakemake(study, "--report", "snakemake.html", *wanted, scenario="mine.yaml")
    said = done.stdout + done.stderr
    assert done.returncode == 0, said
    for name in ("sweeps", "mine"):
        assert f"Adding {name}.html" in said
        assert f"Adding {name}.csv" not in said
    assert "WARNING" not in said  # of a caption that is no reStructuredText
    text = (study / "snakemake.html").read_text(encoding="utf-8")
    assert "Sweeps: one axis varied at a time" in text
    assert (finished / "tables/sweeps.html").exists()


@pytest.mark.nightly
def test_a_study_without_learners_and_gains_shows_all_it_plans(
    finished: Path, study: Path, tmp_path: Path
) -> None:
    scenario = load_scenario(study / "mine.yaml")
    for path in finished.iterdir():
        if path.name not in ("tables", "figures", "claims", files.PAGE):
            (tmp_path / path.name).symlink_to(path)
    for kind, registry in (("table", TABLES), ("figure", FIGURES), ("claim", CLAIMS)):
        for name, thing in shown(registry, scenario).items():
            show(scenario, tmp_path, kind, name, thing.module)
    tables = {path.stem for path in (tmp_path / "tables").glob("*.csv")}
    assert tables == set(shown(TABLES, scenario)) > {"policies", "sweeps", "runs", "mine"}
    figures = {path.stem for path in (tmp_path / "figures").glob("*.svg")}
    assert figures == set(shown(FIGURES, scenario)) > {"fig4_rate_cdf", "mine"}
    page = write_study_page(scenario, tmp_path).read_text(encoding="utf-8")
    assert all(f'id="figure-{name}"' in page for name in figures)
    assert "Mine." in page


WITHOUT = {
    "learners": (
        "learners: {}\nevaluate: {policies: [pf, edf]}\nsweeps: {policies: [pf]}\n"
        "generalise: {policies: [pf]}\ntask_study: {policies: []}",
        (
            *("train_", "measure_ddpg", "evaluate_ddpg", "measure_es", "task_hold_es"),
            *("fig2", "fig3", "figX_learn"),
        ),
    ),
    "gains": ("gain_study: {methods: []}", ("gain_", "stability", "measure_gains", "figX_gain")),
    "cells": ("generalise: {cells: []}", ("generalise", "table_generalisation", "figX_general")),
    "bound": ("bound: {slots_per_log: 0}", ("bound", "table_bound", "figure_figX_bound")),
}
"""Part of a study -> how to leave it out, and the beginnings of its jobs."""


@pytest.mark.nightly
def test_parts_that_are_left_out_plan_no_jobs(
    tmp_path: Path, snakemake: Callable[..., Any], planned: Callable[[Any], set[str]]
) -> None:
    """One dry run over four studies, each without one part."""
    for part, (text, _) in WITHOUT.items():
        path = tmp_path / f"no_{part}.yaml"
        path.write_text(f"extends: smoke\n{text}\n", encoding="utf-8")
    names = ",".join(f"no_{part}.yaml" for part in WITHOUT)
    jobs = planned(snakemake(tmp_path, "-n", scenario=names))
    own = {
        part: {job.removesuffix(f"_no_{part}") for job in jobs if job.endswith(f"_no_{part}")}
        for part in WITHOUT
    }
    every = set().union(*own.values())
    for part, (_, beginnings) in WITHOUT.items():
        for beginning in beginnings:
            of_part = {job for job in every if job.removeprefix("figure_").startswith(beginning)}
            of_part |= {job for job in every if job.startswith(beginning)}
            assert of_part, beginning
            assert not of_part & own[part], (part, of_part & own[part])
        assert {"evaluate_classical", "load_classical", "measure_classical"} <= own[part]
        assert {"table_policies", "table_sweeps", "resolve", "gains_schedule"} <= own[part]
    assert {"train_ddpg", "train_frozen", "bound", "gain_study_gains"} <= own["cells"]
