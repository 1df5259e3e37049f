"""The pages are built once, with warnings as errors; the cells of each notebook run in this process."""

import ast
import inspect
import json
import os
import re
import subprocess
import sys
import tomllib
import warnings
from html.parser import HTMLParser
from pathlib import Path
from unittest.mock import patch
from urllib.parse import unquote, urlsplit

import matplotlib.pyplot as plt
import pytest
import torch
import yaml
from filelock import FileLock

import autdtorch
from autdtorch import hardware

pytestmark = pytest.mark.timeout(900)  # the first test waits for the build

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
CELL = re.compile(r"^```\{code-cell\} ipython3\n(.*?)^```$", re.DOTALL | re.MULTILINE)
NOTEBOOKS = {
    page.relative_to(DOCS).as_posix(): text
    for page in sorted(DOCS.rglob("*.md"))
    if "\n```{code-cell}" in (text := page.read_text("utf-8"))
}


# --- notebooks


@pytest.mark.parametrize("page", NOTEBOOKS)
def test_the_cells_of_a_notebook_run(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    registries = [patch.dict(registry) for registry in (hardware.DEVICES, hardware.SENSORS)]
    names = {"__name__": "__main__"}
    with (
        registries[0],
        registries[1],
        torch.random.fork_rng(),
        plt.rc_context({"backend": "Agg"}),
        warnings.catch_warnings(),
    ):
        warnings.simplefilter("default")  # as Jupyter shows them
        for source in CELL.findall(NOTEBOOKS[page]):
            body = ast.parse(source).body
            shown = body.pop() if isinstance(body[-1], ast.Expr) else None
            exec(compile(ast.Module(body, []), page, "exec"), names)
            if shown is not None:
                value = eval(compile(ast.Expression(shown.value), page, "eval"), names)
                assert getattr(value, "_repr_html_", lambda: "text")() or repr(value)
    plt.close("all")


def test_jupyter_knows_the_notebooks():
    jupytext = pytest.importorskip("jupytext", reason="in the extra notebook")
    for page, text in NOTEBOOKS.items():
        notebook = jupytext.reads(text, fmt="md:myst")
        cells = [cell.source.strip() for cell in notebook.cells if cell.cell_type == "code"]
        assert cells == [source.strip() for source in CELL.findall(text)], page
        assert len(cells) == text.count("\n```{code-cell}")
        kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
        assert notebook.metadata["kernelspec"] == kernel
        # Jupyter takes a page for a notebook by this.
        assert jupytext.formats.read_format_from_metadata(text, ".md") == "myst"
        # Sphinx puts the title of a page into an empty link, Jupyter shows nothing.
        assert "[](" not in text


def test_jupytext_executes_a_page(tmp_path):
    pytest.importorskip("jupytext", reason="in the extra notebook")
    pytest.importorskip("nbconvert", reason="in the extra notebook")
    output = tmp_path / "page.ipynb"
    command = ["jupytext", "--to", "ipynb", "--execute", "docs/tutorials/first_field.md", "--output", output]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONWARNINGS": ""}
    run = {"cwd": ROOT, "env": environment, "capture_output": True, "text": True}
    done = subprocess.run([sys.executable, "-m", *command], **run)
    assert done.returncode == 0, done.stderr
    cells = [cell for cell in json.loads(output.read_text("utf-8"))["cells"] if cell["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in cells] == list(range(1, len(cells) + 1))
    assert any("image/png" in output.get("data", {}) for cell in cells for output in cell["outputs"])


def test_every_tutorial_is_a_notebook():
    tutorials = {f"tutorials/{page.name}" for page in DOCS.glob("tutorials/*.md")}
    assert tutorials - {"tutorials/index.md"} <= set(NOTEBOOKS)


# --- the build


class Page(HTMLParser):
    """The anchors of a page, and the targets of its links."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.anchors: set[str] = set()
        self.targets: list[str] = []
        self.feed(path.read_text("utf-8"))

    def handle_starttag(self, tag, attributes):
        values = dict(attributes)
        self.anchors.add(values.get("id") or "")
        self.targets += [values[key] for key in ("href", "src") if values.get(key)]


@pytest.fixture(scope="session")
def built(tmp_path_factory):
    from sphinx.cmd.build import main

    out = tmp_path_factory.getbasetemp() / "docs"
    if "PYTEST_XDIST_WORKER" in os.environ:  # the first of several processes builds for all
        out = tmp_path_factory.getbasetemp().parent / "docs"
    options = ["-q", "-W", "--keep-going", "-D", "nb_execution_mode=off", "-d", str(out / "doctrees")]
    with FileLock(f"{out}.lock"), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Python's; those of Sphinx are errors
        if not (out / "html" / "objects.inv").exists():
            assert main([*options, str(DOCS), str(out / "html")]) == 0
    return out / "html"


def test_no_link_is_broken(built):
    pages = {path: Page(path) for path in built.rglob("*.html")}
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
    for name in ("README.md", "CONTRIBUTING.md"):  # GitHub shows these
        for target in re.findall(r"\]\(([^)#]+)", (ROOT / name).read_text("utf-8")):
            if not (urlsplit(target).scheme or (ROOT / target).exists()):
                broken.append(f"{name}: {target}")
    assert not broken


def test_every_picture_is_on_a_page():
    texts = [page.read_text("utf-8") for page in DOCS.rglob("*.md")]
    shown = {name for text in texts for name in re.findall(r"\]\((\w+\.png)\)", text)}
    assert shown == {path.name for path in DOCS.rglob("*.png")}


@pytest.mark.parametrize("colours", ["light", "dark"])
@pytest.mark.parametrize("width", [1200, 360])
def test_the_front_page_is_accessible(built, browser, colours, width):
    axe = pytest.importorskip(
        "axe_playwright_python.sync_playwright", reason="axe: install autdtorch[dev]"
    ).Axe()
    page = browser.new_page(viewport={"width": width, "height": 800}, color_scheme=colours)
    page.goto((built / "index.html").as_uri())
    report = axe.run(page)
    scrolls = page.evaluate("document.documentElement.scrollWidth")
    page.close()
    assert report.violations_count == 0, report.generate_report()
    assert scrolls <= width


def test_the_reference_has_every_public_name(built):
    from sphinx.util.inventory import InventoryFile

    inventory = InventoryFile.loads((built / "objects.inv").read_bytes(), uri="")
    documented = {item for kind in inventory.data.values() for item in kind}
    public = {f"autdtorch.{name}" for name in autdtorch.__all__}
    for name in autdtorch.__all__:
        if inspect.ismodule(module := getattr(autdtorch, name)):
            public |= {f"autdtorch.{name}.{its}" for its in module.__all__}
    assert public <= documented


def test_the_citation_names_the_package_and_the_paper():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text("utf-8"))
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    assert (citation["authors"], citation["license"]) == (project["authors"], project["license"])
    assert citation["title"].startswith(project["name"])
    (paper,) = citation["references"]
    readme = " ".join((ROOT / "README.md").read_text("utf-8").split())
    assert paper["title"] in readme
    assert paper["doi"] in readme
