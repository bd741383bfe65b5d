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
    sweeps = dict.fromkeys(each.sweep for each in [*ours, *plans])
    for name in sweeps:
        own = [[each for each in all_of if each.sweep == name] for all_of in (ours, plans)]
        keys, made = cells.cells(*own, tuple(cfg.across))
        of = f": {name}" if name and len(sweeps) > 1 else ""
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
