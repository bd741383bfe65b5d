"""Before and after a lease: all that it needs in one folder, and how to continue its exports."""

import shutil
from collections.abc import Mapping
from pathlib import Path

from omegaconf import OmegaConf

from scripts.lease.plan import MIB, Plan, load_plan, read_content, start_path
from scripts.lease.selection import Selection, allot_seconds, overhead_s
from src.metrics.lpips import BACKBONE_FOLDER
from src.models import files

MAX_FOLDER_MIB = 60


def gather_files(folder: Path, plan: Path, given: Mapping[str, Path]) -> str:
    """Copy `plan` and all files it names into `folder`, with `given` ones in their place; return a
    line that says what is there.

    Raises ValueError where a file is missing or damaged, or they are more than MAX_FOLDER_MIB
    together.
    """
    content = read_content(plan)
    names: dict[Path, str] = {}
    for key in ("scenes", "lpips"):
        if content.get(key) is None and key not in given:
            continue
        source = given.get(key) or plan.parent / content[key]
        if key == "lpips" and not source.is_file():
            source = BACKBONE_FOLDER / "alex.safetensors"
        names[source] = content[key] = source.name
    for network in content.networks:
        if network.get("start"):
            source = start_path(plan.parent, network.start)
            names[source] = network.start = f"start-{network.name}.safetensors"
    if missing := [str(source) for source in names if not source.is_file()]:
        raise ValueError(f"{plan} names missing files: {', '.join(missing)}")
    size = sum(source.stat().st_size for source in names) / MIB
    if size > MAX_FOLDER_MIB:
        each = ", ".join(f"{source} {source.stat().st_size / MIB:.1f}" for source in names)
        raise ValueError(f"folder must have at most {MAX_FOLDER_MIB} MiB, got {size:.1f}: {each}")
    folder.mkdir(parents=True, exist_ok=True)
    for source, name in names.items():
        shutil.copyfile(source, folder / name)
    OmegaConf.save(content, folder / "plan.yaml")
    load_plan(folder / "plan.yaml")
    return f"{folder}: {', '.join(['plan.yaml', *names.values()])}; {size:.1f} MiB"


def describe_selection(plan: Plan, selection: Selection, minutes: float) -> str:
    """Return what a lease of so many `minutes` does, a line for each network."""
    fixed = overhead_s(plan, selection.networks)
    networks = [one.network for one in selection.networks]
    lines = [f"{fixed / 60:.2f} of {minutes:g} minutes are check, cache, validation and margin"]
    seconds = allot_seconds(networks, 60 * minutes - fixed)
    for one, own in zip(selection.networks, seconds, strict=True):
        lines.append(
            f"{one.name}: {own / 60:.2f} min, {one.params:,} parameters, "
            f"{one.weights_bytes / MIB:.2f} MiB in {one.parts} files"
        )
    return "\n".join([*lines, *(f"{k} is left out: {v}" for k, v in selection.left_out.items())])


def describe_export(path: Path) -> str:
    """Return a line with the command that continues from a joined file."""
    card = files.read_card(path)
    overrides = " ".join([f"experiment={card['experiment']}", *card["overrides"]])
    return (
        f"{path}: {card['steps']} steps, {card['windows']} windows, {card['hours']:.4f} h; "
        f"continue: python -m src.train {overrides} ckpt={path} train_hours=<more>"
    )
