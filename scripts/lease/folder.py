"""Before and after a lease: all that it needs in one folder, and what its exports go on with."""

import shutil
from collections.abc import Mapping
from pathlib import Path

from omegaconf import OmegaConf

from scripts.lease.fit import Fit, allotted, overhead
from scripts.lease.plan import MIB, Plan, load
from src.metrics.lpips import CACHE
from src.models import files
from src.records.atomic import written


def gather(folder: Path, plan: Path, given: Mapping[str, Path], most_mib: float) -> str:
    """Copy `plan` and all files it names into `folder`, with `given` ones in their place; returns
    a line that says what is there.

    Raises ValueError where a file is missing or damaged, or they are more than `most_mib` together.
    """
    content = OmegaConf.load(plan)
    taken = {}
    for key in ("scenes", "lpips"):
        named = content.get(key)
        if named is None and key not in given:
            continue
        source = given.get(key) or plan.parent / named
        if key == "lpips" and not source.is_file():
            source = CACHE / "alex.safetensors"
        taken[source] = content[key] = source.name
    for network in content.networks:
        if network.get("start"):
            source = plan.parent / network.start
            taken[source] = network.start = f"start-{network.name}.safetensors"
    if missing := [str(source) for source in taken if not source.is_file()]:
        raise ValueError(f"{plan} names files that are not there: {', '.join(missing)}")
    size = sum(source.stat().st_size for source in taken)
    if size > most_mib * MIB:
        each = ", ".join(f"{source} {source.stat().st_size / MIB:.1f}" for source in taken)
        raise ValueError(f"folder must have at most {most_mib:g} MiB, got {size / MIB:.1f}: {each}")
    folder.mkdir(parents=True, exist_ok=True)
    for source, name in taken.items():
        with written(folder / name) as partial:
            shutil.copyfile(source, partial)
    with written(folder / "plan.yaml") as partial:
        partial.write_text(OmegaConf.to_yaml(content))
    load(folder / "plan.yaml")
    names = ", ".join(["plan.yaml", *taken.values()])
    return f"{folder}: {names}; {size / MIB:.1f} MiB"


def described(plan: Plan, fit: Fit, minutes: float) -> str:
    """Return what a lease of so many `minutes` does, a line for each network."""
    fixed = overhead(plan, fit.networks)
    seconds = allotted([one.network for one in fit.networks], 60 * minutes - fixed)
    lines = [f"{fixed / 60:.2f} of {minutes:g} minutes are check, cache, validation and margin"]
    for one, own in zip(fit.networks, seconds, strict=True):
        beside = [
            "its last export stays until the next is whole" * (one.name in fit.doubled),
            "with its checkpoint" * (one.name in fit.checkpoints),
        ]
        told = ", ".join(text for text in beside if text) or "weights only, replaced at once"
        lines.append(
            f"{one.name}: {own / 60:.2f} min, {one.params:,} parameters, "
            f"{one.weights / MIB:.2f} MiB in {one.parts} files; {told}"
        )
    lines += [f"{name} is left out: {reason}" for name, reason in fit.left_out.items()]
    return "\n".join(lines)


def going_on(path: Path) -> str:
    """Return a line with what a training goes on from a joined file by."""
    if not files.exported(path):
        return (
            f"{path}: a checkpoint, with the optimiser's moments; ckpt={path} goes on from it too"
        )
    card = files.card(path)
    words = [f"experiment={card['experiment']}", *card["overrides"]]
    return (
        f"{path}: {card['steps']} steps, {card['windows']} windows, {card['hours']:.4f} h; go on: "
        f"python -m src.train {' '.join(words)} ckpt={path} hours=<more>"
    )
