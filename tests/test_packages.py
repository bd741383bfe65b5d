"""Packages: no file name twice, no circles, imports one way, from entry points to simulation."""

import ast
from collections import Counter
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

from tests.conftest import ROOT

ORDER = (  # a package imports those before it
    "src.sim", "src.metrics", "src.losses", "src.records", "src.models", "src.deploy",
    "src.training", "baselines", "src.recordings", "src.bench", "src.figures", "src.reports",
    "src.app",
)  # fmt: skip
FILES = [file for package in ("src", "baselines") for file in (ROOT / package).rglob("*.py")]
NAMES = {".".join(file.relative_to(ROOT).with_suffix("").parts) for file in FILES}


def place(module: str) -> int:
    """The place of a module's package in ORDER; an entry point is behind them all."""
    fitting = [package for package in ORDER if f"{module}.".startswith(f"{package}.")]
    return ORDER.index(max(fitting, key=len)) if fitting else len(ORDER)


@cache
def imports(file: Path) -> set[str]:
    """The modules of this repository that a file imports, wherever in it."""
    found = set()
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.ImportFrom):
            names = {f"{node.module}.{part.name}" for part in node.names}
            found |= {name if name in NAMES else node.module for name in names}
        elif isinstance(node, ast.Import):
            found |= {part.name for part in node.names}
    return {name for name in found if name.split(".")[0] in ("src", "baselines")}


def test_no_file_name_is_in_two_packages():
    names = Counter(file.name for file in FILES if file.name != "__init__.py")
    assert [name for name, count in names.items() if count > 1] == []


def test_imports_go_one_way():
    up = [
        f"{file.relative_to(ROOT)} imports {name}"
        for file in FILES
        for name in imports(file)
        if place(name) > place(".".join(file.relative_to(ROOT).with_suffix("").parts))
        and name != "src"
    ]
    assert up == []


def test_entry_points_do_not_import_each_other():
    entry_points = {f"src.{file.stem}" for file in (ROOT / "src").glob("*.py")}
    known = {str(file.relative_to(ROOT)): imports(file) & entry_points for file in FILES}
    assert {file: names for file, names in known.items() if names} == {}


def test_modules_do_not_import_in_a_circle():
    graph = {".".join(f.relative_to(ROOT).with_suffix("").parts): imports(f) for f in FILES}
    TopologicalSorter(
        {name: found & graph.keys() - {name} for name, found in graph.items()}
    ).prepare()
