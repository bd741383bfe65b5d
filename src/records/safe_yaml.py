"""YAML files from elsewhere: plain values without aliases, of bounded size and depth."""

from pathlib import Path
from typing import Any

import yaml

LARGEST_FILE = 2**18  # characters; nine views have 4,000, a resolved config 10,000
DEEPEST = 50  # lists and mappings within each other


class _Loader(yaml.SafeLoader):
    """Refuses aliases, which let a small file grow without bound, and what nests too deep."""

    depth = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError("an alias, which is not read")
        self.depth += 1
        if self.depth > DEEPEST:
            raise yaml.YAMLError(f"nested beyond {DEEPEST} levels")
        node = super().compose_node(parent, index)
        self.depth -= 1
        return node


def read(path: Path | str) -> Any:
    """Return the content of a file; raises OSError and, for all that is no such file, YAMLError."""
    try:
        with open(path, encoding="utf-8") as file:
            return parse(file.read(LARGEST_FILE + 1))
    except UnicodeDecodeError as error:
        raise yaml.YAMLError(str(error)) from error


def parse(text: str) -> Any:
    """Return the content of a text; raises YAMLError."""
    if len(text) > LARGEST_FILE:
        raise yaml.YAMLError(f"longer than {LARGEST_FILE} characters")
    try:
        return yaml.load(text, _Loader)
    except (ValueError, ArithmeticError) as error:  # a number or a date that is none
        raise yaml.YAMLError(str(error)) from error
