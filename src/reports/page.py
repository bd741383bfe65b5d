"""One HTML page that opens from disk: tables that sort, films and slices of every row, figures."""

import base64
from html import escape
from itertools import groupby
from pathlib import Path

from src.reports.cells import Cell
from src.reports.tables import Column, Table, Value
from src.reports.writers import ARROWS, is_best, remarks, value_text

TEMPLATE = Path(__file__).with_name("page.html")
TYPES = {".gif": "image/gif", ".png": "image/png", ".svg": "image/svg+xml"}


def html(
    title: str,
    tables: list[Table],
    cells: list[Cell],
    figures: list[Path],
    *,
    commands: list[str],
    media_bytes: int,
) -> str:
    """Return the page; pictures are in it until `media_bytes` are spent, the rest is named."""
    budget = Budget(media_bytes)
    commits = sorted({run.record["git"] for cell in cells for run in cell.runs})
    head = [f"<p><code>{escape(command)}</code></p>" for command in commands]
    head.append(f"<p>Code at {escape(', '.join(commits))}.</p>" if commits else "")
    body = [_table(table) for table in tables]
    body += [_figure(figure, budget) for figure in figures]
    body += _films(cells, budget)
    if budget.left_out:
        names = ", ".join(map(escape, budget.left_out))
        body.append(f"<p>Left out to keep the page small (media_mib): {names}.</p>")
    parts = {"title": escape(title), "head": "\n".join(head), "body": "\n".join(body)}
    return _fill(TEMPLATE.read_text(), parts)


class Budget:
    """Bytes that pictures may still take; what found no room is listed in `left_out`."""

    def __init__(self, size: int):
        self.left, self.left_out = size, []

    def uri(self, file: Path) -> str | None:
        """Return the picture as a data URI, or None where it is too large for what is left."""
        size = file.stat().st_size * 4 // 3
        if size > self.left:
            self.left_out.append(str(file))
            return None
        self.left -= size
        return f"data:{TYPES[file.suffix]};base64,{base64.b64encode(file.read_bytes()).decode()}"


def _fill(template: str, parts: dict[str, str]) -> str:
    """Put the parts where {{name}} stands in the template; parts are not searched."""
    start, *others = template.split("{{")
    pieces = [start]
    for piece in others:
        name, rest = piece.split("}}", 1)
        pieces += [parts[name], rest]
    return "".join(pieces)


def _table(table: Table) -> str:
    groups = "".join(
        f'<th class="group" colspan="{len(list(members))}">{escape(group)}</th>'
        for group, members in groupby(table.columns, key=lambda column: column.group)
    )
    grouped = any(column.group for column in table.columns)
    heads = "".join(_head(column, k < table.labels) for k, column in enumerate(table.columns))
    rows = "\n".join(
        "<tr>" + "".join(_cell(table, place, value) for place, value in enumerate(row)) + "</tr>"
        for row in table.rows
    )
    notes = "\n".join(f"<p>{escape(note)}</p>" for note in remarks(table))
    return (
        f'<h2>{escape(table.title)}</h2>\n<div class="wide"><table><thead>\n'
        + (f"<tr>{groups}</tr>\n" if grouped else "")
        + f'<tr class="heads">{heads}</tr></thead>\n'
        + f"<tbody>\n{rows}\n</tbody></table></div>\n{notes}"
    )


def _head(column: Column, word: bool) -> str:
    kind = "word" if word else "other" if column.name.startswith("paper_") else ""
    return f'<th class="{kind}"><button>{escape(column.head + ARROWS[column.better])}</button></th>'


def _cell(table: Table, place: int, value: Value) -> str:
    column = table.columns[place]
    kind = "word" if place < table.labels else ""
    if column.name.startswith("paper_"):
        kind = "other"
    elif value.words == "missing":
        kind = "missing"
    key = "" if value.mean is None else repr(value.mean)
    written, *spread = value_text(value, column).split(" ± ")
    shown = escape(written) if value.words or value.mean is not None else "–"
    shown = f"<b>{shown}</b>" if is_best(table, place, value) else shown
    shown += f" <small>± {spread[0]}</small>" if value.spread is not None else ""
    sort = "" if value.words else f' data-value="{key}"'
    return f'<td class="{kind}"{sort}>{shown}</td>'


def _figure(file: Path, budget: Budget) -> str:
    source = budget.uri(file)
    if source is None:
        return ""
    head = f"<h2>{escape(file.stem.capitalize())}</h2>"
    return f'{head}\n<figure class="plot"><img src="{source}" alt=""></figure>'


def _films(cells: list[Cell], budget: Budget) -> list[str]:
    """Return, clip by clip, the film and the slice of the first seed of every cell."""
    shown = [(cell, cell.runs[0].folder / "samples") for cell in cells if cell.runs]
    names = sorted({film.stem for _, folder in shown for film in folder.glob("clip*.gif")})
    return [part for name in names if (part := _clip(name, shown, budget))]


def _clip(name: str, shown: list[tuple[Cell, Path]], budget: Budget) -> str:
    figures = []
    for cell, folder in shown:
        caption = escape(", ".join(cell.label) + f", seed {cell.runs[0].record['seed']}")
        files = [("film", folder / f"{name}.gif"), ("slice", folder / f"{name}_slice.png")]
        pictures = [
            f'<img class="{kind}" src="{source}" alt="{kind} of {caption}">'
            for kind, file in files
            if file.is_file() and (source := budget.uri(file))
        ]
        if pictures:
            both = "".join(pictures)
            figures.append(f"<figure><figcaption>{caption}</figcaption>{both}</figure>")
    if not figures:
        return ""
    return f'<h2>{escape(name)}</h2>\n<div class="films">\n' + "\n".join(figures) + "\n</div>"
