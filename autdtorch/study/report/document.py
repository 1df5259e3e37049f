"""Reports as Markdown, rendered from Jinja templates, and as one HTML page with its images inside."""

from __future__ import annotations

import base64
import html
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from urllib.parse import unquote

from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape
from markdown_it import MarkdownIt
from markdown_it.token import Token

_TAGS = ("<br>", "<details><summary>all settings</summary>", "</details>")
"""HTML that a report itself contains; names and settings may come from others and are shown as text."""


def table(rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table of rows, header first."""
    head, *body = rows
    lines = [head, ["---"] * len(head), *body]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)


def code(text: str) -> str:
    """Return text as a code span, in which neither Markdown nor HTML has a meaning."""
    line = re.sub(r"[\r\n]+", " ", text)
    ticks = _longer_than_any(line, 0)
    pad = " " if line.startswith("`") or line.endswith("`") else ""
    return f"{ticks}{pad}{line}{pad}{ticks}"


def fenced(text: str, language: str = "") -> str:
    """Return text as a code block, in which neither Markdown nor HTML has a meaning."""
    ticks = _longer_than_any(text, 2)
    return f"{ticks}{language}\n{text}\n{ticks}"


def _longer_than_any(text: str, least: int) -> str:
    """Return more backticks than any run of them in the text, and more than `least`."""
    return "`" * (1 + max([least, *map(len, re.findall("`+", text))]))


_TEMPLATES = Environment(
    loader=PackageLoader("autdtorch.study.report"),
    autoescape=select_autoescape(["html"]),
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
    keep_trailing_newline=True,
)
_TEMPLATES.filters |= {"table": table, "code": code, "fenced": fenced}


def rendered(template: str, **values: object) -> str:
    """Return the text of a template of this package with its values inserted."""
    return _TEMPLATES.get_template(template).render(values)


def as_page(text: str, folder: Path) -> str:
    """Return a report in Markdown without links as one HTML file; its first line is the title.

    HTML is shown as text, except for the tags of the report itself. Images must be PNG files in `folder`.
    """
    markdown = MarkdownIt("commonmark", {"html": True}).enable("table")
    markdown.disable(["link", "autolink", "reference"])
    for rule in ("html_inline", "html_block"):
        markdown.add_render_rule(rule, _html)
    tokens = markdown.parse(text)
    for token in tokens:
        for part in token.children or ():
            if part.type == "image":
                name = unquote(str(part.attrGet("src")))
                if Path(name).name != name:
                    raise ValueError(f"image: {name!r}; must be a file in the folder of the report")
                image = base64.b64encode((folder / name).read_bytes()).decode("ascii")
                part.attrSet("src", f"data:image/png;base64,{image}")
    body = markdown.renderer.render(tokens, markdown.options, {})
    # A wide table scrolls by itself. All other HTML of this name has been escaped.
    body = body.replace("<table>", '<div class="table"><table>').replace("</table>", "</table></div>")
    return rendered("page.html", title=text.partition("\n")[0].lstrip("# "), body=body)


def _html(_: object, tokens: Sequence[Token], index: int, *__: object) -> str:
    content = tokens[index].content
    return content if content.strip() in _TAGS else html.escape(content)
