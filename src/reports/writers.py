"""A table as Markdown and CSV; a section of a document replaced between its markers."""

import math
from collections.abc import Sequence
from decimal import ROUND_HALF_UP, Decimal
from pathlib import Path

from src.metrics.table import Column
from src.records import results
from src.records.atomic import write_text
from src.reports.tables import Table, TableCell


def format_markdown(tables: Sequence[Table], commands: Sequence[str] = ()) -> str:
    """Return the tables with their titles, remarks and commands; best values are bold."""
    parts = [f"`{command}`" for command in commands]
    for table in tables:
        rules = ["---" if place < table.labels else "--:" for place in range(len(table.columns))]
        heads = [f"{c.group}: " * bool(c.group) + c.title for c in table.columns]
        lines = [f"**{_escape(table.title)}**", "", _format_line(heads), _format_line(rules)]
        for number, row in enumerate(table.rows):
            texts = []
            for place, cell in enumerate(row):
                text = _escape(format_cell(cell, table.columns[place]))
                texts.append(f"**{text}**" if table.is_bold(number, place) else text)
            lines.append(_format_line(texts))
        parts += ["\n".join(lines), *([_escape(table.note)] if table.note else [])]
    return "\n\n".join(parts) + "\n"


def format_csv_tables(tables: Sequence[Table]) -> str:
    """Return the tables one under another, full precision, mean and std in columns."""
    text = ""
    for table in tables:
        heads, lines = ["table"], [list[object]([table.title]) for _ in table.rows]
        for column, *cells in zip(table.columns, *table.rows, strict=True):
            with_std = any(cell.std is not None for cell in cells)
            with_interval = any(cell.interval is not None for cell in cells)
            heads += [column.name, *([f"{column.name}_std"] if with_std else [])]
            heads += [f"{column.name}_{end}" for end in ("low", "high")] if with_interval else []
            for line, cell in zip(lines, cells, strict=True):
                line.append(cell.text if cell.mean is None else cell.mean)
                line += ["" if cell.std is None else cell.std] if with_std else []
                line += cell.interval or ("", "") if with_interval else []
        text += results.format_csv(heads, lines)
    return text


def replace_section(document: Path, name: str, text: str) -> None:
    """Put `text` between the markers `<!-- report:name -->` and `<!-- end:name -->`, atomically.

    A document without them gets a section of that name at its end.  Raises ValueError as
    `split_at_section`.
    """
    start, end = _markers(name)
    before, after = split_at_section(document, name)
    write_text(document, f"{before}{start}\n\n{text.strip()}\n\n{end}{after}")


def split_at_section(document: Path, name: str) -> tuple[str, str]:
    """Return what is before and after the section `name`.

    Raises ValueError where the document is not there, or the markers are not one pair.
    """
    if not document.is_file():
        raise ValueError(f"into must be a file, got {document}")
    start, end = _markers(name)
    content = document.read_text()
    if start not in content and end not in content:
        content = f"{content.rstrip()}\n\n## {name}\n\n{start}\n{end}\n"
    if (content.count(start), content.count(end)) != (1, 1) or end not in content.split(start)[1]:
        raise ValueError(f"into must hold {start} and after it {end} once, got {document}")
    before, rest = content.split(start)
    return before, rest.split(end)[1]


def _markers(name: str) -> tuple[str, str]:
    return f"<!-- report:{name} -->", f"<!-- end:{name} -->"


def format_cell(cell: TableCell, column: Column) -> str:
    """Return a cell as people read it: a text, a mean, a mean ± its std, or a dash; in parentheses
    what was published.  A difference has a sign and, in parentheses, its CI if it has one.
    """
    if cell.text:
        return cell.text
    if cell.mean is None:
        return "-"
    if math.isnan(cell.mean):
        return "nan"
    if cell.interval is not None:
        difference, *ends = (f"{x:+.{column.digits}f}" for x in (cell.mean, *cell.interval))
        return difference if math.isnan(cell.interval[0]) else f"{difference} ({' to '.join(ends)})"
    number = f"{cell.mean:,.{column.digits}f}"
    number += "" if cell.std is None else f" ± {cell.std:.{column.digits}f}"
    published = "" if cell.published is None else round_decimal(cell.published, column.digits)
    return number + f" ({published})" * bool(published)


def round_decimal(value: float, digits: int) -> str:
    """Return `value`, as it is written in decimals, rounded half up: the float 0.5215 is less."""
    return f"{Decimal(repr(value)).quantize(Decimal(1).scaleb(-digits), ROUND_HALF_UP):f}"


def _format_line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _escape(text: str) -> str:
    return text.replace("\n", " ").replace("|", r"\|").replace("<", "&lt;")
