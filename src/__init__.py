"""Packages and entry points of the project."""

import os
import sys
from pathlib import Path
from types import TracebackType

# The largest picture that is read: OpenCV looks at this when it is imported, so before all else.
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(2**27))

# Before the names src.* and baselines.* of configs and weights: "lightfield_events." where this is
# installed in that package (setup.py), else nothing.
HOME = __name__.removesuffix("src")
COMMAND = "lightfield-events " if HOME else "python -m src."  # what begins a command line


def add_package_prefix(name: str) -> str:
    """Return the name by which is imported what configs and weights call src.* or baselines.*."""
    return HOME + name if name.split(".")[0] in ("src", "baselines") else name


def shorten_interruption() -> None:
    """Make Ctrl-C that nothing catches, as in the seconds of imports, one line on stderr; the
    process still ends by SIGINT, exit code 130 of a shell."""
    sys.excepthook = _show_exception


def _show_exception(
    kind: type[BaseException], error: BaseException, trace: TracebackType | None
) -> None:
    if issubclass(kind, KeyboardInterrupt):
        print("stopped", file=sys.stderr)
    else:
        sys.__excepthook__(kind, error, trace)


def _answer_before_imports() -> None:
    """End `python -m src.<name>` where it asks for help or is wrong, before seconds of imports."""
    from src.app.before_imports import answer_before_imports

    package, _, name = sys.orig_argv[-len(sys.argv)].rpartition(".")
    file = Path(__file__).with_name(f"{name}.py")
    if package == "src" and file.is_file():
        answer_before_imports(name, file)


if sys.argv[:1] == ["-m"]:  # while Python looks for the module of `python -m src.<name>`
    shorten_interruption()
    _answer_before_imports()
