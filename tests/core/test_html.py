"""Pages in one file: what a text from elsewhere can do in them, which is nothing."""

from __future__ import annotations

import base64
import hashlib
import html
import json
import re

import pytest

from hiersched.core.html import data_url, page

BAD = "</script><script>alert(1)</script><!-- & \u2028 '\""


def test_data_read_back_and_close_no_element() -> None:
    text = page("t", "", data={"name": BAD, "list": [1, 2.5, None]})
    (inside,) = re.findall(r'<script type="application/json" id="data">(.*?)</script>', text)
    assert json.loads(inside) == {"name": BAD, "list": [1, 2.5, None]}
    assert not {"<", ">", "&"} & set(inside)
    with pytest.raises(ValueError, match="JSON compliant"):
        page("t", "", data=float("nan"))


def test_a_title_is_text() -> None:
    text = page(BAD, "")
    (title,) = re.findall(r"<title>(.*?)</title>", text)
    assert html.unescape(title) == BAD
    assert "<" not in title


@pytest.mark.parametrize("scripts", [(), ("let a = 1 < 2;",), ("first();", "zwei('ö');\n")])
def test_only_the_scripts_given_may_run(scripts: tuple[str, ...]) -> None:
    text = page("t", "<p>body</p>", scripts=scripts)
    (policy,) = re.findall(r'Content-Security-Policy" content="(.*?)"', text)
    rules = dict(part.strip().split(" ", 1) for part in policy.split(";"))
    wanted = [
        f"'sha256-{base64.b64encode(hashlib.sha256(s.encode()).digest()).decode()}'"
        for s in scripts
    ]
    assert rules["script-src"].split() == (wanted or ["'none'"])
    assert rules["default-src"] == "'none'"
    assert rules["img-src"] == "data:"
    assert all(f"<script>{script}</script>" in text for script in scripts)


def test_an_address_holds_the_data() -> None:
    kind, data = data_url("image/png", bytes(range(256))).split(";base64,")
    assert (kind, base64.b64decode(data)) == ("data:image/png", bytes(range(256)))
