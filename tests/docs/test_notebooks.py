"""A page with code cells is a notebook for Jupyter, too: Jupytext reads its cells and its kernel."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

jupytext = pytest.importorskip("jupytext", reason="in the extra notebook")

ROOT = Path(__file__).parents[2]
NOTEBOOKS = sorted(
    page.relative_to(ROOT)
    for page in ROOT.glob("docs/**/*.md")
    if "\n```{code-cell}" in page.read_text("utf-8")
)
CELL = re.compile(r"^```\{code-cell\} ipython3\n(.*?)^```$", re.DOTALL | re.MULTILINE)


def converted(page, command, folder, output):
    """Return the notebook that `jupytext` makes of a page when it is called in `folder`."""
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "jupytext",
            "--to",
            "ipynb",
            *command,
            os.path.relpath(page, folder),
            "--output",
            output,
        ],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT), "PYTHONWARNINGS": ""},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(output.read_text("utf-8"))


@pytest.mark.parametrize("page", NOTEBOOKS, ids=str)
def test_jupytext_finds_the_cells_and_the_kernel_of_a_page(page):
    text = (ROOT / page).read_text("utf-8")
    notebook = jupytext.reads(text, fmt="md:myst")
    cells = [cell.source.strip() for cell in notebook.cells if cell.cell_type == "code"]
    assert cells == [source.strip() for source in CELL.findall(text)]
    assert len(cells) == text.count("\n```{code-cell}")
    assert notebook.metadata["kernelspec"] == {
        "display_name": "Python 3",
        "language": "python",
        "name": "python3",
    }
    # Jupyter takes a page for a notebook by this.
    assert jupytext.formats.read_format_from_metadata(text, ".md") == "myst"


@pytest.mark.parametrize("page", NOTEBOOKS, ids=str)
def test_links_of_a_notebook_have_a_text(page):
    # Sphinx puts the title of a page into an empty one, Jupyter shows nothing.
    assert "[](" not in (ROOT / page).read_text("utf-8")


@pytest.mark.parametrize(
    ("page", "folder"), [("docs/interop.md", "docs"), ("docs/tutorials/first_field.md", ".")], ids=str
)
def test_jupytext_executes_a_page(page, folder, tmp_path):
    pytest.importorskip("nbconvert", reason="in the extra notebook")
    notebook = converted(ROOT / page, ["--execute"], ROOT / folder, tmp_path / "page.ipynb")
    counts = [cell["execution_count"] for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert counts == list(range(1, len(counts) + 1))
    assert any(cell.get("outputs") for cell in notebook["cells"])
