"""Tables and one HTML page of runs: python -m src.report run=out/sweep/table1."""

from pathlib import Path

import hydra
from omegaconf import DictConfig, ListConfig, OmegaConf

from src.app import door
from src.records import results, runs
from src.reports import cells, page, tables, writers
from src.reports.margins import margins


def report(cfg: DictConfig) -> list[tables.Table]:
    """Write `report.md`, `.csv`, `.tex` and `.html` of the runs below `cfg.run`; return the tables.

    With `into`, the Markdown also replaces that file's section of the same title.
    """
    folders, out = listed(cfg.run), Path(cfg.paths.run)
    ours, plans = runs.find(folders), runs.plans(folders)
    title = cfg.title or sweep_name(ours)
    paper = OmegaConf.to_container(cfg.paper)
    wanted, shown = [], []
    for name, members in by_sweep(ours).items():
        planned = [plan for plan in plans if plan.sweep == name]
        keys, made = cells.cells(members, planned, tuple(cfg.across))
        of = f": {name}" if len(members) < len(ours) and name else ""
        wanted += [
            tables.main(f"Scores and cost{of}", keys, made, paper),
            tables.by_severity(f"Severities apart{of}", keys, made),
            tables.compared(f"On the same clips{of}", keys, made),
        ]
        shown += made
    if cfg.against:
        theirs = runs.find(listed(cfg.against))
        wanted.append(margins("Clip by clip", ours, theirs, paper))
    drawn = [table for table in wanted if table and table.rows]
    commands, figures = [plan.command for plan in plans], runs.figures(folders)
    text = writers.markdown(drawn, commands)
    results.open_run(out, door.resolved(cfg))
    results.write_text(out / "report.md", text)
    results.write_text(out / "report.csv", writers.comma_separated(drawn))
    results.write_text(out / "report.tex", writers.latex(drawn))
    size = int(cfg.media_mib * 2**20)
    whole = page.html(title, drawn, shown, figures, commands=commands, media_bytes=size)
    results.write_text(out / "report.html", whole)
    if cfg.into:
        writers.replace_section(Path(cfg.into), title, text)
    print(f"{text}\nin {out}: report.md, report.csv, report.tex, report.html")
    return drawn


def listed(given: str | ListConfig) -> list[Path]:
    """Return one folder, or a list of them, as a list."""
    return [Path(str(folder)) for folder in (given if isinstance(given, ListConfig) else [given])]


def by_sweep(ours: list[runs.Run]) -> dict[str, list[runs.Run]]:
    """Return the runs of each sweep: they differ in settings of its own, which head its table."""
    return {name: [r for r in ours if r.sweep == name] for name in {run.sweep: 0 for run in ours}}


def sweep_name(ours: list[runs.Run]) -> str:
    """Return the config that all runs were asked for, such as table1; else `runs`."""
    names = {run.record.get("asked", {}).get("config", "") for run in ours}
    return names.pop() if len(names) == 1 and names != {""} else "runs"


@hydra.main(version_base=None, config_path="../conf", config_name="report")
def main(cfg: DictConfig) -> None:
    """Glue between Hydra and `report`."""
    door.job(report, cfg)


if __name__ == "__main__":
    door.run(main)
