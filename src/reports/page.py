"""One HTML page that opens from disk: sortable tables, films and slices of every row, figures."""

import base64
import io
import math
import os
import re
from collections.abc import Sequence
from html import escape
from itertools import groupby
from pathlib import Path
from typing import Any

from PIL import Image, ImageSequence

from src.reports.run_groups import RunGroup
from src.reports.tables import Table
from src.reports.writers import format_cell

TEMPLATE = Path(__file__).with_name("page.html")
MEDIA_TYPES = {".gif": "image/gif", ".png": "image/png", ".svg": "image/svg+xml"}
AS_IT_IS_BYTES = 2**16  # of a picture; larger ones are written anew, smaller
FILM_WIDTH_PX, PICTURE_WIDTH_PX, QUALITY = 720, 1400, 55  # of WebP
LARGEST_GAIN = 30  # of bytes by that


class MediaBudget:
    """Bytes that pictures may still take in the page of `folder`; the number of those that do not
    fit is `left_out`.
    """

    def __init__(self, size: int, folder: Path):
        self.remaining, self.folder, self.left_out = size, folder, 0

    def show(self, file: Path, kind: str, words: str) -> str:
        """Return the picture as an `img` of class `kind` that holds it, a link to the file where it
        is too large for what remains.
        """
        if file.stat().st_size < LARGEST_GAIN * self.remaining:
            content, media_type = shrink_picture(file)
            data = base64.b64encode(content).decode()
            if len(data) <= self.remaining:
                self.remaining -= len(data)
                source = f"data:{media_type};base64,{data}"
                return f'<img class="{kind}" src="{source}" alt="{escape(words)}">'
        self.left_out += 1
        address = escape(os.path.relpath(file, self.folder))
        return f'<p><a href="{address}">{escape(kind)}: {address}</a></p>'


def shrink_picture(file: Path) -> tuple[bytes, str]:
    """Return a picture or film and its media type: drawings and small files as they are, others as
    WebP, at most PICTURE_WIDTH_PX or FILM_WIDTH_PX wide.
    """
    if file.suffix == ".svg" or file.stat().st_size <= AS_IT_IS_BYTES:
        return file.read_bytes(), MEDIA_TYPES[file.suffix]
    with Image.open(file) as picture:
        frames = [frame.convert("RGB") for frame in ImageSequence.Iterator(picture)]
        shown_ms = picture.info.get("duration", 0)
    width = min(frames[0].width, FILM_WIDTH_PX if len(frames) > 1 else PICTURE_WIDTH_PX)
    size = width, round(width * frames[0].height / frames[0].width)
    first, *rest = (frame.resize(size, Image.Resampling.BOX) for frame in frames)
    small = io.BytesIO()
    options: dict[str, Any] = {"quality": QUALITY, "method": 2}
    if rest:
        options |= {"save_all": True, "append_images": rest, "duration": shown_ms, "loop": 0}
    first.save(small, "WEBP", **options)
    return small.getvalue(), "image/webp"


def format_html(
    title: str, tables: Sequence[Table], groups: Sequence[RunGroup], figures: Sequence[Path], *,
    commands: Sequence[str], folder: Path, media_bytes: int,
) -> str:  # fmt: skip
    """Return the page of `folder`; pictures are in it until `media_bytes` are spent, the rest are
    links.
    """
    budget = MediaBudget(media_bytes, folder)
    commits = sorted({run.record["git"] for group in groups for run in group.runs})
    head = [f"<p><code>{escape(command)}</code></p>" for command in commands]
    head.append(f"<p>Code at {escape(', '.join(commits))}.</p>" if commits else "")
    body = [_format_table(table) for table in tables]
    for file in figures:
        heading = f"<h2>{escape(file.stem.capitalize())}</h2>"
        body.append(f"{heading}\n<figure>{budget.show(file, 'plot', file.stem)}</figure>")
    body += _format_films(groups, budget)
    if budget.left_out:
        body.append(f"<p>{budget.left_out} pictures are links: the page is full (media_mib).</p>")
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
        "<tr>" + "".join(_format_cell(table, n, k) for k in range(len(row))) + "</tr>"
        for n, row in enumerate(table.rows)
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


def _format_cell(table: Table, row: int, place: int) -> str:
    cell = table.rows[row][place]
    kind = "missing" if cell.text == "missing" else _column_kind(table, place)
    number, *std = format_cell(cell, table.columns[place]).split(" ± ")
    shown = escape(number) if cell.text or cell.mean is not None else "–"
    shown = f"<b>{shown}</b>" if table.is_bold(row, place) else shown
    shown += f" <small>± {std[0]}</small>" if cell.std is not None else ""
    value = "" if cell.mean is None or math.isnan(cell.mean) else repr(cell.mean)
    sort = "" if cell.text else f' data-value="{value}"'
    return f'<td class="{kind}"{sort}>{shown}</td>'


def _format_films(groups: Sequence[RunGroup], budget: MediaBudget) -> list[str]:
    """Return, clip by clip, the film and the slice of the first seed of every group."""
    folders = [(group, group.runs[0].folder / "samples") for group in groups if group.runs]
    names = sorted({film.stem for _, folder in folders for film in folder.glob("clip*.gif")})
    sections = []
    for name in names:
        figures = []
        for group, folder in folders:
            caption = ", ".join(group.label) + f", seed {group.runs[0].record['seed']}"
            files = {"film": folder / f"{name}.gif", "slice": folder / f"{name}_slice.png"}
            parts = [f"<figcaption>{escape(caption)}</figcaption>"]
            for kind, file in files.items():
                if file.is_file():
                    parts.append(budget.show(file, kind, f"{kind} of {caption}"))
            if len(parts) > 1:
                figures.append(f"<figure>{''.join(parts)}</figure>")
        body = "\n".join(figures)
        sections.append(f'<h2>{escape(name)}</h2>\n<div class="films">\n{body}\n</div>')
    return sections
