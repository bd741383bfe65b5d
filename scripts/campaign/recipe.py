"""Recipes: `conf/recipe/<network>.yaml`, the stages that make one shipped network from nothing."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import yaml
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

ROOT = Path(__file__).resolve().parents[2]
RECIPES = ROOT / "conf" / "recipe"


class Stage(NamedTuple):
    """One stage: a training, a widening or a mean of weights; exactly one of the last three is set.

    `hours`: training time of the network at the end of the stage, of all its trainings together;
    above that of what it goes on from.
    `widen`: a stage or recipe whose SetNet is widened to the one of this recipe (Net2Net).
    `mean`: stage names with their shares, which add up to 1 (Wortsman et al. 2022).
    """

    name: str
    overrides: Sequence[str] = ()
    start: str | None = None  # stage or recipe to go on from; None: the stage before
    seed: int = 0
    hours: float | None = None
    widen: str | None = None
    mean: dict[str, float] | None = None


class Recipe(NamedTuple):
    """A network, what all its trainings share, and its stages in order.

    `after`: recipes whose networks the stages name in braces, as in `teachers=[{lf3x3}]`.
    """

    name: str
    experiment: str
    overrides: list[str]
    stages: list[Stage]
    after: Sequence[str] = ()


def read(name: str) -> Recipe:
    """Return the recipe `name` of conf/recipe, or of such a YAML file.

    Raises ValueError in one line for a file that is not there or is no recipe.
    """
    path = Path(name) if name.endswith(".yaml") else RECIPES / f"{name}.yaml"
    if not path.is_file():
        raise ValueError(f"recipe must be one of {', '.join(names())} or a YAML file, got {name}")
    try:
        content: Any = OmegaConf.to_container(OmegaConf.load(path), resolve=True)
        stages = [Stage(**stage) for stage in content.pop("stages")]
        recipe = Recipe(**({"name": path.stem, "overrides": []} | content), stages=stages)
    except (
        OSError, KeyError, TypeError, AttributeError, OmegaConfBaseException, yaml.YAMLError
    ) as error:  # fmt: skip
        raise ValueError(
            f"{path} must be of the form of conf/recipe/lf3x3.yaml: {error}"
        ) from error
    _check(recipe)
    return recipe


def names() -> list[str]:
    """Return the recipes of conf/recipe in alphabetical order."""
    return sorted(
        str(path.relative_to(RECIPES).with_suffix("")) for path in RECIPES.rglob("*.yaml")
    )


def reached_hours(recipe: Recipe, others: Mapping[str, float] | None = None) -> float:
    """Return the training time of the network of `recipe`; `others`: those of networks by name.

    Raises ValueError for a stage whose hours are at most those of what it goes on from.
    """
    reached, before = dict(others or {}), 0.0
    for stage in recipe.stages:
        start = reached.get(stage.start, 0.0) if stage.start else before
        if stage.widen is not None:
            start = reached.get(stage.widen, 0.0)
        if stage.mean is not None:
            start = reached[list(stage.mean)[-1]]
        if stage.hours is not None and stage.hours <= start:
            allowed = f"above the {start:g} of what it goes on from, got {stage.hours:g}"
            raise ValueError(
                f"hours of stage {stage.name} of recipe {recipe.name} must be {allowed}"
            )
        reached[stage.name] = before = start if stage.hours is None else stage.hours
    return before


KINDS = {  # of the values of a recipe and its stages
    "text": lambda value: isinstance(value, str),
    "a number": lambda value: isinstance(value, int | float) and type(value) is not bool,
    "a whole number": lambda value: type(value) is int,
    "a list of texts": lambda value: (
        isinstance(value, list | tuple) and all(isinstance(one, str) for one in value)
    ),
    "stages with numbers": lambda value: (
        isinstance(value, dict) and all(map(KINDS["a number"], value.values()))
    ),
}
RECIPE_KINDS = {
    "name": "text", "experiment": "text", "overrides": "a list of texts",
    "after": "a list of texts",
}  # fmt: skip
STAGE_KINDS = {
    "name": "text", "overrides": "a list of texts", "start": "text", "seed": "a whole number",
    "hours": "a number", "widen": "text", "mean": "stages with numbers",
}  # fmt: skip


def _check(recipe: Recipe) -> None:
    """Raise ValueError for values of another kind, and for stages without a name of their own, of
    two kinds or out of order."""
    known: list[str] = []
    _check_kinds(recipe, RECIPE_KINDS, f"recipe {recipe.name}")
    for stage in recipe.stages:
        where = f"stage {stage.name} of recipe {recipe.name}"
        _check_kinds(stage, STAGE_KINDS, where)
        if stage.name in known:
            raise ValueError(f"{where} must have a name of its own")
        if sum(kind is not None for kind in (stage.hours, stage.widen, stage.mean)) != 1:
            raise ValueError(f"{where} must have one of hours, widen and mean")
        if stage.hours is not None and not 0 < stage.hours < 1e4:
            raise ValueError(f"hours of {where} must be in (0, 10000), got {stage.hours}")
        shares = stage.mean or {}
        if stage.mean is not None and not (set(shares) <= set(known) and _adds_up(shares)):
            raise ValueError(f"mean of {where} must share 1 among stages before it, got {shares}")
        known.append(stage.name)
    if not recipe.stages:
        raise ValueError(f"recipe {recipe.name} must have stages, got none")
    reached_hours(recipe)


def _check_kinds(values: Recipe | Stage, kinds: Mapping[str, str], where: str) -> None:
    for key, kind in kinds.items():
        value = getattr(values, key)
        is_left_out = value is None and values._field_defaults.get(key, "") is None
        if not (is_left_out or KINDS[kind](value)):
            raise ValueError(f"{key} of {where} must be {kind}, got {value!r}")


def _adds_up(shares: dict[str, float]) -> bool:
    return abs(sum(shares.values()) - 1) < 1e-6
