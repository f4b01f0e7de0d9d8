"""The manual builds without a warning, every link leads somewhere, and viewing it fetches nothing."""

import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest

from .pages import GENERATED, PAGES, ROOT, name_of

SITE = ROOT / "build" / "manual"


class Page(HTMLParser):
    """What a built page links to, loads, and can be linked at."""

    def __init__(self, path: Path):
        super().__init__()
        self.links, self.loads, self.ids = [], [], set()
        self.feed(path.read_text())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        self.ids.add(given.get("id"))
        if tag == "a" and given.get("href"):
            self.links.append(given["href"])
        elif tag in ("img", "script", "link") and given.get("rel") not in ("canonical", "prev", "next"):
            self.loads.extend(filter(None, (given.get("src"), given.get("href"))))


@pytest.fixture(scope="module")
def site() -> dict[Path, Page]:
    """Every page of the site, freshly built; a warning fails."""
    pytest.importorskip("zensical", reason="needs the extra docs")
    build = [sys.executable, "-m", "zensical", "build", "--clean", "--strict", "--config-file", "mkdocs.yml"]
    for command in ([sys.executable, "docs/generate"], build):
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
        assert done.returncode == 0, done.stdout + done.stderr
    # 404.html is shown at any address, so its links begin at the root of the server.
    return {path: Page(path) for path in SITE.rglob("*.html") if path.name != "404.html"}


@pytest.mark.slow
def test_every_page_is_in_the_site_and_its_links_lead_somewhere_and_nothing_is_fetched(site):
    lost = [
        (path.relative_to(SITE), link) for path, page in site.items() for link in page.links if _lost(link, path, site)
    ]
    assert not lost
    pages = {path.relative_to(ROOT / "docs").with_suffix(".html") for path in (ROOT / "docs").rglob("*.md")}
    assert pages <= {path.relative_to(SITE) for path in site}
    loads = {address for page in site.values() for address in page.loads}
    assert not [address for address in loads if urlsplit(address).netloc]
    assert not [path for path in SITE.rglob("*.css") if re.search(r"url\([\"']?https?:|@import", path.read_text())]


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_files_that_are_named_exist(page):
    """Links of the Markdown itself, as GitHub shows it, and paths of source files in the text."""
    text = page.read_text()
    links = [target.partition("#")[0] for target in re.findall(r"\]\(([^)\s]+)\)", text) if "://" not in target]
    lost = [link for link in links if link and not _is_page((page.parent / link).resolve())]
    paths = re.findall(r"`((?:\w+/)+[\w-]+\.py)`", text)
    lost += [path for path in paths if "NAME" not in path and not _is_source(path)]
    assert not lost


def test_pages_that_the_source_names_exist():
    sources = [path for folder in ("sglpr_jax", "configs", "benchmarks") for path in (ROOT / folder).rglob("*.py")]
    named = {(path.name, page) for path in sources for page in re.findall(r"docs/[\w/-]+\.md", path.read_text())}
    assert not [(source, page) for source, page in named if not _is_page(ROOT / page)]


def _is_page(path: Path) -> bool:
    return path in GENERATED or path.exists()


def _is_source(path: str) -> bool:
    return (ROOT / path).exists() or (ROOT / "sglpr_jax" / path).exists()


def _lost(link: str, path: Path, site: dict[Path, Page]) -> bool:
    """Whether a link within the site leads to no file, or to an anchor that its page does not have."""
    parts = urlsplit(link)
    if parts.scheme or parts.netloc:
        return False
    target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
    if target.is_dir():
        target = target / "index.html"
    if not target.exists():
        return True
    return bool(parts.fragment) and target in site and unquote(parts.fragment) not in site[target].ids
