"""HTML pages in one file: they ask no network for anything, and run no script but their own."""

from __future__ import annotations

import base64
import hashlib
import html
import json
import re
from collections.abc import Sequence
from importlib.resources import files
from typing import Any

_PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="{policy}">
<meta name="viewport" content="width=device-width">
<title>{title}</title>
<style>{style}</style>
</head>
<body>
{body}
<script type="application/json" id="data">{data}</script>
{scripts}
</body>
</html>
"""


def page(
    title: str,
    body: str,
    *,
    data: Any = None,
    styles: Sequence[str] = (),
    scripts: Sequence[str] = (),
) -> str:
    """Return a page with everything that it needs inside.

    Its security policy, which browsers enforce, allows no request to any address, no event handler
    in the markup and no script other than `scripts`, by their hashes: text from a file that became
    markup by mistake could not act.

    Parameters
    ----------
    title
        Plain text.
    body
        Markup; whatever it has from files is escaped already.
    data
        What the scripts read, as JSON, from the element ``data``.
    styles, scripts
        Sources, in this order; the style of all pages comes first.
    """
    policy = "default-src 'none'; base-uri 'none'; form-action 'none'; img-src data:; "
    policy += "style-src 'unsafe-inline'; script-src " + (" ".join(map(_hash, scripts)) or "'none'")
    return _PAGE.format(
        policy=policy,
        title=html.escape(title),
        style="\n".join((asset(__name__, "page.css"), *styles)),
        body=body,
        data=_inert_json(data),
        scripts="\n".join(f"<script>{script}</script>" for script in scripts),
    )


def asset(package: str, name: str) -> str:
    """Return the text of a file that lies beside the modules of a package."""
    return files(package).joinpath(name).read_text(encoding="utf-8")


def codes(text: str) -> str:
    """Return markup of a text in which `words` in backquotes are code; all else is escaped."""
    return re.sub(r"`([^`]*)`", r"<code>\1</code>", html.escape(text))


def data_url(kind: str, data: bytes) -> str:
    """Return an address that holds the data themselves; `kind` is such as ``image/png``."""
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"


def _hash(script: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()}'"


def _inert_json(data: Any) -> str:
    """Return JSON in which nothing can close the element around it, or open another."""
    text = json.dumps(data, ensure_ascii=True, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")
