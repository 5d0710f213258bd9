# SPDX-License-Identifier: Apache-2.0
"""The report as one page that needs nothing beside it: text, tables, and the pictures inside."""

from __future__ import annotations

import base64
import html
from collections.abc import Iterable, Sequence
from pathlib import Path

from blf_dsc_controller.paper.evidence import FAILS, HOLDS, ONLY_IF, Claim

_STYLE = """
body{font:16px/1.5 system-ui,sans-serif;color:#22272e;max-width:76rem;margin:2rem auto;
padding:0 1rem}
h1{font-size:1.7rem}h2{font-size:1.25rem;margin-top:2.2rem}img{max-width:100%;height:auto}
table{border-collapse:collapse;font-size:.8rem;width:100%}
.wide{overflow-x:auto}th,td{border-bottom:1px solid #e5e7eb;padding:.4rem .55rem;text-align:left;
vertical-align:top}th{background:#f6f8fa}td.number{white-space:nowrap;
font-variant-numeric:tabular-nums}
code{font-size:.92em;background:#f6f8fa;padding:.05rem .25rem}
.verdict{font-weight:600;min-width:7rem}.good{color:#00704f}.partly{color:#9a5b00}.bad{color:#b3001b}
figure{margin:1.2rem 0}figcaption{color:#4b5563;font-size:.9rem}
"""
_CLASS = {HOLDS: 'good', ONLY_IF: 'partly', FAILS: 'bad'}


def text(words: str) -> str:
    """Escape for HTML."""
    return html.escape(words, quote=False)


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Table whose first column names its rows."""
    head = ''.join(f'<th>{text(cell)}</th>' for cell in header)
    body = ''.join(
        '<tr>'
        + ''.join(
            f'<td class="number">{text(cell)}</td>' if k else f'<td>{text(cell)}</td>'
            for k, cell in enumerate(row)
        )
        + '</tr>\n'
        for row in rows
    )
    return f'<div class="wide"><table><tr>{head}</tr>\n{body}</table></div>\n'


def claims_table(found: Iterable[Claim]) -> str:
    """One row for each claim."""
    head = ''.join(
        f'<th>{name}</th>' for name in ('where', 'says', 'measured', 'verdict', 'shown by')
    )
    rows = ''.join(
        f'<tr><td>{text(claim.where)}</td><td>{text(claim.says)}</td>'
        f'<td>{text(claim.measured)}</td>'
        f'<td class="verdict {_CLASS[claim.verdict]}">{text(claim.judgement)}</td>'
        f'<td><code>{text(claim.command)}</code></td></tr>\n'
        for claim in found
    )
    return f'<div class="wide"><table><tr>{head}</tr>\n{rows}</table></div>\n'


def picture(path: Path, caption: str) -> str:
    """Picture with a caption, its bytes inside the page."""
    inside = base64.b64encode(path.read_bytes()).decode('ascii')
    return (
        f'<figure><img alt="{html.escape(caption)}" src="data:image/png;base64,{inside}">'
        f'<figcaption>{text(caption)}</figcaption></figure>\n'
    )


def paragraphs(*words: str) -> str:
    """Paragraphs of plain text."""
    return ''.join(f'<p>{text(each)}</p>\n' for each in words)


def section(title: str, *content: str) -> str:
    """Heading and what stands below it."""
    return f'<h2>{text(title)}</h2>\n{"".join(content)}'


def write_page(path: Path, title: str, *content: str) -> None:
    """Write the page."""
    path.write_text(
        f'<!doctype html>\n<html lang="en"><meta charset="utf-8">\n'
        f'<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f'<title>{text(title)}</title>\n<style>{_STYLE}</style>\n'
        f'<h1>{text(title)}</h1>\n{"".join(content)}</html>\n',
        encoding='utf-8',
    )
