"""A Markdown report as one HTML file that needs no other: its figures are inside."""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import unquote

from markdown_it import MarkdownIt
from markdown_it.token import Token

_PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>
{style}</style>
</head>
<body>
{body}</body>
</html>
"""

_TAGS = ("<br>", "<details><summary>all settings</summary>", "</details>")
"""What a report itself has of HTML; the names and settings that it shows may come from others."""

_STYLE = """
body { max-width: 64rem; margin: 0 auto; padding: 1rem 1.5rem 4rem; color: #1a1a1a; background: #fff;
  font: 1rem/1.5 system-ui, -apple-system, "Segoe UI", Roboto, "DejaVu Sans", sans-serif; }
h1, h2 { line-height: 1.2; }
h2 { margin-top: 2.5rem; padding-bottom: 0.2rem; border-bottom: 1px solid #ccc; }
p, li { max-width: 46rem; }
p:has(> img) { max-width: none; }
p, li, td, th { overflow-wrap: break-word; }
img { max-width: 100%; height: auto; }
code { font: 0.9em ui-monospace, "DejaVu Sans Mono", monospace; overflow-wrap: anywhere; }
code, pre { background: #f3f3f3; }
pre { padding: 0.7rem; overflow-x: auto; }
.table { overflow-x: auto; }
table { border-collapse: collapse; font-size: 0.875rem; font-variant-numeric: tabular-nums; }
th, td { padding: 0.3rem 0.6rem; text-align: left; vertical-align: top; border-bottom: 1px solid #ddd; }
th { border-bottom: 2px solid #888; }
td > img { min-width: 14rem; max-width: min(100%, 31rem); }
summary { cursor: pointer; }
@media screen and (max-width: 48rem) {
  table { min-width: 46rem; }
}
@media print {
  body { max-width: none; padding: 0; font-size: 9.5pt; }
  p, li { max-width: none; }
  .table { overflow: visible; }
  table { font-size: 7.5pt; }
  th, td { padding: 0.15rem 0.3rem; }
  td > img { min-width: 0; }
  img { max-height: 23cm; }
  h1, h2 { break-after: avoid; }
  tr, img { break-inside: avoid; }
}
"""


def as_page(text: str, folder: Path) -> str:
    """The report as HTML.

    Args:
        text: Markdown without links; its first line is the title. HTML is shown as text, but for the few
            tags of the report.
        folder: of its images, which are PNG files.

    Returns:
        The whole file.

    Raises:
        OSError: an image cannot be read.
        ValueError: an image is not in the folder.
    """
    markdown = MarkdownIt("commonmark", {"html": True}).enable("table")
    markdown.disable(["link", "autolink", "reference"])
    markdown.add_render_rule("html_inline", _html)
    markdown.add_render_rule("html_block", _html)
    markdown.add_render_rule("table_open", _table_open)
    markdown.add_render_rule("table_close", _table_close)
    tokens = markdown.parse(text)
    for token in tokens:
        for part in token.children or ():
            if part.type == "image":
                part.attrSet("src", _embedded(folder, unquote(str(part.attrGet("src")))))
    body = markdown.renderer.render(tokens, markdown.options, {})
    title = text.partition("\n")[0].lstrip("# ")
    return _PAGE.format(title=html.escape(title), style=_STYLE, body=body)


def _embedded(folder: Path, name: str) -> str:
    if Path(name).name != name:
        raise ValueError(f"image: {name!r}; must be a file in the folder of the report")
    return f"data:image/png;base64,{base64.b64encode((folder / name).read_bytes()).decode('ascii')}"


def _html(_: object, tokens: Sequence[Token], index: int, *__: object) -> str:
    content = tokens[index].content
    return content if content.strip() in _TAGS else html.escape(content)


def _table_open(*_: object) -> str:
    """A table that is wider than the page scrolls by itself."""
    return '<div class="table"><table>\n'


def _table_close(*_: object) -> str:
    return "</table></div>\n"
