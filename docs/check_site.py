"""Checks the built site: links, anchors, public names, and that nothing comes from the network.

`python docs/check_site.py FOLDER` prints what is wrong, status 1. Sphinx has seen the links of the
pages; this sees all of the HTML, what theme, docstrings and notebooks have put into it too. Where a
link leads outside the site, its form is checked alone.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from functools import cache
from html.parser import HTMLParser
from importlib import import_module
from pathlib import Path
from urllib.parse import unquote, urlsplit

PACKAGES = ("env", "control", "scenario", "simulator", "log")
"""Those whose `__all__` the API pages have."""
LOADED = {"img", "script", "iframe", "source", "video", "audio", "embed", "object", "input"}
LOADED_LINKS = {"stylesheet", "icon", "preload", "modulepreload"}
STYLE_URL = re.compile(r"""(?:url\(\s*|@import\s+)["']?([^"')\s]+)""")


class Page(HTMLParser):
    """Anchors of a page, where its links lead, and what a browser loads for it."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.anchors: set[str] = {"", "top"}
        self.links: list[str] = []
        self.loads: list[str] = []
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {name: value or "" for name, value in attrs}
        self.anchors |= {given[name] for name in ("id", "name") if name in given}
        if tag in LOADED:
            self.loads += [given[name] for name in ("src", "data") if given.get(name)]
        if tag == "link" and LOADED_LINKS & set(given.get("rel", "").split()):
            self.loads.append(given.get("href", ""))
        elif tag in ("a", "link") and "href" in given:
            self.links.append(given["href"])


read = cache(Page)


def faults_of(path: Path, root: Path) -> Iterator[str]:
    """Say what is wrong with a page, or with a style sheet."""
    if path.suffix == ".css":
        links: list[str] = []
        loads = STYLE_URL.findall(path.read_text(encoding="utf-8"))
    else:
        page = read(path)
        links, loads = page.links, page.loads
    for target in loads:
        parts = urlsplit(target)
        if parts.netloc:
            yield f"loads {target} from the network"
        elif parts.scheme != "data" and not _inside(path, parts.path, root).is_file():
            yield f"loads {target}, which is not there"
    for target in links:
        if fault := link_fault(path, target, root):
            yield f"{target}: {fault}"


def link_fault(path: Path, target: str, root: Path) -> str | None:
    """Say what is wrong with a link of a page, if anything."""
    parts = urlsplit(target)
    if parts.scheme == "mailto" and "@" in parts.path:
        return None
    if parts.scheme or parts.netloc:
        well_formed = parts.scheme == "https" and re.fullmatch(r"[\w-]+(\.[\w-]+)+", parts.netloc)
        return None if well_formed else "must be https:// and a host"
    place = _inside(path, parts.path, root) if parts.path else path
    if not place.is_file():
        return "no such file"
    if place.suffix == ".html" and unquote(parts.fragment) not in read(place).anchors:
        return "no such anchor"
    return None


def _inside(path: Path, link: str, root: Path) -> Path:
    place = (path.parent / unquote(link)).resolve()
    if not place.is_relative_to(root):
        return root / "outside"
    return place / "index.html" if place.is_dir() else place


def undocumented(root: Path) -> Iterator[str]:
    """Name what is public and stands on no page of the API."""
    pages = [read(page) for page in (root / "docs/api").glob("*.html")]
    known = {anchor.rpartition(".")[2] for page in pages for anchor in page.anchors}
    for name in PACKAGES:
        for thing in import_module(f"hiersched.{name}").__all__:
            if thing not in known:
                yield f"hiersched.{name}.{thing} is public and on no page of the API"


def site_faults(root: Path) -> list[str]:
    """Return all that is wrong with the site in a folder."""
    root = root.resolve()
    files = sorted(file for kind in ("*.html", "*.css") for file in root.rglob(kind))
    faults = [
        f"{file.relative_to(root)}: {fault}" for file in files for fault in faults_of(file, root)
    ]
    return [*faults, *undocumented(root)]


if __name__ == "__main__":
    found = site_faults(Path(sys.argv[1]))
    print(*found, sep="\n", end="\n" if found else "")
    sys.exit(bool(found))
