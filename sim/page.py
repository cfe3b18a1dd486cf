"""What pages are made of: their look, tables, pictures, numbers as people read them."""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sim.plots import colour

CONSISTENT = (0.5, 1.7)
"""ANEES and mean NIS within these are called consistent in words; the figure itself stands beside it."""

TALL = 24
"""Rows of a table that are all shown; in a longer one the reader scrolls."""

STYLE = """
:root { --ink: #1f2430; --soft: #5f6675; --line: #e3e6eb; --accent: #0072B2; --warn: #D55E00; --good: #007a58; }
* { box-sizing: border-box; }
body { margin: 0; background: #f6f7f9; color: var(--ink);
  font: 15px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif; }
main { max-width: 1120px; margin: 0 auto; padding: 36px 24px 56px; }
.over { color: var(--accent); font-size: 12px; font-weight: 600; letter-spacing: .09em; text-transform: uppercase; }
h1 { font-size: 30px; line-height: 1.2; margin: 2px 0 6px; letter-spacing: -0.015em; }
h2 { font-size: 17px; margin: 0 0 4px; letter-spacing: -0.005em; }
p.sub { margin: 0 0 24px; color: var(--soft); }
section { background: #fff; border: 1px solid var(--line); border-radius: 12px; padding: 20px 24px; margin: 0 0 18px;
  overflow-x: auto; }
section p { margin: 0 0 14px; color: var(--soft); font-size: 14px; }
.cards { display: grid; grid-template-columns: repeat(auto-fit, minmax(132px, 1fr)); gap: 12px; margin-bottom: 18px; }
.card { background: #fff; border: 1px solid var(--line); border-radius: 12px; padding: 14px 16px; }
.card b { display: block; font-size: 24px; line-height: 1.3; font-weight: 600; font-variant-numeric: tabular-nums; }
.card b small { font-size: 14px; font-weight: 500; color: var(--soft); }
.card span { display: block; color: var(--soft); font-size: 13px; }
.card em { font-style: normal; font-size: 12px; font-weight: 600; color: var(--soft); }
.card em.good { color: var(--good); }
.card em.warn { color: var(--warn); }
table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; font-size: 14px; margin-top: 8px; }
th { text-align: right; font-weight: 500; color: var(--soft); font-size: 13px; padding: 6px 10px;
  border-bottom: 1px solid var(--line); vertical-align: bottom; }
td { text-align: right; padding: 6px 10px; border-bottom: 1px solid #f0f2f5; white-space: nowrap; }
th.group { text-align: center; color: var(--ink); }
td.good { color: var(--good); font-weight: 600; }
td.warn { color: var(--warn); font-weight: 600; }
td.words { white-space: normal; overflow-wrap: anywhere; }
th:first-child, td:first-child { text-align: left; padding-left: 0; }
th:last-child, td:last-child { padding-right: 0; }
tr:last-child td { border-bottom: 0; }
.tall { max-height: 640px; overflow-y: auto; }
tr.total td { font-weight: 600; }
tr.aside td { color: var(--soft); }
i.dot { display: inline-block; width: 10px; height: 10px; border-radius: 50%; margin-right: 9px; }
.two { display: grid; grid-template-columns: repeat(auto-fit, minmax(320px, 1fr)); gap: 18px; }
.two section { margin: 0; }
.two { margin-bottom: 18px; }
img { width: 100%; display: block; }
pre { background: #f0f2f5; border-radius: 8px; padding: 12px 14px; margin: 8px 0 0; font-size: 13px;
  white-space: pre-wrap; overflow-wrap: anywhere; }
a { color: var(--accent); }
.stage { position: relative; cursor: pointer; border: 1px solid var(--line); border-radius: 8px; overflow: hidden; }
.stage canvas { width: 100%; display: block; }
.stage .big { position: absolute; left: 22px; bottom: 34px; width: 60px; height: 60px; border: 0;
  border-radius: 50%; background: var(--accent); color: #fff; font-size: 23px; padding: 0 0 0 5px; cursor: pointer;
  box-shadow: 0 2px 12px rgba(31, 36, 48, .3); }
.stage .big[hidden] { display: none; }
.bar { display: flex; gap: 14px; align-items: center; margin-top: 10px; font-size: 14px; color: var(--soft);
  font-variant-numeric: tabular-nums; flex-wrap: wrap; }
.bar .time { flex: 1; min-width: 120px; accent-color: var(--accent); }
.bar .play { width: 40px; height: 30px; border: 1px solid var(--line); border-radius: 8px; background: #fff;
  color: var(--accent); cursor: pointer; }
.bar select { border: 1px solid var(--line); border-radius: 8px; background: #fff; height: 30px; color: var(--ink); }
section.warn { border-left: 4px solid var(--warn); padding: 14px 20px; }
footer { color: var(--soft); font-size: 13px; max-width: 88ch; }
"""


def page(title: str, blocks: Sequence[str]) -> str:
    """A whole page of blocks of HTML; it needs no other file."""
    body = "\n".join(block for block in blocks if block)
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{html.escape(title)} - cofix</title>'
        f'<meta name="viewport" content="width=device-width, initial-scale=1"><style>{STYLE}</style></head>'
        f"<body><main>{body}</main></body></html>\n"
    )


def section(heading: str, body: str, text: str = "") -> str:
    """A box with a heading and an explanation, both escaped, over HTML."""
    words = f"<p>{html.escape(text)}</p>" if text else ""
    return f"<section><h2>{html.escape(heading)}</h2>{words}{body}</section>"


def picture(heading: str, text: str, path: Path) -> str:
    """A section with a PNG inside."""
    data = base64.b64encode(path.read_bytes()).decode()
    return section(heading, f'<img alt="{html.escape(heading)}" src="data:image/png;base64,{data}">', text)


def number(value: Any, digits: int) -> str:
    return f"{value:.{digits}f}" if isinstance(value, (int, float)) else "–"


def size(count: float) -> tuple[str, str]:
    """Bytes as a number and its unit."""
    for unit in ("B", "kB", "MB"):
        if count < 1000.0:
            return f"{count:.0f}" if unit == "B" or count >= 100.0 else f"{count:.1f}", unit
        count /= 1000.0
    return f"{count:.1f}", "GB"


def verdict(value: Any) -> tuple[str, str]:
    """A mean NEES or NIS in a word, and the class of its colour; empty without one."""
    if not isinstance(value, (int, float)):
        return "", ""
    low, high = CONSISTENT
    if value > high:
        return "overconfident", "warn"
    return ("consistent", "good") if value >= low else ("cautious", "")


def cards(items: Sequence[tuple[str, str, str, str]]) -> str:
    """(figure, unit, what it is, HTML below) in boxes."""
    found = "".join(
        f'<div class="card"><b>{value} <small>{unit}</small></b><span>{name}</span>{mark}</div>'
        for value, unit, name, mark in items
    )
    return f'<div class="cards">{found}</div>'


def table(
    header: Sequence[str],
    rows: Sequence[Sequence[str]],
    classes: Sequence[str] | None = None,
    groups: Sequence[tuple[str, int]] = (),
) -> str:
    """Cells are escaped; a cell may carry the colour of a robot or run as `index|text`, or a class as `good|text`.

    `classes` are of rows; `groups` are (heading, columns) above the header.
    """
    head = "<tr>" + "".join(f"<th>{html.escape(name)}</th>" for name in header) + "</tr>"
    if groups:
        over = "".join(f'<th class="group" colspan="{span}">{html.escape(name)}</th>' for name, span in groups)
        head = f"<tr>{over}</tr>{head}"
    body = ""
    for index, row in enumerate(rows):
        mark = f' class="{classes[index]}"' if classes and classes[index] else ""
        body += f"<tr{mark}>" + "".join(_cell(cell) for cell in row) + "</tr>"
    whole = f"<table>{head}{body}</table>"
    return f'<div class="tall">{whole}</div>' if len(rows) > TALL else whole


def _cell(text: str) -> str:
    mark, bar, rest = text.partition("|")
    if not bar:
        return f"<td>{html.escape(text)}</td>"
    if mark.isdecimal():
        return f'<td><i class="dot" style="background:{colour(int(mark))}"></i>{html.escape(rest)}</td>'
    return f'<td class="{html.escape(mark)}">{html.escape(rest)}</td>'
