"""What is printed, on any terminal: missing signs are replaced, a warning or an error takes one
line."""

import codecs
import re
import sys
import warnings
from pathlib import Path
from typing import NoReturn, TextIO

SOURCE = Path(__file__).parents[1]
NEAREST = {"…": "..."} | dict(zip("•—–━╸╺↑↓", "*-----^v", strict=True))


def prepare_streams() -> None:
    """Make stdout and stderr print every text, and warnings of ours one line each."""
    codecs.register_error("nearest_sign", _replace)
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="nearest_sign")
    warnings.showwarning = _show_warning


def print_replaced_path(path: Path) -> None:
    """Print that the file or folder `path`, where it is there, will be replaced."""
    if path.exists():
        held = f", {len(list(path.iterdir()))} files," if path.is_dir() else ""
        print(f"{path}{held} is there and will be replaced")


def exit_with_error(message: str, code: int = 2) -> NoReturn:
    """Print `message` in one line on stderr and end the process with exit code `code`."""
    print("error: " + " ".join(message.split()), file=sys.stderr)
    sys.exit(code)


def cut_worker_traceback(message: str) -> str:
    """Return `message` of an error; of one that a worker of a DataLoader raised, which PyTorch
    hands on with its traceback, what it said there."""
    pattern = r"Caught (\w+) in DataLoader worker.*?\nOriginal Traceback.*\n\1: (.*)"
    found = re.fullmatch(pattern, message, re.DOTALL)
    return found[2] if found else message


def _replace(error: UnicodeError) -> tuple[str, int]:
    assert isinstance(error, UnicodeEncodeError)
    letters = error.object[error.start : error.end]
    return "".join(NEAREST.get(letter, "?") for letter in letters), error.end


def _show_warning(
    message: Warning | str, category: type[Warning], filename: str, lineno: int,
    file: TextIO | None = None, line: str | None = None,
) -> None:  # fmt: skip
    text = warnings.formatwarning(message, category, filename, lineno, line)
    path = Path(filename)  # an installed package lies in site-packages, too
    is_ours = "site-packages" not in path.parts or path.is_relative_to(SOURCE)
    if category is UserWarning and is_ours:
        text = f"warning: {' '.join(str(message).split())}\n"
    print(text, end="", file=file or sys.stderr)
