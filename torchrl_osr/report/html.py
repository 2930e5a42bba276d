"""Pieces of a page that stands alone: no network, no script, whatever names hold.

Every text goes through :func:`text`; only these functions write markup.
"""

from __future__ import annotations

import base64
import re
from collections.abc import Iterable, Sequence
from html import escape
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple, TypeVar

STYLE = """
:root { color-scheme: light dark; --ink: #1b1f24; --soft: #5b6570; --line: #d5dae0;
  --page: #ffffff; --panel: #f5f7f9; --warn: #8a4b00; --warn-page: #fff4e0;
  --good: #00694d; --bad: #a83e00; --link: #0b5cad; }
@media (prefers-color-scheme: dark) { :root { --ink: #e4e8ec; --soft: #9aa5b1;
  --line: #3a434d; --page: #14181c; --panel: #1d2329; --warn: #ffc168;
  --warn-page: #35270f; --good: #4cc9a0; --bad: #ff9a62; --link: #7db8f5; } }
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 1.5rem 1.25rem 4rem; max-width: 66rem;
  font: 16px/1.5 system-ui, "Segoe UI", "DejaVu Sans", sans-serif; color: var(--ink);
  background: var(--page); overflow-wrap: break-word; }
h1 { font-size: 1.7rem; line-height: 1.2; margin: 0 0 .4rem; }
h2 { font-size: 1.3rem; margin: 2.6rem 0 .6rem; padding-top: .8rem;
  border-top: 1px solid var(--line); }
h3 { font-size: 1.05rem; margin: 1.6rem 0 .4rem; }
p, ul { max-width: 48rem; }
a { color: var(--link); }
nav a { margin-right: 1.1rem; white-space: nowrap; }
.scroll { overflow-x: auto; margin: .5rem 0 1.2rem; }
table { border-collapse: collapse; font-size: .86rem;
  font-variant-numeric: tabular-nums; }
th, td { padding: .28rem .7rem; text-align: left; vertical-align: top;
  border-bottom: 1px solid var(--line); }
thead th { border-bottom: 2px solid var(--line); vertical-align: bottom; }
th.group { background: var(--panel); padding-top: .5rem; }
tbody th { font-weight: 600; }
td small { display: block; white-space: nowrap; opacity: .8; }
td.wide { overflow-wrap: anywhere; min-width: 9rem; }
.better { color: var(--good); } .worse { color: var(--bad); }
.none { color: var(--soft); }
figure { margin: 1rem 0 1.6rem; }
figure img { display: block; max-width: 100%; height: auto; background: #fff;
  border: 1px solid var(--line); border-radius: 4px; }
figcaption { color: var(--soft); font-size: .9rem; margin-top: .35rem;
  max-width: 48rem; }
.warning { background: var(--warn-page); border-left: 4px solid var(--warn);
  padding: .6rem 1rem; margin: 1rem 0; }
.warning strong { color: var(--warn); }
.warning ul { margin: .3rem 0; padding-left: 1.2rem; }
.paper { border: 1px dashed var(--soft); background: var(--panel); padding: .2rem 1rem;
  margin: 1rem 0; }
summary { cursor: pointer; color: var(--link); }
@media print { body { max-width: none; padding: 0; font-size: 10.5pt; }
  nav { display: none; } figure:not(:has(table)), tr, .warning { break-inside: avoid; }
  h2, h3, tr:has(th.group) { break-after: avoid; } .scroll { overflow: visible; }
  table { font-size: 7.5pt; } th, td { padding: .15rem .3rem; } }
@page { size: A4; margin: 14mm; }
"""


class Cell(NamedTuple):
    """A cell of a table.

    Attributes:
        text: plain.
        small: a second line below it, smaller.
        kind: a class of the style sheet.
    """

    text: str
    small: str = ""
    kind: str = ""


T = TypeVar("T")
Row = Sequence[str | Cell]
Group = tuple[str, Sequence[Row]]
"""Rows below a title of their own, or below none where it is ""."""


def text(value: object) -> str:
    """Return a text as markup that shows it as it is."""
    return escape(str(value), quote=True)


def paragraph(*sentences: str) -> str:
    """Return a paragraph."""
    return f"<p>{text(' '.join(sentences))}</p>"


def heading(title: str) -> str:
    """Return a heading inside a section."""
    return f"<h3>{text(title)}</h3>"


def bullets(items: Iterable[str | Cell]) -> str:
    """Return a list."""
    lines = []
    for item in items:
        cell = item if isinstance(item, Cell) else Cell(item)
        kind = f' class="{text(cell.kind)}"' if cell.kind else ""
        lines.append(f"<li{kind}>{text(cell.text)}</li>")
    return f"<ul>{''.join(lines)}</ul>"


def warning(title: str, items: Sequence[str]) -> str:
    """Return a box that cannot be overlooked; nothing if there is nothing to say."""
    if not items:
        return ""
    return (
        f'<div class="warning" role="note"><strong>{text(title)}</strong>'
        f"{bullets(items)}</div>"
    )


def paper(*content: str) -> str:
    """Return content in a frame that says it is not one's own."""
    return f'<div class="paper">{"".join(content)}</div>'


def details(title: str, content: str) -> str:
    """Return content that opens on demand."""
    return f"<details><summary>{text(title)}</summary>{content}</details>"


def table(head: Sequence[str], groups: Iterable[Group], caption: str = "") -> str:
    """Return a table; the first cell of each row names it.

    Args:
        head: titles of the columns.
        groups: rows, each with as many cells as there are titles.
        caption: above the table.
    """
    columns = "".join(f'<th scope="col">{text(title)}</th>' for title in head)
    bodies = []
    for title, rows in groups:
        lines = []
        if title:
            lines.append(
                f'<tr><th class="group" colspan="{len(head)}" scope="rowgroup">'
                f"{text(title)}</th></tr>"
            )
        lines += [_row(row, len(head)) for row in rows]
        bodies.append(f"<tbody>{''.join(lines)}</tbody>")
    above = f"<figcaption>{text(caption)}</figcaption>" if caption else ""
    return (
        f'<figure>{above}<div class="scroll"><table><thead><tr>{columns}</tr></thead>'
        f"{''.join(bodies)}</table></div></figure>"
    )


def side_by_side(items: Sequence[T], most: int = 4) -> list[Sequence[T]]:
    """Return items in parts of nearly equal size, as many as a table has room for.

    Args:
        items: one for each column.
        most: columns that still fit on a page. Default 4.
    """
    parts = -(-len(items) // most)
    bounds = [len(items) * i // max(parts, 1) for i in range(parts + 1)]
    return [items[low:high] for low, high in pairwise(bounds)]


def figure(path: Path, description: str, caption: str) -> str:
    """Return a picture, embedded.

    Args:
        path: of the PNG.
        description: what one would see.
        caption: how to read it.
    """
    code = base64.b64encode(path.read_bytes()).decode("ascii")
    return (
        f'<figure><img alt="{text(description)}" src="data:image/png;base64,{code}">'
        f"<figcaption>{text(caption)}</figcaption></figure>"
    )


def page(title: str, head: str, sections: Sequence[tuple[str, str]]) -> str:
    """Return the whole page.

    Args:
        title: of the page.
        head: markup below it.
        sections: titles, and markup.
    """
    names = [(slug(name), name) for name, _ in sections]
    links = "".join(f'<a href="#{key}">{text(name)}</a>' for key, name in names)
    bodies = "".join(
        f'<section id="{key}"><h2>{text(name)}</h2>{content}</section>\n'
        for (key, name), (_, content) in zip(names, sections, strict=True)
    )
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{text(title)}</title><style>{STYLE}</style></head>\n<body>"
        f"<h1>{text(title)}</h1>{head}<nav>{links}</nav>\n{bodies}</body></html>\n"
    )


def slug(name: str) -> str:
    """Return a name's letters and digits, fit for files and links."""
    return re.sub(r"[^A-Za-z0-9]+", "-", name).strip("-").lower() or "unnamed"


def _row(row: Row, width: int) -> str:
    """Return a row of a table."""
    if len(row) != width:
        raise ValueError(f"a row of {len(row)} cells in a table of {width}: {row}")
    first, *rest = (cell if isinstance(cell, Cell) else Cell(cell) for cell in row)
    cells = [f'<th scope="row">{text(first.text)}</th>']
    for cell in rest:
        kind = f' class="{text(cell.kind)}"' if cell.kind else ""
        small = f"<small>{text(cell.small)}</small>" if cell.small else ""
        cells.append(f"<td{kind}>{text(cell.text)}{small}</td>")
    return f"<tr>{''.join(cells)}</tr>"
