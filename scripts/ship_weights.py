"""A trained network to weights/: python -m scripts.ship_weights RUN [--name NAME] [--test DIR ...]

Writes `weights/NAME.safetensors` (float16, spectral norm folded), its model card `NAME.md` and, of
a run with a learning curve, that as a figure.  RUN: a folder of src.train, or of a stage of a
campaign.  A name that is there already is refused without --replace.  Each DIR is one of src.eval
with these weights; where RUN is a name of weights/, only its card is written, with the scores in
the DIRs.  A campaign gives --recipe, the --weights of the last stage where they are not those of
RUN, and a folder --to write to instead of weights/.
"""

import argparse
import json
from pathlib import Path
from typing import NamedTuple

import torch
from omegaconf import DictConfig, OmegaConf

from scripts.learning_curves import draw_curves, read_curve
from src.app.script import run_script
from src.metrics.table import METRICS, Column
from src.models import files
from src.models.network import FramePostprocessor
from src.records import results
from src.records.atomic import atomic_path, write_text
from src.training.learning_curve import TRAINING_STATE

ROOT = Path(__file__).resolve().parents[1]
LARGEST = 16 * 2**20  # bytes of a file
CARD_NOTE = "Mean over clips (95 % bootstrap CI)."
CURVE = "The curve jumps where a stage has other validation clips."
LIMITS = """## Limits

Simulated turbulence and sensor only, grey pictures, scenes in planar motion.
"""


class Given(NamedTuple):
    """What a campaign says of a network: its recipe, other weights than those of the run, and the
    folder to write to; `replace`: weights of this name may be there already."""

    recipe: str | None = None
    weights: Path | None = None
    folder: Path | None = None  # None: weights/
    replace: bool = False


def ship(run: Path, name: str, tests: list[Path], given: Given | None = None) -> Path:
    """Write the weights of `run`, or those given, and their card; return the path of the weights.

    Raises ValueError for a run without a whole checkpoint, of a working tree that is no commit, for
    weights above 16 MiB, and for weights of this name unless `given.replace`; all that is there
    then stays.
    """
    given = given or Given()
    path = (given.folder or files.WEIGHTS) / f"{name}.safetensors"
    if path.exists() and not given.replace:
        raise ValueError(f"--name must be a new one, got {name}, which {path} has; or --replace")
    ckpt = files.newest_checkpoint(run)
    content = torch.load(ckpt, map_location="cpu", weights_only=True)
    card = facts(ckpt.parent.parent, content, first_config(run)) | going_on(content)
    if card["commit"].endswith("-dirty"):
        raise ValueError(f"weights are shipped from a commit, {run} is of {card['commit']}")
    network = files.load(given.weights or ckpt)
    if given.recipe:
        card = {"recipe": given.recipe} | card
    if given.weights and (shares := files.read_card(given.weights).get("mean_of")):
        card = {"mean_of": shares} | card
    with atomic_path(path) as partial:  # the weights come last: with them all is there
        files.save(partial, network, content["network"], card)
        if (size := partial.stat().st_size) > LARGEST:
            raise ValueError(f"weights must have at most {LARGEST} bytes, got {size} of {name}")
        rows, figure = read_curve(run), path.with_suffix(".png")
        if rows:
            draw_curves(figure, {name: rows})
        else:
            figure.unlink(missing_ok=True)  # of another network
        text = describe(name, network, card, _read_records(tests), bool(rows))
        write_text(path.with_suffix(".md"), f"{text}\n{LIMITS}")
    return path


def rewrite_card(name: str, tests: list[Path]) -> Path:
    """Write the card of shipped weights anew, with what `tests` hold; its sections, written by
    hand, stay.  Returns the weights' path."""
    path = files.WEIGHTS / f"{name}.safetensors"
    drawn, written = path.with_suffix(".png").is_file(), path.with_suffix(".md")
    facts = name, files.load(path), files.read_card(path), _read_records(tests), drawn
    write_text(written, describe(*facts) + _read_sections(written))
    return path


def _read_records(tests: list[Path]) -> list[dict]:
    return [json.loads((test / "results.json").read_text()) for test in tests]


def _read_sections(card: Path) -> str:
    """Return what a card has from its first section on, which is written by hand; of a network
    that has no card yet, its limits."""
    _, heading, rest = card.read_text().partition("\n## ") if card.is_file() else ("", "", "")
    return f"{heading}{rest}" if heading else f"\n{LIMITS}"


def facts(run: Path, content: dict, first: DictConfig) -> dict:
    """Return what the header of the file says of the training in the folder `run`, of which
    `content` is a checkpoint, and which began with the config `first`.
    """
    text = (run / "config.yaml").read_text()
    cfg = OmegaConf.create(text)
    return {
        "experiment": cfg.name,
        "started_from": _started_from(first),
        "seed": cfg.seed,
        "steps": content.get("steps", content["global_step"]),
        "windows_seen": content["windows"],
        "hours": round(content["seconds"] / 3600, 2),
        "clock": cfg.train_clock,
        "commit": _commit(run),
        "config_sha256": results.hash_config(text),
        "scenes": _scenes(cfg),
        "turbulence": cfg.turbulence.atmosphere.severity if cfg.turbulence.atmosphere else "none",
        "views": cfg.optics.views,
        "windows_per_s": list(cfg.data.get("rates") or [cfg.fps]),
        "windows": cfg.data.windows,
        "crop": cfg.data.crop,
        "batch_size": cfg.data.batch_size,
        "precision": cfg.trainer.precision,
    }


def _started_from(first: DictConfig) -> str:
    start = first.get("start", "none")
    return Path(first.ckpt or (start if start != "none" else "nothing")).name


def going_on(content: dict) -> dict:
    """Return what a training goes on from that begins with the shipped weights; nothing where the
    checkpoint `content` has no learning curve.
    """
    for name, state in content.get("callbacks", {}).items():
        if name.startswith("LearningCurve") and state["rows"]:
            counts = {"windows": content["windows"], "steps": content["steps"]}
            time = {"hours": content["seconds"] / 3600, "loss": state["loss"]}
            return {TRAINING_STATE: time | counts | {"curve": state["rows"]}}
    return {}


def _commit(run: Path) -> str:
    """Return the commit at which `run` ended; of one that has not, that of the working tree."""
    record = run / "results.json"
    return json.loads(record.read_text())["git"] if record.is_file() else results.git_commit()


def first_config(run: Path) -> DictConfig:
    """Return the config that a training began with: of its first part, or of the run that it went
    on from, as long as that is there.
    """
    parts = sorted(run.glob("part*/config.yaml"))
    cfg = OmegaConf.load(parts[0] if parts else run / "config.yaml")
    before = Path(cfg.ckpt or "nothing")
    for folder in (before, *before.parents[:2]):  # a run, its checkpoints or one of them
        if not files.is_weights_file(before) and (folder / "config.yaml").is_file():
            return first_config(folder)
    return cfg


def seen(network: torch.nn.Module) -> str:
    """Return what a network is given, in words."""
    if isinstance(network, FramePostprocessor):
        return "frames in, frames out"
    if network.views is not None:
        return f"{network.views} view(s)"
    one = type(network).__module__.startswith("baselines.")
    return "the centre view" if one else "any number of views"


def describe(
    name: str, network: torch.nn.Module, card: dict, tests: list[dict], drawn: bool
) -> str:
    """Return the model card as Markdown.

    `tests`: records of src.eval; `drawn`: there is a figure of the learning curve.
    """
    count = sum(parameter.numel() for parameter in network.parameters())
    lines = [
        f"# {name}",
        "",
        f"`{type(network).__name__}`, {count:,} parameters, {seen(network)}; `ckpt={name}`.",
        "",
        "| trained | |",
        "|---|---|",
        *(_fact(name, key, value) for key, value in card.items() if key != TRAINING_STATE),
        "",
        *([f"![learning curve]({Path(name).name}.png)", "", CURVE, ""] if drawn else []),
        "| tested on | clips | " + " | ".join(metric.heading for metric in METRICS) + " |",
        "|---|---|" + "---|" * len(METRICS),
        *map(_tested, tests),
        "",
        CARD_NOTE,
        "",
    ]
    return "\n".join(lines)


def _fact(name: str, key: str, value: object) -> str:
    if key == "recipe":
        recipe, comma, rest = str(value).partition(",")
        file = f"conf/recipe/{recipe}.yaml"
        if (ROOT / file).is_file():  # not that of another folder
            value = f"[{recipe}]({'../' * (name.count('/') + 1)}{file}){comma}{rest}"
    return f"| {key} | {value} |"


def _tested(record: dict) -> str:
    scores = record["test"]
    cells = [_cell(metric, scores.get(metric.name)) for metric in METRICS]
    given = [o for o in record["asked"].get("overrides", []) if not o.startswith("scene.root=")]
    what = f"`{' '.join(['python -m src.eval', *given])}`, at {record['git']}"
    return f"| {what} | {scores['clips']} | " + " | ".join(cells) + " |"


def _cell(metric: Column, score: dict | None) -> str:
    if score is None:
        return metric.format_value(None)
    mean, interval = metric.format_value(score["mean"]), score["interval"]
    return f"{mean} ({' to '.join(map(metric.format_value, interval))})" if interval else mean


def _scenes(cfg: DictConfig) -> str:
    kind = str(cfg.scene["_target_"]).rpartition(".")[2]
    root = cfg.scene.get("root")
    roots = [root] if isinstance(root, str) else root or []
    return f"{kind}, {', '.join(Path(one).name for one in roots) or 'embedded'}"


def main() -> None:
    """Read the arguments."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path, help="or a name of weights/")
    parser.add_argument("--name", help="default: the run's experiment")
    parser.add_argument("--recipe", help="of conf/recipe, for the card")
    parser.add_argument("--weights", type=Path, help="to ship instead of those of the run")
    parser.add_argument("--to", type=Path, help="default: weights/")
    parser.add_argument("--replace", action="store_true", help="weights of this name")
    parser.add_argument("--test", type=Path, nargs="*", default=[], help="folders of src.eval")
    arguments = parser.parse_args()
    shipped = files.WEIGHTS / f"{arguments.run}.safetensors"
    if shipped.is_file() and not arguments.run.is_dir():
        print(rewrite_card(str(arguments.run), arguments.test))
        return
    name = arguments.name or first_config(arguments.run).name
    given = Given(arguments.recipe, arguments.weights, arguments.to, arguments.replace)
    print(ship(arguments.run, name, arguments.test, given))


if __name__ == "__main__":
    run_script(main)
