"""A recipe at work: which stage is next, what it starts from, what it leaves behind."""

import re
import subprocess
import sys
from collections.abc import Collection
from pathlib import Path

import torch

from scripts.campaign.recipe import ROOT, Recipe, Stage
from scripts.campaign.training import Settings, Training
from src.app.compose import compose_checked_config
from src.app.path_overrides import is_path_key
from src.models import files


class RecipeWork:
    """The stages of `recipe` in the folder `settings.out/recipe`; each leaves a weights file there.

    `shipped`: where the network goes, its card and learning curve beside it, once all are done.
    """

    def __init__(self, recipe: Recipe, settings: Settings):
        self.recipe, self.settings = recipe, settings
        self.name, self.folder = recipe.name, settings.out / recipe.name
        self.trainings = {
            stage.name: Training(settings, self.folder / stage.name, stage.hours)
            for stage in recipe.stages
            if stage.hours is not None
        }

    @property
    def shipped(self) -> Path:
        """The weights of the last stage, with a card beside them, where all is done."""
        return self.settings.out / "weights" / f"{self.name}.safetensors"

    def state(self) -> str:
        """Return running, done, failed or waiting (for a turn, or for recipes of `after`)."""
        if self.shipped.is_file():
            return "done"
        training = self.trainings.get(self._stage().name)
        return training.state() if training and training.state() != "done" else "waiting"

    def ready(self, unfinished: Collection[str]) -> bool:
        """Return whether the networks that the stages name are there, and none of them is among the
        `unfinished` recipes of this campaign.
        """
        return all(self._network(name) and name not in unfinished for name in self.recipe.after)

    def advance(self) -> bool:
        """Do what takes no training, up to the next one; return whether there is one to start."""
        for stage in self.recipe.stages:
            if self._done(stage):
                continue
            if stage.name in self.trainings:
                return True
            (self._average if stage.widen is None else self._widen)(stage)
        self._ship(self.recipe.stages[-1])
        return False

    def start(self) -> None:
        """Start the training of the next stage."""
        stage = self._stage()
        self.trainings[stage.name].start(self._overrides(stage), self._start(stage))

    def line(self) -> str:
        """Return the line of `status`."""
        state, stage = self.state(), self._stage()
        training = self.trainings.get(stage.name)
        progress = f", {training.progress()}" if training else ""
        reason = f"; {training.reason()}" if training and state == "failed" else ""
        return f"{self.name}: {state}, {stage.name}{progress}{reason}"

    def check_stages(self) -> None:
        """Raise ValueError, naming the stage, for overrides that make no config."""
        for stage in self.recipe.stages:
            words = [re.sub(r"[{}]", "", word) for word in self._overrides(stage)]
            try:
                compose_checked_config("train", [], words)
            except ValueError as error:
                raise ValueError(f"stage {stage.name} of recipe {self.name}: {error}") from error

    def try_again(self) -> None:
        """Forget that trainings have failed."""
        for training in self.trainings.values():
            training.failed.unlink(missing_ok=True)

    def _stage(self) -> Stage:
        """Return the first stage that is not done, or the last."""
        stages = self.recipe.stages
        return next((stage for stage in stages if not self._done(stage)), stages[-1])

    def _done(self, stage: Stage) -> bool:
        if stage.name in self.trainings:
            return self.trainings[stage.name].state() == "done"
        return self._weights(stage.name).is_file()

    def _weights(self, stage: str) -> Path:
        return self.folder / f"{stage}.safetensors"

    def _network(self, name: str) -> str | None:
        """Return the weights of a stage, of a recipe of this campaign, or the shipped ones."""
        folders = self.folder, self.settings.out / "weights", files.WEIGHTS
        paths = (folder / f"{name}.safetensors" for folder in folders)
        return next((str(path.resolve()) for path in paths if path.is_file()), None)

    def _overrides(self, stage: Stage) -> list[str]:
        """Return the overrides of a training, names in braces replaced by weights."""
        known = {*self.recipe.after, *(one.name for one in self.recipe.stages)}
        paths = {name: path for name in known if (path := self._network(name))}
        common = [f"experiment={self.recipe.experiment}", *self.recipe.overrides]
        given = [*common, f"seed={stage.seed}", *stage.overrides, *self.settings.overrides]
        for name, path in paths.items():
            given = [word.replace(f"{{{name}}}", path) for word in given]
        return given

    def _start(self, stage: Stage) -> str | None:
        """Return the weights that a stage goes on from; None for the first."""
        if stage.start is not None:
            found = self._network(stage.start)
            if found is None:
                name = stage.name
                raise ValueError(f"start of stage {name} must be a network, got {stage.start}")
            return found
        before = self.recipe.stages[: self.recipe.stages.index(stage)]
        return str(self._weights(before[-1].name).resolve()) if before else None

    def _widen(self, stage: Stage) -> None:
        """Fill the network of this recipe from the smaller one that the stage names."""
        source = self._network(stage.widen or "")
        if source is None:
            raise ValueError(f"widen of stage {stage.name} must be a network, got {stage.widen}")
        self.folder.mkdir(parents=True, exist_ok=True)
        files_of = f"ckpt={source}", f"export={self._weights(stage.name)}"
        run("scripts.widen_setnet", *self._overrides(stage), *files_of)

    def _average(self, stage: Stage) -> None:
        shares = {self._weights(name): share for name, share in (stage.mean or {}).items()}
        average(shares, self._weights(stage.name))

    def _ship(self, stage: Stage) -> None:
        """Write the last stage's weights with card and learning curve to `shipped`."""
        last = [name for name in self.trainings if self._weights(name).is_file()][-1]
        given = ((word.split("=")[0].lstrip("+"), word) for word in self.settings.overrides)
        more = " ".join(word for key, word in given if not is_path_key(key, "train"))
        recipe = f"{self.name}, {more}" if more else self.name
        run(
            "scripts.ship_weights", str(self.folder / last), "--name", self.name, "--recipe",
            recipe, "--weights", str(self._weights(stage.name)), "--to",
            str(self.settings.out / "weights"),
        )  # fmt: skip


def run(module: str, *words: str) -> None:
    """Run a script of this repository; raises ValueError with its last line where it fails."""
    command = [sys.executable, "-m", module, *words]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    if done.returncode:
        last = (done.stderr.strip() or "no message").splitlines()[-1]
        raise ValueError(f"{module} failed: {last}")


@torch.no_grad()
def average(shares: dict[Path, float], export: Path) -> None:
    """Write the weighted mean of weights of one network (Wortsman et al. 2022), and the card of the
    last of them with `mean_of`.

    Raises ValueError where the files hold different networks.
    """
    networks = [files.load(path) for path in shares]
    states = [network.state_dict() for network in networks]
    shapes = [{name: value.shape for name, value in state.items()} for state in states]
    if any(other != shapes[0] for other in shapes):
        raise ValueError(f"mean must be of one network, got {', '.join(map(str, shares))}")
    parts = list(zip(states, shares.values(), strict=True))
    mean = {name: sum(share * state[name] for state, share in parts) for name in states[0]}
    networks[-1].load_state_dict(mean)
    last = list(shares)[-1]
    card = files.read_card(last) | {"mean_of": {path.stem: share for path, share in shares.items()}}
    files.save(export, networks[-1], files.read_network_spec(last), card)
