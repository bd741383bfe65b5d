"""The rooms: no file name twice, and imports go one way, from the doors down to the simulation."""

import ast
from collections import Counter
from pathlib import Path

from tests.conftest import ROOT

ORDER = (  # a room knows those before it
    "src.sim", "src.recordings.files", "src.metrics", "src.records", "src.models", "src.training",
    "baselines", "src.recordings", "src.bench", "src.figures", "src.reports", "src.app",
)  # fmt: skip
FILES = [file for room in ("src", "baselines") for file in (ROOT / room).rglob("*.py")]
NAMES = {".".join(file.relative_to(ROOT).with_suffix("").parts) for file in FILES}


def place(module: str) -> int:
    """Where a module's room stands in ORDER: that of the longest prefix; a door after them all."""
    fitting = [room for room in ORDER if f"{module}.".startswith(f"{room}.")]
    return ORDER.index(max(fitting, key=len)) if fitting else len(ORDER)


def imports(file: Path) -> set[str]:
    """The modules of the house that a file imports, wherever in it."""
    found = set()
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.ImportFrom):
            names = {f"{node.module}.{part.name}" for part in node.names}
            found |= {name if name in NAMES else node.module for name in names}
        elif isinstance(node, ast.Import):
            found |= {part.name for part in node.names}
    return {name for name in found if name.split(".")[0] in ("src", "baselines")}


def test_no_file_name_is_in_two_rooms():
    names = Counter(file.name for file in FILES if file.name != "__init__.py")
    assert [name for name, count in names.items() if count > 1] == []


def test_no_arrow_runs_back_up():
    up = [
        f"{file.relative_to(ROOT)} imports {name}"
        for file in FILES
        for name in imports(file)
        if place(name) > place(".".join(file.relative_to(ROOT).with_suffix("").parts))
        and name != "src"
    ]
    assert up == []


def test_doors_do_not_know_each_other():
    doors = {f"src.{file.stem}" for file in (ROOT / "src").glob("*.py")}
    known = {str(file.relative_to(ROOT)): imports(file) & doors for file in FILES}
    assert {file: names for file, names in known.items() if names} == {}
