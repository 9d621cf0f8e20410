"""A log as one page: its numbers are those of the log, and a browser shows what it should."""

from __future__ import annotations

import base64
import json
import re
import zlib
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hiersched.cli import main
from hiersched.core.colours import user_colours
from hiersched.log import LogDims, LogReader, LogWriter, log_digest
from hiersched.log.schema import topics_in
from hiersched.replay.page import write_log_page
from hiersched.replay.page.build import extremes, log_content, readable_colours

DIMS = LogDims(num_urllc=3, num_embb=2, num_prb=7)
SLOTS = 400
SCENARIO = b"traffic: {deadline_s: 0.02, embb_deadline_s: 0.1}\n"
BAD = "<img src=x onerror='window.hacked=1'></script><script>window.hacked=1</script>"


def log_of(path: Path, *, bad: str = "", slots: int = SLOTS, first: int = 0) -> Path:
    """Random numbers in every field, an event in every tenth slot."""
    rng = np.random.default_rng(3)
    fields: dict[str, Any] = {}
    for topic in topics_in("full").values():
        for field in topic.fields:
            shape = (slots, *field.sized(DIMS.sizes))
            values = rng.integers(0, 9, shape) if field.dtype == "<u4" else rng.random(shape)
            fields[field.name] = values.astype(field.dtype)
    fields["prb_owner"] = rng.integers(0, 5, (slots, 7)).astype(np.uint32)
    fields["superseded_packets"][:] = 0
    metadata = {"scenario": f"test{bad}", "policy": f"pf{bad}", "seed": "4", "warmup_slots": "50"}
    files = {"scenario.yaml": SCENARIO}
    with LogWriter(path, DIMS, metadata=metadata, attachments=files, slot_ns=10_000_000) as log:
        log.write_block(first, fields)
        for slot in range(first, first + slots, 10):
            log.event(slot, "WARNING", "queue", f"user {slot // 10 % 3}: late {bad}")
    return path


def numbers_of(content: dict[str, Any], place: dict[str, Any]) -> np.ndarray:
    """Unpack an array as the page does."""
    data = zlib.decompress(base64.b64decode(content["numbers"]))
    dtype = np.dtype(place["type"])
    planes = np.frombuffer(data, np.uint8, dtype.itemsize * place["count"], place["at"])
    return np.ascontiguousarray(planes.reshape(dtype.itemsize, -1).T).view(dtype).ravel()


def content_of(path: Path, start: int | None = None, stop: int | None = None) -> dict[str, Any]:
    with LogReader(path) as log:
        return log_content(log, start, stop)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return log_of(tmp_path_factory.mktemp("page") / "run.mcap")


def test_numbers_are_those_of_the_log(log: Path) -> None:
    content = content_of(log)
    panels = {panel["title"]: panel for panel in content["panels"]}
    assert {"Superseded packets in a slot"} == set(
        re.findall(r"not drawn: (.+)\.", " ".join(content["notes"]))
    )
    with LogReader(log) as reader:
        fields = {k: v for topic in reader.topics for k, v in reader.read(topic).items()}
    for title, name, scale in (
        ("Queue", "backlog_packets", 1.0),
        ("Wait of the oldest packet", "hol_delay_s", 1000.0),
        ("Late packets in a slot", "late_packets", 1.0),
        ("Tracking error", "tracking_error_m", 100.0),
        ("Gain in force", "gain_delay_steps", 1.0),
    ):
        lines = numbers_of(content, panels[title]["numbers"]).reshape(panels[title]["lines"], -1)
        np.testing.assert_allclose(lines, scale * fields[name].T, rtol=1e-6)
    both = numbers_of(content, panels["Reward of an agent"]["numbers"]).reshape(2, -1)
    np.testing.assert_allclose(both, [fields["reward_urllc"], fields["reward_embb"]], rtol=1e-6)
    owner = numbers_of(content, panels["Allocation of resource blocks"]["numbers"])
    assert (owner.reshape(-1, 7) == fields["prb_owner"]).all()
    assert dict(content["about"])["Digest"] == log_digest(log)
    assert [line["value"] for line in panels["Wait of the oldest packet"]["deadlines"]] == [20, 100]
    assert len(content["events"]) == SLOTS // 10
    assert content["events"][1] == (10, "WARNING", "queue", 1, "user 1: late ")


def test_long_logs_keep_the_extremes(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    values = np.array([[3, 1, 2, 9, 5, 5, 7], [0, 4, 0, 0, 0, 0, 1]])
    assert extremes(values, 4).tolist() == [[1, 9, 5, 7], [0, 4, 0, 1]]
    monkeypatch.setattr("hiersched.replay.page.build.MAX_SLOTS", 100)
    content = content_of(log)
    assert content["step"] == 8
    assert "every 8 slots" in content["notes"][0]
    panel = next(p for p in content["panels"] if p["title"] == "Queue")
    lines = numbers_of(content, panel["numbers"]).reshape(5, -1)
    with LogReader(log) as reader:
        backlog = reader.read("/queue", ["backlog_packets"])["backlog_packets"].T
    pairs = np.sort(lines.reshape(5, -1, 2), axis=2)
    blocks = backlog.reshape(5, -1, 8)
    np.testing.assert_allclose(pairs[..., 0], blocks.min(axis=2), rtol=1e-6)
    np.testing.assert_allclose(pairs[..., 1], blocks.max(axis=2), rtol=1e-6)


def test_a_span_shows_its_slots_alone(tmp_path: Path) -> None:
    log = log_of(tmp_path / "late.mcap", first=1000)
    content = content_of(log, 1100, 1120)
    assert content["spans"] == [(1100, 20)]
    assert [event[0] for event in content["events"]] == [1100, 1110]
    assert "here slots 1100 to 1119" in dict(content["about"])["Length"]
    with pytest.raises(ValueError, match="no slot starts in that span"):
        content_of(log, 0, 1000)


def test_colours_can_be_seen_on_white() -> None:
    """A contrast of 3:1 by the formula of WCAG 2, and the hue of the viewers."""
    own, shown = user_colours(10, 10), readable_colours(user_colours(10, 10))

    def luminance(rgb: np.ndarray) -> float:
        parts = [c / 255 / 12.92 if c <= 10 else ((c / 255 + 0.055) / 1.055) ** 2.4 for c in rgb]
        return 0.2126 * parts[0] + 0.7152 * parts[1] + 0.0722 * parts[2]

    assert len({tuple(rgb) for rgb in shown.tolist()}) == 20
    for before, after in zip(own.astype(int), shown.astype(int), strict=True):
        assert 1.05 / (luminance(after) + 0.05) >= 3.0
        if luminance(before) <= 0.29:
            assert (after == before).all()
        assert (np.argsort(after, kind="stable") == np.argsort(before, kind="stable")).all()


def profile_logs(study: Path) -> dict[str, Path]:
    found: dict[str, Path] = {}
    for path in sorted(study.rglob("*.mcap")):
        with LogReader(path) as log:
            found.setdefault(log.profile, path)
    return found


def test_every_profile_shows_what_it_has(
    study: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    logs = profile_logs(study)
    assert set(logs) == {"full", "compact", "decisions", "robots"}
    wanted = {
        "full": {"Queue", "Wait of the oldest packet", "Network delay", "Tracking error"},
        "compact": {"Queue", "Rate", "Tracking error", "Delay in force"},
        "decisions": {"Mean queue of a slice", "Reward of an agent"},
        "robots": {"Tracking error", "Delay in force"},
    }
    for profile, path in logs.items():
        assert main(["report", str(path), "--out", str(tmp_path / f"{profile}.html")]) == 0
        said = capsys.readouterr().err
        content = content_of(path)
        titles = {panel["title"] for panel in content["panels"]}
        assert wanted[profile] <= titles, profile
        assert ("Allocation of resource blocks" in titles) == (profile != "robots")
        assert ("Wait of the oldest packet" in titles) == (profile == "full")
        noted = [note for note in content["notes"] if "--out full.mcap" in note]
        assert len(noted) == (profile != "full")
        assert said == (f"{path}: " if noted else "") + "".join(
            note[8:-1].replace(path.name, str(path)) + "\n" for note in noted
        )
        names = [user["name"] for user in content["users"]]
        assert names[0] == ("robot 0" if profile == "robots" else "URLLC 0")


def test_the_command_writes_a_page_once(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    out = tmp_path / "a.html"
    words = ["report", str(log), "--out", str(out)]
    assert main(words) == 0
    assert capsys.readouterr().out == f"{out}\n"
    assert main(words) == 2
    assert "exists; --overwrite replaces it" in capsys.readouterr().err
    assert main([*words, "--overwrite", "--from", "3", "--to", "2"]) == 2
    assert "times 3 s to 2 s" in capsys.readouterr().err
    assert main([*words, "--overwrite", "--from", "1", "--to", "2"]) == 0
    (data,) = re.findall(r'id="data">(.*?)</script>', out.read_text(encoding="utf-8"))
    assert json.loads(data)["spans"] == [[100, 100]]
    bad = tmp_path / "bad.mcap"
    bad.write_bytes(log.read_bytes()[:-100])
    assert main(["report", str(bad)]) == 2
    assert not bad.with_suffix(".html").exists()


# In a browser.


@pytest.fixture
def tab(browser: Callable[[], AbstractContextManager[Any]], tmp_path: Path) -> Iterator[Any]:
    page = tmp_path / "page.html"
    write_log_page(log_of(tmp_path / "run.mcap", bad=BAD), page)
    with browser() as tab:
        tab.open(page)
        yield tab
        assert tab.faults == []
        assert tab.requests == [page.resolve().as_uri()]


def ranges(tab: Any) -> set[tuple[float, float]]:
    found = tab.run(
        "[...document.querySelectorAll('.panel')].map(p => [+p.dataset.from, +p.dataset.to])"
    )
    assert len(found) > 10
    return {(start, stop) for start, stop in found}


def test_text_from_a_log_stays_text(tab: Any) -> None:
    assert tab.run("window.hacked") is None
    assert tab.run("document.querySelectorAll('img').length") == 0
    assert (
        tab.run("document.getElementById('title').textContent") == f"test{BAD} · pf{BAD} · seed 4"
    )
    assert BAD in tab.run("document.querySelector('#events tbody').textContent")


def test_panels_zoom_and_move_together(tab: Any) -> None:
    assert ranges(tab) == {(0.0, 4.0)}
    x, y = tab.middle('.panel[data-title="Tracking error"] .u-over')
    width = tab.run("document.querySelector('.u-over').clientWidth")
    tab.mouse("Moved", x, y)
    tab.mouse("Pressed", x, y)
    for share in (0.05, 0.1, 0.25):
        tab.mouse("Moved", x + share * width, y, held=True)
    tab.mouse("Released", x + 0.25 * width, y)
    ((start, stop),) = ranges(tab)
    assert (start, stop) == pytest.approx((2.0, 3.0), abs=0.02)
    tab.click('#view button[data-act="left"]')
    ((earlier, _),) = ranges(tab)
    assert earlier == pytest.approx(start - 0.25 * (stop - start))
    rows = tab.run(
        "[...document.querySelectorAll('#events tbody tr')].map(r => +r.cells[0].innerText)"
    )
    assert rows == [
        t for t in np.arange(0, 4, 0.1).round(2) if earlier <= t < earlier + stop - start
    ]
    tab.click('#view button[data-act="all"]')
    assert ranges(tab) == {(0.0, 4.0)}


def test_the_cursor_reads_the_numbers_of_the_log(tab: Any, tmp_path: Path) -> None:
    x, y = tab.middle('.panel[data-title="Queue"] .u-over')
    tab.mouse("Moved", x, y)
    tab.mouse("Moved", x + 1, y)
    readings = "[...document.querySelectorAll('.panel output')].map(o => o.textContent)"
    tab.wait(f"{readings}.every(text => text !== '')")
    queue, rate = (
        tab.run(f"document.querySelector('.panel[data-title=\"{title}\"] output').textContent")
        for title in ("Queue", "Rate")
    )
    with LogReader(tmp_path / "run.mcap") as log:
        backlog = log.read("/queue", ["backlog_packets"])["backlog_packets"]
        rates = log.read("/allocation", ["rate_mbps"])["rate_mbps"]
    form = r"([\d.]+) s, slot (\d+)(?:greatest, )?(?:URLLC|eMBB) (\d): ([\d.]+) (\S+)"
    for text, values, unit in ((queue, backlog, "packets"), (rate, rates, "Mbit/s")):
        match = re.fullmatch(form, text)
        assert match, text
        time, slot, user, number, its_unit = match.groups()
        assert float(time) == pytest.approx(0.01 * int(slot))
        assert float(number) == pytest.approx(values[int(slot), int(user)], rel=5e-4)
        assert its_unit == unit


PIXELS = """((colour) => {
    const canvas = document.querySelector(
      '.panel[data-title="Allocation of resource blocks"] canvas');
    const copy = new OffscreenCanvas(canvas.width, canvas.height);
    const context = copy.getContext("2d", { willReadFrequently: true });
    context.drawImage(canvas, 0, 0);
    const { data } = context.getImageData(0, 0, canvas.width, canvas.height);
    const [r, g, b] = [1, 3, 5].map((i) => parseInt(colour.slice(i, i + 2), 16));
    let count = 0;
    for (let i = 0; i < data.length; i += 4)
      count += data[i] === r && data[i + 1] === g && data[i + 2] === b;
    return count;
})"""


def pixels(tab: Any, colour: str) -> int:
    """Count the pixels of a colour in the image of the allocation."""
    count: int = tab.run(f"{PIXELS}('{colour}')")
    return count


def test_a_user_is_hidden_everywhere(tab: Any, tmp_path: Path) -> None:
    colour = content_of(tmp_path / "run.mcap")["users"][1]["colour"]
    shown = "[...document.querySelectorAll('.panel')].map(p => p.dataset.shown.split(','))"
    events = "[...document.querySelectorAll('#events tbody tr')].map(r => r.cells[2].textContent)"
    of_users = [names for names in tab.run(shown) if "URLLC 1" in names]
    assert len(of_users) > 8
    assert pixels(tab, colour) > 1000
    assert "URLLC 1" in tab.run(events)
    tab.click('#users button[data-user="1"]')
    after = tab.run(shown)
    assert not any("URLLC 1" in names for names in after)
    assert sum("URLLC 0" in names for names in after) == len(of_users)
    assert pixels(tab, colour) == 0
    assert set(tab.run(events)) == {"URLLC 0", "URLLC 2"}
    tab.click('#users button[data-user="1"]')
    assert pixels(tab, colour) > 1000
    tab.click('#users button[data-slice="1"]')
    assert not any("eMBB" in " ".join(names) for names in tab.run(shown))
