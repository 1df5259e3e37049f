"""Reports as Markdown, rendered from Jinja templates, and as one HTML page with its images inside."""

from __future__ import annotations

import base64
import html
import itertools
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from urllib.parse import unquote

from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape
from markdown_it import MarkdownIt
from markdown_it.renderer import RendererHTML
from markdown_it.token import Token
from markdown_it.utils import EnvType, OptionsDict
from PIL import Image

_FOLDED = (
    "maps of the other methods",
    "pressure at each control point",
    "our readings and numbers",
    "definitions",
    "definitions, and how the paper was read",
    "simulation",
    "all settings",
)
_TAGS = ("<br>", "</details>", *(f"<details><summary>{text}</summary>" for text in _FOLDED))
"""HTML that a report itself contains; names and settings may come from others and are shown as text."""

_SCREEN_DPI = 96  # of a browser, in which letters of figures have the size of those of the text

_SHORT = 30  # characters; a table of no longer cells keeps each value in one line
_ROUND = str.maketrans("[]", "()")


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


def picture(file: str, alt: str) -> str:
    """Return an image of the report's folder with its alternative text; brackets would end the text."""
    return f"![{alt.translate(_ROUND)}]({file})"


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
    Sections get anchors. Tables get header cells and scroll by themselves; a table of images becomes figures.
    """
    markdown = MarkdownIt("commonmark", {"html": True}).enable("table")
    markdown.disable(["link", "autolink", "reference"])
    for rule in ("html_inline", "html_block"):
        markdown.add_render_rule(rule, _html)
    for rule, render in (("table_open", _table_open), ("table_close", _table_close), ("figures", _figures)):
        markdown.add_render_rule(rule, render)
    tokens = markdown.parse(text)
    _embed_images(tokens, folder)
    sections = _mark_sections(tokens)
    tokens = _mark_tables(tokens)
    body = markdown.renderer.render(tokens, markdown.options, {})
    return rendered("page.html", title=text.partition("\n")[0].lstrip("# "), sections=sections, body=body)


def _embed_images(tokens: Sequence[Token], folder: Path) -> None:
    """Replace the names of image files by their contents."""
    for token in tokens:
        for part in token.children or ():
            if part.type == "image":
                name = unquote(str(part.attrGet("src")))
                if Path(name).name != name:
                    raise ValueError(f"image: {name!r}; must be a file in the folder of the report")
                image = base64.b64encode((folder / name).read_bytes()).decode("ascii")
                part.attrSet("src", f"data:image/png;base64,{image}")
                with Image.open(folder / name) as opened:
                    if "dpi" in opened.info:
                        part.attrSet("width", round(opened.width * _SCREEN_DPI / opened.info["dpi"][0]))


def _mark_sections(tokens: Sequence[Token]) -> list[tuple[str, str]]:
    """Give each section an anchor; return anchors and headings."""
    sections: list[tuple[str, str]] = []
    for token, content in itertools.pairwise(tokens):
        if token.type == "heading_open" and token.tag == "h2":
            sections.append((f"section-{len(sections) + 1}", content.content))
            token.attrSet("id", sections[-1][0])
    return sections


def _mark_tables(tokens: Sequence[Token]) -> list[Token]:
    """Give tables a label and header cells with their scope; turn tables of images into figures."""
    marked: list[Token] = []
    section, count, start = "", 0, 0
    for index, token in enumerate(tokens):
        marked.append(token)
        if token.type == "heading_open":
            section, count = tokens[index + 1].content, 0
        elif token.type == "table_open":
            start = len(marked) - 1
        elif token.type == "table_close":
            table = marked[start:]
            if pictures := _pictures(table):
                marked[start:] = [Token("figures", "", 0, meta={"pictures": pictures})]
                continue
            count += 1
            table[0].meta["label"] = f"{section}, table {count}" if count > 1 else f"{section}, table"
            if max(len(cell.content) for cell in table if cell.type == "inline") <= _SHORT:
                table[0].attrSet("class", "short")
            _mark_headers(table)
            _mark_numbers(table)
    return marked


def _mark_headers(table: Sequence[Token]) -> None:
    """Make the header of each column and the first cell of each row header cells with a scope."""
    for before, token, _, close in zip(table, table[1:], table[2:], table[3:], strict=False):
        if token.type == "th_open":
            token.attrSet("scope", "col")
        elif token.type == "td_open" and before.type == "tr_open":
            token.tag = close.tag = "th"
            token.attrSet("scope", "row")


def _mark_numbers(table: Sequence[Token]) -> None:
    for token, content in itertools.pairwise(table):
        if token.type == "td_open" and re.match(r"[-\d]", content.content) and len(content.content) <= _SHORT:
            token.attrSet("class", "number")


def _pictures(table: Sequence[Token]) -> list[tuple[Token, Token]]:
    """Return the images of a table that has nothing else, each with the head of its column."""
    heads = [content for cell, content in itertools.pairwise(table) if cell.type == "th_open"]
    cells = [content for cell, content in itertools.pairwise(table) if cell.type == "td_open"]
    images = [content for content in cells if [part.type for part in content.children or ()] == ["image"]]
    return list(zip(images, heads, strict=False)) if len(images) == len(cells) else []


def _table_open(renderer: RendererHTML, tokens: Sequence[Token], index: int, *_: object) -> str:
    label, attributes = html.escape(tokens[index].meta["label"]), renderer.renderAttrs(tokens[index])
    return f'<div class="table" role="group" aria-label="{label}" tabindex="0"><table{attributes}>\n'


def _table_close(*_: object) -> str:
    return "</table></div>\n"


def _figures(
    renderer: RendererHTML, tokens: Sequence[Token], index: int, options: OptionsDict, env: EnvType
) -> str:
    shown = (
        f"<figure>{renderer.renderInline(image.children or [], options, env)}"
        f"<figcaption>{renderer.renderInline(head.children or [], options, env)}</figcaption></figure>\n"
        for image, head in tokens[index].meta["pictures"]
    )
    return f'<div class="figures">\n{"".join(shown)}</div>\n'


def _html(_: object, tokens: Sequence[Token], index: int, *__: object) -> str:
    content = tokens[index].content
    return content if content.strip() in _TAGS else html.escape(content)
