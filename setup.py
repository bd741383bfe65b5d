"""The wheel: everything inside the one package `lightfield_events`.

`src`, `baselines` and `conf` would be among all installed packages, where any project has such
names.  So they lie in `lightfield_events/`, and their imports are renamed as they are copied.
"""

import re
import shutil
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py

PACKAGE = "lightfield_events"
CODE = ("src", "baselines")
FOLDERS = {  # what is copied of each
    "src": (".py", ".yaml", ".html", ".safetensors", ".npz"),
    "baselines": (".py",),
    "conf": (".yaml",),
    "weights": (".safetensors", ".md"),
}
FROM = re.compile(rf"^(\s*)from ({'|'.join(CODE)})(?=[.\s])", re.M)
IMPORT = re.compile(rf"^(\s*)import ({'|'.join(CODE)})((?:\.\w+)*)$", re.M)


def rename_imports(text: str) -> str:
    """Return a module's text with its imports of this repository as they are in the wheel."""
    text = FROM.sub(rf"\1from {PACKAGE}.\2", text)
    return IMPORT.sub(rf"\1import {PACKAGE}.\2\3; from {PACKAGE} import \2", text)


class BuildOnePackage(build_py):
    """Copies the folders into the package; an editable installation uses them where they are."""

    def run(self) -> None:
        if self.editable_mode:
            super().run()
            return
        home, root = Path(self.build_lib) / PACKAGE, Path(__file__).parent
        shutil.rmtree(home, ignore_errors=True)  # what an earlier build left
        for name, endings in ({PACKAGE: (".py", ".typed")} | FOLDERS).items():
            for file in sorted((root / name).rglob("*")):
                if file.suffix in endings:
                    place = file.relative_to(root / PACKAGE if name == PACKAGE else root)
                    self._copy(file, home / place)

    def _copy(self, file: Path, target: Path) -> None:
        target.parent.mkdir(parents=True, exist_ok=True)
        if file.suffix == ".py":
            target.write_text(rename_imports(file.read_text("utf-8")), "utf-8")
        else:
            shutil.copyfile(file, target)


if __name__ == "__main__":
    setup(cmdclass={"build_py": BuildOnePackage}, packages=[PACKAGE, *CODE])
