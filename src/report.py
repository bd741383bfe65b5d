"""Tables and one HTML page of runs: python -m src.report run=out/sweep/table1."""

import re
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, ListConfig, OmegaConf

from src.app import entry_point
from src.app.instantiate import as_dict
from src.app.path_overrides import unquote_override
from src.records import results, runs
from src.records.atomic import write_text
from src.reports import page, run_groups, tables, writers
from src.reports.differences import build_difference_table
from src.reports.pairs import build_pair_table


@dataclass
class _ReportTables:
    """All tables of a report in their order, those of scores by title, those of differences between
    pairs, that of differences from `against`, and the groups of runs.
    """

    shown: list[tables.Table] = field(default_factory=list)
    scores: dict[str, tables.Table] = field(default_factory=dict)
    differences: list[tables.Table] = field(default_factory=list)
    against: list[tables.Table] = field(default_factory=list)
    groups: list[run_groups.RunGroup] = field(default_factory=list)


def report(cfg: DictConfig) -> list[tables.Table]:
    """Write `report.md`, `.csv` and `.html` of the runs below `cfg.run`; return the tables.

    With `columns` the Markdown has these of the scores or of the differences, no other table and no
    command.  With `into` it also replaces that file's section of the same title.
    """
    folders, out = _list_folders("run", cfg.run), Path(cfg.paths.run)
    if not cfg.media_mib >= 0:
        raise ValueError(f"media_mib must be >= 0, got {cfg.media_mib}")
    found, plans = runs.find_runs(folders), list(map(_as_typed, runs.find_sweeps(folders)))
    names = {run.record.get("asked", {}).get("config", "") for run in found}
    title = cfg.title or (names.pop() if len(names) == 1 else "") or "runs"
    if cfg.into:
        writers.split_at_section(Path(cfg.into), title)
    columns = None if cfg.columns is None else _list_texts(cfg.columns)
    if columns == []:
        raise ValueError("columns must name one score or more, got []")
    made = _build_tables(cfg, found, plans, columns)
    commands = [plan.command for plan in plans]
    text = _format_text(made, commands, columns)
    results.create_run_folder(out, entry_point.resolved_yaml(cfg))
    write_text(out / "report.md", text)
    write_text(out / "report.csv", writers.format_csv_tables(made.shown))
    html = page.format_html(
        title,
        made.shown,
        made.groups,
        runs.find_charts_and_stress_maps(folders),
        commands=commands,
        folder=out,
        media_bytes=int(cfg.media_mib * 2**20),
    )
    write_text(out / "report.html", html)
    if cfg.into:
        writers.replace_section(Path(cfg.into), title, text)
    print(f"{text}\nin {out}: report.md, report.csv, report.html")
    if unfinished := runs.find_unfinished_runs(folders):
        print(f"left out, without results.json: {', '.join(map(str, unfinished))}")
    return made.shown


def _build_tables(
    cfg: DictConfig,
    found: list[runs.Run],
    plans: list[runs.SweepPlan],
    columns: list[str] | None,
) -> _ReportTables:
    """Return the tables that have rows: those of each sweep, of `pairs`, and with `against`."""
    across, pairs = _list_texts(cfg.across), _list_pairs(cfg.pairs)
    run_groups.check_across(across, found)
    published, made = as_dict(cfg.paper), _ReportTables()
    sweeps = dict.fromkeys([*(run.sweep for run in found), *(plan.sweep for plan in plans)])
    for name in sweeps:
        own = [run for run in found if run.sweep == name]
        planned = [plan for plan in plans if plan.sweep == name]
        keys, groups = run_groups.group_runs(own, planned, across)
        of = f": {name}" if name and len(sweeps) > 1 else ""
        scores = tables.build_score_table(f"Scores and cost{of}", keys, groups, published)
        by_severity = tables.build_severity_table(f"Scores by severity{of}", keys, groups)
        references = tables.build_reference_methods_table(f"On the same clips{of}", keys, groups)
        built = (scores, by_severity, references)
        made.shown += [table for table in built if table and table.rows]
        made.scores |= {f"Scores{of}": scores} if scores.rows else {}
        made.groups += groups
        if pairs:
            table = build_pair_table(f"Differences{of}", keys, groups, pairs, columns)
            made.differences += [table] if table.rows else []
    made.shown += made.differences
    if cfg.against is not None:
        others = runs.find_runs(_list_folders("against", cfg.against))
        ours = run_groups.require_one_setting("run", found, across)
        theirs = run_groups.require_one_setting("against", others, across)
        title = "Differences on the same clips"
        table = build_difference_table(title, ours, theirs, published, across, columns)
        made.against += [table] if table.rows else []
    made.shown += made.against
    return made


def _format_text(made: _ReportTables, commands: list[str], columns: list[str] | None) -> str:
    """Return the Markdown: all tables, or the `columns` of the scores or of the differences between
    pairs, and of those from `against`.
    """
    if columns is None:
        return writers.format_markdown(made.shown, commands)
    scores = [tables.select_columns(table, columns, name) for name, table in made.scores.items()]
    return writers.format_markdown([*(made.differences or scores), *made.against], [])


def _as_typed(plan: runs.SweepPlan) -> runs.SweepPlan:
    """Return a sweep without the quotes that its paths have for Hydra, as its runs name them."""
    jobs = [list(map(unquote_override, job)) for job in plan.jobs]
    return replace(plan, command=re.sub(r"'([\w.+/~-]+)'", r"\1", plan.command), jobs=jobs)


def _list_pairs(given: Any) -> list[tuple[str, str]]:
    """Return `pairs`; ValueError where it is no list of two names each."""
    pairs: Any = OmegaConf.to_container(given) if isinstance(given, ListConfig) else given or []
    if not (isinstance(pairs, list) and all(isinstance(p, list) and len(p) == 2 for p in pairs)):
        raise ValueError(f"pairs must be a list of pairs, [[A,B],[C,D]], got {pairs}")
    return [(str(ours), str(theirs)) for ours, theirs in pairs]


def _list_folders(key: str, given: str | ListConfig) -> list[Path]:
    names = _list_texts(given)
    if not names or "" in names:
        raise ValueError(f"{key} must name one folder or more, got {names}")
    return list(map(Path, names))


def _list_texts(given: str | ListConfig) -> list[str]:
    return list(map(str, given)) if isinstance(given, ListConfig) else [str(given)]


if __name__ == "__main__":
    entry_point.run_command(report, "report")
