"""One HTML page that opens from disk: sortable tables, films and slices of every row, figures."""

import base64
import re
from collections.abc import Sequence
from html import escape
from itertools import groupby
from pathlib import Path

from src.reports.run_groups import RunGroup
from src.reports.tables import Table, TableCell
from src.reports.writers import format_cell

TEMPLATE = Path(__file__).with_name("page.html")
MEDIA_TYPES = {".gif": "image/gif", ".png": "image/png", ".svg": "image/svg+xml"}


class MediaBudget:
    """Bytes that pictures may still take; files that do not fit are listed in `left_out`."""

    def __init__(self, size: int):
        self.remaining, self.left_out = size, list[str]()

    def embed(self, file: Path) -> str | None:
        """Return the picture as a data URI, or None where it is too large for what remains."""
        size = file.stat().st_size * 4 // 3
        if size > self.remaining:
            self.left_out.append(str(file))
            return None
        self.remaining -= size
        data = base64.b64encode(file.read_bytes()).decode()
        return f"data:{MEDIA_TYPES[file.suffix]};base64,{data}"


def format_html(
    title: str, tables: Sequence[Table], groups: Sequence[RunGroup], figures: Sequence[Path], *,
    commands: Sequence[str], media_bytes: int,
) -> str:  # fmt: skip
    """Return the page; pictures are in it until `media_bytes` are spent, the rest is named."""
    budget = MediaBudget(media_bytes)
    commits = sorted({run.record["git"] for group in groups for run in group.runs})
    head = [f"<p><code>{escape(command)}</code></p>" for command in commands]
    head.append(f"<p>Code at {escape(', '.join(commits))}.</p>" if commits else "")
    body = [_format_table(table) for table in tables]
    for file in figures:
        if source := budget.embed(file):
            heading = f"<h2>{escape(file.stem.capitalize())}</h2>"
            body.append(f'{heading}\n<figure class="plot"><img src="{source}" alt=""></figure>')
    body += _format_films(groups, budget)
    if budget.left_out:
        names = ", ".join(map(escape, budget.left_out))
        body.append(f"<p>Left out to keep the page small (media_mib): {names}.</p>")
    parts = {"title": escape(title), "head": "\n".join(head), "body": "\n".join(body)}
    return re.sub(r"\{\{(\w+)\}\}", lambda name: parts[name[1]], TEMPLATE.read_text())


def _format_table(table: Table) -> str:
    groups = "".join(
        f'<th class="group" colspan="{len(list(members))}">{escape(group)}</th>'
        for group, members in groupby(table.columns, key=lambda column: column.group)
    )
    grouped = f"<tr>{groups}</tr>\n" if any(column.group for column in table.columns) else ""
    heads = "".join(
        f'<th class="{_column_kind(table, place)}"><button>{escape(column.title)}</button></th>'
        for place, column in enumerate(table.columns)
    )
    rows = "\n".join(
        "<tr>" + "".join(_format_cell(table, k, cell) for k, cell in enumerate(row)) + "</tr>"
        for row in table.rows
    )
    return (
        f'<h2>{escape(table.title)}</h2>\n<div class="wide"><table><thead>\n{grouped}'
        f'<tr class="heads">{heads}</tr></thead>\n'
        f"<tbody>\n{rows}\n</tbody></table></div>\n<p>{escape(table.note)}</p>"
    )


def _column_kind(table: Table, place: int) -> str:
    if place < table.labels:
        return "word"
    return "other" if table.columns[place].name.startswith("paper_") else ""


def _format_cell(table: Table, place: int, cell: TableCell) -> str:
    kind = "missing" if cell.text == "missing" else _column_kind(table, place)
    number, *std = format_cell(cell, table.columns[place]).split(" ± ")
    shown = escape(number) if cell.text or cell.mean is not None else "–"
    shown = f"<b>{shown}</b>" if table.is_best(place, cell) else shown
    shown += f" <small>± {std[0]}</small>" if cell.std is not None else ""
    sort = "" if cell.text else f' data-value="{"" if cell.mean is None else cell.mean!r}"'
    return f'<td class="{kind}"{sort}>{shown}</td>'


def _format_films(groups: Sequence[RunGroup], budget: MediaBudget) -> list[str]:
    """Return, clip by clip, the film and the slice of the first seed of every group."""
    folders = [(group, group.runs[0].folder / "samples") for group in groups if group.runs]
    names = sorted({film.stem for _, folder in folders for film in folder.glob("clip*.gif")})
    sections = []
    for name in names:
        figures = []
        for group, folder in folders:
            caption = escape(", ".join(group.label) + f", seed {group.runs[0].record['seed']}")
            files = {"film": folder / f"{name}.gif", "slice": folder / f"{name}_slice.png"}
            pictures = "".join(
                f'<img class="{kind}" src="{source}" alt="{kind} of {caption}">'
                for kind, file in files.items()
                if file.is_file() and (source := budget.embed(file))
            )
            if pictures:
                figures.append(f"<figure><figcaption>{caption}</figcaption>{pictures}</figure>")
        if figures:
            body = "\n".join(figures)
            sections.append(f'<h2>{escape(name)}</h2>\n<div class="films">\n{body}\n</div>')
    return sections
