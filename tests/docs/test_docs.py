"""The documentation is built once, with warnings as errors; that executes its notebooks."""

import inspect
import os
import subprocess
import sys
import tomllib
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest
import yaml
from filelock import FileLock
from sphinx.util.inventory import InventoryFile

import autdtorch

pytestmark = pytest.mark.timeout(900)  # the first test waits for the build and all notebooks

DOCS = Path(__file__).parents[2] / "docs"
NOTEBOOKS = sorted(page for page in DOCS.rglob("*.md") if "\n```{code-cell}" in page.read_text("utf-8"))


class Page(HTMLParser):
    """What can be linked to on a page, what it links to, and how many of its cells were executed."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.anchors: set[str] = set()
        self.targets: list[str] = []
        self.outputs = 0
        self.feed(path.read_text("utf-8"))

    def handle_starttag(self, tag, attributes):
        given = dict(attributes)
        self.anchors.add(given.get("id") or "")
        self.targets += [given[key] for key in ("href", "src") if given.get(key)]
        self.outputs += "cell_output" in (given.get("class") or "").split()


@pytest.fixture(scope="session")
def built(tmp_path_factory):
    out = tmp_path_factory.getbasetemp() / "docs"
    if "PYTEST_XDIST_WORKER" in os.environ:  # the first of several processes builds for all
        out = tmp_path_factory.getbasetemp().parent / "docs"
    environment = {key: value for key, value in os.environ.items() if key != "AUTDTORCH_CACHE_DIR"}
    environment["OMP_NUM_THREADS"] = "1"  # other tests have the other cores
    command = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", "-d", out / "doctrees", DOCS]
    with FileLock(f"{out}.lock"):
        if not (out / "html" / "objects.inv").exists():
            build = subprocess.run([*command, out / "html"], env=environment, capture_output=True, text=True)
            assert build.returncode == 0, build.stdout + build.stderr
    return out / "html"


@pytest.fixture(scope="session")
def pages(built):
    return {path: Page(path) for path in built.rglob("*.html")}


def test_the_citation_names_the_package_and_the_paper():
    citation = yaml.safe_load((DOCS.parent / "CITATION.cff").read_text("utf-8"))
    project = tomllib.loads((DOCS.parent / "pyproject.toml").read_text("utf-8"))["project"]
    assert (citation["authors"], citation["license"]) == (project["authors"], project["license"])
    assert citation["title"].startswith(project["name"])
    (paper,) = citation["references"]
    faq = " ".join((DOCS / "faq.md").read_text("utf-8").split())
    assert paper["title"] in faq
    assert paper["doi"] in faq


def test_every_notebook_was_executed(built, pages):
    built_from = {(built / page.relative_to(DOCS)).with_suffix(".html"): page for page in NOTEBOOKS}
    assert not [page for path, page in built_from.items() if not pages[path].outputs]


def test_every_tutorial_is_a_notebook():
    tutorials = set(DOCS.glob("tutorials/*.md")) - {DOCS / "tutorials/index.md"}
    assert tutorials <= set(NOTEBOOKS)


def test_no_link_is_broken(built, pages):
    broken = []
    for path, page in pages.items():
        for target in page.targets:
            url = urlsplit(target)
            if url.scheme or url.netloc:
                continue
            to = (path.parent / unquote(url.path)).resolve() if url.path else path
            if not to.exists() or (
                url.fragment and to in pages and unquote(url.fragment) not in pages[to].anchors
            ):
                broken.append(f"{path.relative_to(built)}: {target}")
    assert not broken


@pytest.mark.parametrize("colours", ["light", "dark"])
@pytest.mark.parametrize("width", [1200, 360])
def test_the_front_page_is_accessible(built, browser, colours, width):
    axe = pytest.importorskip(
        "axe_playwright_python.sync_playwright", reason="axe: install autdtorch[dev]"
    ).Axe()
    page = browser.new_page(viewport={"width": width, "height": 800}, color_scheme=colours)
    page.goto((built / "index.html").as_uri())
    found = axe.run(page)
    scrolls = page.evaluate("document.documentElement.scrollWidth")
    page.close()
    assert found.violations_count == 0, found.generate_report()
    assert scrolls <= width


def test_the_reference_has_every_public_name(built):
    inventory = InventoryFile.loads((built / "objects.inv").read_bytes(), uri="")
    documented = {item for kind in inventory.data.values() for item in kind}
    public = {f"autdtorch.{name}" for name in autdtorch.__all__}
    for name in autdtorch.__all__:
        if inspect.ismodule(module := getattr(autdtorch, name)):
            public |= {f"autdtorch.{name}.{its}" for its in module.__all__}
    assert public <= documented
