"""A table as Markdown, CSV and LaTeX; a section of a document replaced between its markers."""

import re
from itertools import groupby
from pathlib import Path

from src.records import results
from src.reports.tables import Column, Table, Value

ARROWS = {1: " ↑", -1: " ↓", 0: ""}
LATEX = {"&": r"\&", "%": r"\%", "_": r"\_", "#": r"\#", "$": r"\$", "{": r"\{", "}": r"\}"}
LATEX |= {"~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "\\": r"\textbackslash{}"}
LATEX |= {"±": r"$\pm$", "×": r"$\times$", "↑": r"$\uparrow$", "↓": r"$\downarrow$"}


def markdown(tables: list[Table], commands: list[str] = ()) -> str:
    """Return the tables with their titles, marks and commands."""
    parts = [f"`{command}`" for command in commands]
    for table in tables:
        heads = [head_text(column) for column in table.columns]
        rules = ["---" if place < table.labels else "--:" for place in range(len(heads))]
        lines = [f"**{_escaped(table.title)}**", "", _line(heads), _line(rules)]
        for row in table.rows:
            texts = []
            for place, value in enumerate(row):
                written = _escaped(value_text(value, table.columns[place]))
                texts.append(f"**{written}**" if is_best(table, place, value) else written)
            lines.append(_line(texts))
        parts += ["\n".join(lines), *map(_escaped, remarks(table))]
    return "\n\n".join(parts) + "\n"


def comma_separated(tables: list[Table]) -> str:
    """Return the tables one under another, full precision, mean and spread in columns."""
    text = ""
    for table in tables:
        names = []
        for place, column in enumerate(table.columns):
            spread = any(row[place].spread is not None for row in table.rows)
            names += [column.name, f"{column.name}_std"] if spread else [column.name]
        lines = []
        for row in table.rows:
            cells = [table.title]
            for value, column in zip(row, table.columns, strict=True):
                cells.append(value.words if value.mean is None else value.mean)
                if f"{column.name}_std" in names:
                    cells.append("" if value.spread is None else value.spread)
            lines.append(cells)
        text += results.csv_text(["table", *names], lines)
    return text


def latex(tables: list[Table]) -> str:
    """Return one booktabs `table` environment per table; best values are bold."""
    return "\n".join(map(_latex, tables))


def replace_section(document: Path, name: str, text: str) -> None:
    """Put `text` between the markers `<!-- report:name -->` and `<!-- end:name -->`, atomically.

    A document without them gets a section of that name at its end.  Raises ValueError where the
    document is not there, or the markers are not one pair.
    """
    if not document.is_file():
        raise ValueError(f"into must be a file, got {document}")
    start, end = f"<!-- report:{name} -->", f"<!-- end:{name} -->"
    content = document.read_text()
    if start not in content and end not in content:
        content = f"{content.rstrip()}\n\n## {name}\n\n{start}\n{end}\n"
    if (content.count(start), content.count(end)) != (1, 1) or end not in content.split(start)[1]:
        raise ValueError(f"into must hold {start} and after it {end} once, got {document}")
    before, rest = content.split(start)
    after = rest.split(end)[1]
    results.write_text(document, f"{before}{start}\n\n{text.strip()}\n\n{end}{after}")


def value_text(value: Value, column: Column) -> str:
    """Return a value as people read it: words, a mean, a mean ± its spread, or a dash."""
    if value.words:
        return value.words
    if value.mean is None:
        return "-"
    number = f"{value.mean:,.{column.digits}f}"
    return number if value.spread is None else f"{number} ± {value.spread:.{column.digits}f}"


def head_text(column: Column) -> str:
    """Return the head of a column with its group before it and its arrow after it."""
    group = f"{column.group}: " if column.group else ""
    return group + column.head + ARROWS[column.better]


def is_best(table: Table, place: int, value: Value) -> bool:
    """Return whether `value` is the best of its column, as printed."""
    best = table.best(place)
    digits = table.columns[place].digits
    return best is not None and value.mean is not None and round(value.mean, digits) == best


def remarks(table: Table) -> list[str]:
    """Return the marks of a table, numbered, and its note."""
    numbered = [f"[{number}] {mark}" for number, mark in enumerate(table.marks, 1)]
    return [*numbered, table.note] if table.note else numbered


def _line(cells: list[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _escaped(text: str) -> str:
    return text.replace("\n", " ").replace("|", r"\|").replace("<", "&lt;")


def _tex(text: str) -> str:
    return re.sub(".", lambda match: LATEX.get(match[0], match[0]), text)


def _latex(table: Table) -> str:
    heads = [_tex(column.head + ARROWS[column.better]) for column in table.columns]
    lines = [*_latex_groups(table.columns), " & ".join(heads) + r" \\", r"\midrule"]
    for row in table.rows:
        texts = []
        for place, value in enumerate(row):
            written = _tex(value_text(value, table.columns[place]))
            best = is_best(table, place, value)
            texts.append(rf"\textbf{{{written}}}" if best else written)
        lines.append(" & ".join(texts) + r" \\")
    shape = "l" * table.labels + "r" * (len(table.columns) - table.labels)
    body = "\n".join(lines)
    caption = _tex(" ".join([f"{table.title}.", *remarks(table)]))
    return (
        "% needs \\usepackage{booktabs}\n\\begin{table}\n\\centering\n"
        f"\\caption{{{caption}}}\n\\begin{{tabular}}{{{shape}}}\n\\toprule\n{body}\n"
        "\\bottomrule\n\\end{tabular}\n\\end{table}\n"
    )


def _latex_groups(columns: list[Column]) -> list[str]:
    """Return the row of groups above the heads and the rules below it; none without groups."""
    cells, rules, first = [], [], 1
    for group, members in groupby(columns, key=lambda column: column.group):
        last = first + len(list(members)) - 1
        cells.append(rf"\multicolumn{{{last - first + 1}}}{{c}}{{{_tex(group)}}}")
        rules += [rf"\cmidrule(lr){{{first}-{last}}}"] if group else []
        first = last + 1
    return [" & ".join(cells) + r" \\", " ".join(rules)] if rules else []
