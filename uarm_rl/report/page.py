"""The report as one HTML file: the sections' documents and figures, and nothing that is not in the file itself.

Whatever comes from a file, a run's name above all, is text here and never HTML.
"""

from __future__ import annotations

import base64
import csv
import io
import json
import re
from collections.abc import Iterator, Mapping
from html import escape
from importlib import resources
from pathlib import Path
from string import Template
from typing import Final

from uarm_rl.report import svg
from uarm_rl.report.tables import Document, Heading, Part, Photo, Picture, Section, Shown, Stage, Table

_FOLDED: Final = 16  # rows: longer tables are folded
_LONG: Final = 40  # characters of a cell: sentences
_LONGEST: Final = 300  # rows of a CSV file that the page repeats beside its figure


def page(sections: Mapping[str, Section]) -> bytes:
    """The page of these sections, by their titles: the same sections make the same bytes."""
    assets = resources.files("uarm_rl.report") / "assets"
    filled = {title: "".join(_section(section, f"f{number}")) for number, (title, section) in enumerate(sections.items())}
    shown = {title: content for title, content in filled.items() if content}
    links = "".join(f'<li><a href="#s{number}">{escape(title)}</a></li>' for number, title in enumerate(shown))
    body = "".join(
        f'<section id="s{number}" aria-labelledby="h{number}"><h2 id="h{number}">{escape(title)}</h2>{content}</section>\n'
        for number, (title, content) in enumerate(shown.items())
    )
    template = Template((assets / "report.html").read_text(encoding="utf-8"))
    style, script = ((assets / name).read_text(encoding="utf-8") for name in ("report.css", "report.js"))
    return template.substitute(links=links, sections=body, style=style, script=script).encode()


def _section(section: Section, name: str) -> Iterator[str]:
    """The HTML of a section: figures, what its Markdown files say, numbers that only a CSV file has, what the page adds."""
    pictures = {Path(file).name: one for file, one in section.contents.items() if isinstance(one, Picture)}
    documents = {file: one for file, one in section.contents.items() if isinstance(one, Document)}
    placed = {part.file for one in documents.values() for part in one.parts if isinstance(part, Shown)}
    figures = {
        file: _figure(picture, f"{name}-{number}", captioned=file not in placed)  # a heading says it there
        for number, (file, picture) in enumerate(pictures.items())
    }
    yield from (figure for file, figure in figures.items() if file not in placed)
    for document in (*documents.values(), section.page):
        yield from (_part(part, figures) for part in document.parts)
    said = {Path(file).stem for file, one in documents.items() if any(isinstance(part, Table) for part in one.parts)}
    for file, content in section.contents.items():
        if isinstance(content, bytes) and file.endswith(".csv") and Path(file).stem not in said:
            yield from _numbers(file, content)


def _part(part: Part, figures: Mapping[str, str]) -> str:
    if isinstance(part, str):
        return f"<p>{inline(part)}</p>"
    if isinstance(part, Heading):
        return f"<h3>{inline(part.words)}</h3>"
    if isinstance(part, Shown):
        return figures.get(part.file, "")
    if isinstance(part, Photo):
        data, words = base64.b64encode(part.data).decode(), escape(part.words)
        picture = f'<img src="data:{part.kind};base64,{data}" alt="{words}">'
        return f'<figure class="photo">{picture}<figcaption>{words}</figcaption></figure>'
    return _stage(part) if isinstance(part, Stage) else _table(part)


def inline(text: str) -> str:
    """A paragraph or a cell of Markdown: bold and code, and everything else as it is."""
    return re.sub(r"`([^`]+)`", r"<code>\1</code>", re.sub(r"\*\*(.+?)\*\*", r"<strong>\1</strong>", escape(text)))


def _figure(picture: Picture, name: str, *, captioned: bool) -> str:
    caption = f"<figcaption>{escape(picture.words)}</figcaption>" if captioned else ""
    return f"<figure>{svg.inline(picture.svg, name, picture.words)}{caption}</figure>"


def _table(table: Table) -> str:
    """A table that sorts by a click on a heading; a long one is folded."""
    heads = "".join(
        f'<th scope="col"{"" if column < table.left else _NUMBER}>{inline(heading)}</th>'
        for column, heading in enumerate(table.headings)
    )
    rows = "".join(
        f"<tr>{''.join(_cell(cell, column, table.left) for column, cell in enumerate(row))}</tr>" for row in table.rows
    )
    folded = len(table.rows) > _FOLDED
    caption = f"<caption>{inline(table.title)}</caption>" if table.title and not folded else ""
    words = escape(table.title or ", ".join(table.headings[:3]))
    shown = (
        f'<div class="wide" tabindex="0" role="region" aria-label="{words}"><table class="sorts">{caption}'
        f"<thead><tr>{heads}</tr></thead><tbody>{rows}</tbody></table></div>"
    )
    if not folded:
        return shown
    summary = inline(table.title or f"Table of {len(table.rows)} rows")
    return f"<details><summary>{summary}</summary>{shown}</details>"


_NUMBER: Final = ' class="number"'


def _cell(cell: str, column: int, left: int) -> str:
    if column == 0 and left:
        return f'<th scope="row">{inline(cell)}</th>'
    if len(cell) > _LONG:
        return f'<td class="long">{inline(cell)}</td>'
    return f"<td{'' if column < left else _NUMBER}>{inline(cell)}</td>"


def _numbers(file: str, content: bytes) -> Iterator[str]:
    """A CSV file that no other table of its section shows, unless it is too long to be read."""
    headings, *rows = csv.reader(io.StringIO(content.decode(), newline=""))
    if rows and len(rows) <= _LONGEST:
        table = _table(Table(headings, rows, title=file))
        yield table if table.startswith("<details") else f"<details><summary>{escape(file)}</summary>{table}</details>"


def _stage(stage: Stage) -> str:
    """The place of the replays, and what the script needs for it, as JSON that no HTML can be in."""
    replays = [{"who": one.who, "where": one.where, "outcome": one.outcome, "data": one.recording} for one in stage.replays]
    data = json.dumps({"before": stage.before, "after": stage.after, "replays": replays}, ensure_ascii=False)
    outcomes = "".join(f"<li>{escape(f'{one.who}, {one.where}: {one.outcome}')}</li>" for one in stage.replays)
    return (
        '<div class="stage" hidden><p><label>Methods <select class="who"></select></label> '
        '<label>Position <select class="where"></select></label></p><p class="outcome" aria-live="polite"></p>'
        '<div class="viewer"></div></div>'
        f"<details><summary>How each of the {len(stage.replays)} ended</summary><ul>{outcomes}</ul></details>"
        f'<script type="application/json" class="replays">{data.replace("<", chr(92) + "u003c")}</script>'
    )
