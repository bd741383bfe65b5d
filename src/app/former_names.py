"""Modules under the names they had before: old runs, checkpoints and scripts go on working."""

import importlib
import sys
from collections.abc import Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType

_TURBULENCE = "blur fidelity halo lattice p2s phase psf zernike"
_SCENES = "footage targets shapes pictures videos"
MOVED = {
    **{f"src.sim.{name}": f"src.sim.turbulence.{name}" for name in _TURBULENCE.split()},
    **{f"src.sim.{name}": f"src.sim.scenes.{name}" for name in _SCENES.split()},
    "src.sim.atmosphere": "src.sim.turbulence",
    "src.build": "src.app.build",
    "src.data": "src.training",
    "src.data.augment": "src.training.augment",
    "src.data.datamodule": "src.training.datamodule",
    "src.metrics.speed": "src.training.step_time",
    "src.models.interruption": "src.training.interruption",
    "src.models.reconstructor": "src.training.reconstructor",
    "src.probes": "src.bench.probes",
    "src.probes.air": "src.bench.probes.air",
    "src.probes.memory": "src.bench.probes.memory",
    "src.probes.numerics": "src.bench.probes.numerics",
    "src.probes.rates": "src.bench.probes.sampling",
    "src.probes.views": "src.bench.probes.light_field",
    "src.recordings.formats": "src.recordings.files.formats",
    "src.recordings.calibration.tasks": "src.app.calibrations",
    "src.recordings.targets": "src.recordings.calibration.boards",
}


class Finder(MetaPathFinder, Loader):
    """Imports a module of MOVED from where it is now; both names are the same module."""

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return how to import `name`, if it is a former name."""
        return ModuleSpec(name, self) if name in MOVED else None

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        """Return the module itself."""
        self.kept = importlib.import_module(MOVED[spec.name])
        self.spec = self.kept.__spec__
        return self.kept

    def exec_module(self, module: ModuleType) -> None:
        """Leave the module as it is: it has run under its own name."""
        module.__spec__ = self.spec


if not any(isinstance(finder, Finder) for finder in sys.meta_path):
    sys.meta_path.append(Finder())
