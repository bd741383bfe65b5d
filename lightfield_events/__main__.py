"""The commands of the installed package: lightfield-events reconstruct recording=cap.raw ..."""

import sys
from importlib.util import find_spec
from pathlib import Path
from runpy import run_module

COMMANDS = (
    "train", "eval", "simulate", "reconstruct", "convert", "calibrate", "compare", "chart",
    "stress", "report", "live",
)  # fmt: skip


def main() -> None:
    """Run `src.<command>` with the rest of the command line."""
    import src
    from src.app.before_imports import answer_before_imports

    src.shorten_interruption()
    name = sys.argv[1] if len(sys.argv) > 1 else "--help"
    if name not in COMMANDS:
        print(f"usage: lightfield-events {{{','.join(COMMANDS)}}} [key=value ...]")
        sys.exit(0 if name in ("-h", "--help") else 2)
    if find_spec("lightning") is None:
        where = "in the folder of the repository"
        print(f'error: commands need pip install ".[train]" {where}', file=sys.stderr)
        sys.exit(1)
    file = str(Path(src.__path__[0]) / f"{name}.py")
    sys.argv[:2] = [file]
    answer_before_imports(name, Path(file))
    run_module(f"{src.__name__}.{name}", run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main()
