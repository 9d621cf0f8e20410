"""One table of many studies: what stands in it, what is named instead, what is refused."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable
from pathlib import Path

import pandas as pd
import pytest

from hiersched.cli import main
from hiersched.core.faults import InputError
from hiersched.scenario import load_scenario, scenario_to_yaml, with_values
from hiersched.study.across import table_across

MakeStudy = Callable[..., Path]
LATE = "urllc_late_share"


@pytest.fixture
def make_study(tmp_path: Path) -> MakeStudy:
    """Write what a study with these values leaves: PF late with `late`, EDF with a quarter."""
    smoke = load_scenario("smoke")

    def make(name: str, late: float = 0.2, verdict: str = "", **values: object) -> Path:
        given = {key.replace("__", "."): value for key, value in values.items()}
        text = scenario_to_yaml(with_values(smoke, given, "test"))
        folder = tmp_path / "results" / name
        (folder / "tables").mkdir(parents=True)
        text = text.replace("name: smoke\n", f"name: {name}\n", 1)
        (folder / "scenario.yaml").write_text(text, encoding="utf-8")
        rows = [f"pf,2,0,{late},{late / 2},{late * 2},7.25", f"edf,2,0,{late / 4},0.01,,7.5"]
        head = f"policy,seeds,training_seeds,{LATE},{LATE}_lo,{LATE}_hi,{LATE}_median"
        lines = [head, *rows, ""]
        (folder / "tables/policies.csv").write_text("\n".join(lines), encoding="utf-8")
        if verdict:
            claims = {"claims": [{"number": 10, "verdict": verdict}]}
            (folder / "claims.json").write_text(json.dumps(claims), encoding="utf-8")
        return folder

    return make


def test_rows_are_studies_times_policies_beside_the_keys_that_differ(
    make_study: MakeStudy,
) -> None:
    """Numbers are the studies' own, to the last bit; a key that is the same everywhere is none."""
    third = 0.1 + 0.2  # 0.30000000000000004
    folders = [
        make_study("a", third, radio__num_prb=10, traffic__load_ratio=None),
        make_study("b", 0.2, radio__num_prb=20, traffic__load_ratio=0.7),
        make_study("c", 0.1, radio__num_prb=20, traffic__reliability_levels=[0.9]),
    ]
    across = table_across(folders)
    assert across.keys == ["radio.num_prb", "traffic.load_ratio", "traffic.reliability_levels"]
    table = across.table
    assert list(table["scenario"]) == ["a", "a", "b", "b", "c", "c"]
    assert list(table["policy"]) == ["pf", "edf"] * 3
    assert list(table["radio.num_prb"]) == [10, 10, 20, 20, 20, 20]
    assert table["radio.num_prb"].dtype.kind == "i"
    assert list(table["traffic.load_ratio"].isna()) == [True, True, False, False, True, True]
    assert table["traffic.load_ratio"][2] == 0.7
    assert table["traffic.reliability_levels"][4] == "[0.9]"
    assert list(table[LATE]) == [third, third / 4, 0.2, 0.05, 0.1, 0.025]
    assert pd.isna(table[f"{LATE}_hi"][1])
    assert (across.left_out, across.remarks, across.studies) == ({}, {}, 3)


def test_policies_measures_keys_and_verdicts(make_study: MakeStudy) -> None:
    folders = [
        make_study("a", verdict="reproduced", radio__num_prb=10),
        make_study("b", verdict="depends", radio__num_prb=20, traffic__load=0.9),
    ]
    wanted = {"policies": ["edf"], "measures": [LATE], "keys": ["traffic.load", "users.num_urllc"]}
    table = table_across(folders, verdicts=True, **wanted).table
    about = ["scenario", "traffic.load", "users.num_urllc", "claim10", "policy"]
    counts = ["seeds", "training_seeds"]
    assert list(table.columns) == [*about, *counts, LATE, f"{LATE}_lo", f"{LATE}_hi"]
    assert table[about].to_numpy().tolist() == [
        ["a", 0.95, 4, "reproduced", "edf"],
        ["b", 0.9, 4, "depends", "edf"],
    ]


def test_a_value_that_some_models_do_not_have_is_empty(make_study: MakeStudy) -> None:
    macro = {"model": "macro", "cell_radius_m": 300.0, "min_distance_m": 35.0, "shadowing_db": 8.0}
    table = table_across([make_study("a"), make_study("b", radio__path_loss=macro)]).table
    pf = table[table["policy"] == "pf"]
    assert list(pf["radio.path_loss.model"]) == ["none", "macro"]
    assert pf["radio.path_loss.cell_radius_m"].isna().tolist() == [True, False]


def test_what_cannot_be_read_is_counted_and_named(make_study: MakeStudy, tmp_path: Path) -> None:
    whole, unfinished, cut, torn, empty = (make_study(name) for name in "abcde")
    (unfinished / "tables/policies.csv").unlink()
    table = cut / "tables/policies.csv"
    table.write_bytes(table.read_bytes()[:-4])
    (torn / "scenario.yaml").write_text("name: [torn\n")
    (empty / "tables/policies.csv").write_text("")
    stray = tmp_path / "results/notes.txt"
    stray.write_text("")
    across = table_across([whole, unfinished, cut, torn, empty, stray, tmp_path])
    assert across.studies == 1
    assert set(across.table["scenario"]) == {"a"}
    reasons = [
        (unfinished, r"no tables/policies\.csv: unfinished"),
        (cut, r"tables/policies\.csv is cut off"),
        (torn, r"scenario\.yaml: not valid YAML"),
        (empty, r"tables/policies\.csv is cut off"),
        (stray, "not a folder"),
        (tmp_path, r"no study: it has no scenario\.yaml"),
    ]
    assert list(across.left_out) == [str(folder) for folder, _ in reasons]
    for folder, reason in reasons:
        assert re.match(reason, across.left_out[str(folder)])


def test_doubtful_rows_are_named(make_study: MakeStudy) -> None:
    """Numbers of other values; a scenario of an earlier version; claims that are not there."""
    fresh, edited, earlier = (make_study(name, verdict="depends") for name in "abc")
    past = (edited / "scenario.yaml").stat().st_mtime - 60.0
    os.utime(edited / "tables/policies.csv", (past, past))
    text = (earlier / "scenario.yaml").read_text()
    (earlier / "scenario.yaml").write_text(text.replace("  load_ratio: null\n", "", 1))
    os.utime(earlier / "tables/policies.csv")
    (earlier / "claims.json").unlink()
    across = table_across([fresh, edited, earlier], verdicts=True)
    assert across.keys == []
    assert list(across.remarks) == [str(edited), str(earlier)]
    assert "older than scenario.yaml" in across.remarks[str(edited)]
    assert "lacks keys of this version" in across.remarks[str(earlier)]
    assert "traffic.load_ratio" in across.remarks[str(earlier)]
    assert "no claims.json" in across.remarks[str(earlier)]
    claims = across.table["claim10"]
    assert list(claims.isna()) == [False] * 4 + [True] * 2


def test_studies_of_the_same_name_have_their_folders(make_study: MakeStudy, tmp_path: Path) -> None:
    first, second = make_study("a"), make_study("b")
    text = (second / "scenario.yaml").read_text().replace("name: b\n", "name: a\n", 1)
    (second / "scenario.yaml").write_text(text)
    os.utime(second / "tables/policies.csv")
    table = table_across([first, second]).table
    assert list(table.columns[:2]) == ["scenario", "folder"]
    assert list(table["folder"]) == [str(first)] * 2 + [str(second)] * 2


@pytest.mark.parametrize(
    ("wanted", "said"),
    [
        ({"measures": ["late"]}, f"measure late: no study has it; there are: {LATE}"),
        ({"policies": ["ddpg"]}, "policy ddpg: no study has it; there are: pf, edf"),
        ({"keys": ["traffic.laod"]}, "key traffic.laod: no scenario has it; did you mean traffic"),
        ({"table": "sweeps"}, "no study to read: .*/a: no tables/sweeps.csv"),
    ],
)
def test_what_no_study_has_is_refused(
    make_study: MakeStudy, wanted: dict[str, list[str]], said: str
) -> None:
    with pytest.raises(InputError, match=said):
        table_across([make_study("a")], **wanted)


# The command.


def test_every_form_has_the_same_numbers(
    make_study: MakeStudy, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folders = [str(make_study("a", radio__num_prb=10)), str(make_study("b", radio__num_prb=20))]
    expected = table_across(folders).table
    for ending, read in ((".csv", pd.read_csv), (".parquet", pd.read_parquet)):
        out = tmp_path / f"all{ending}"
        assert main(["table", *folders, "--out", str(out)]) == 0
        assert capsys.readouterr().out == f"{out}: 4 rows of 2 studies\n"
        pd.testing.assert_frame_equal(read(out), expected, check_dtype=False, check_exact=True)
    out = tmp_path / "all.md"
    assert main(["table", *folders, "--policy", "pf", "--out", str(out)]) == 0
    assert "| b | 20 | pf | 2 | 0 | 0.20 [0.10, 0.40] |" in out.read_text()
    capsys.readouterr()
    assert main(["table", *folders, "--policy", "pf"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split() == [
        "scenario",
        "radio.num_prb",
        "policy",
        "seeds",
        "training_seeds",
        LATE,
    ]
    assert lines[2].split() == ["b", "20", "pf", "2", "0", "0.20", "[0.10,", "0.40]"]


def test_the_command_says_what_it_leaves_out(
    make_study: MakeStudy, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folders = [str(make_study("a")), str(tmp_path / "gone")]
    assert main(["table", *folders]) == 3
    captured = capsys.readouterr()
    assert captured.out.count("\n") == 3
    assert captured.err == f"left out: 1 of 2 folders\n  {folders[1]}: not a folder\n"


def test_no_file_is_overwritten_and_endings_are_known(
    make_study: MakeStudy, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, out = str(make_study("a")), tmp_path / "all.csv"
    out.write_text("mine")
    assert main(["table", folder, "--out", str(out)]) == 2
    assert out.read_text() == "mine"
    assert "--overwrite" in capsys.readouterr().err
    assert main(["table", folder, "--out", str(out), "--overwrite"]) == 0
    assert main(["table", folder, "--out", str(tmp_path / "all.xlsx")]) == 2
    assert "must end with .csv, .md, .parquet" in capsys.readouterr().err
