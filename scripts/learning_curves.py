"""Learning curves as a figure: python -m scripts.learning_curves FOLDER ... [--out FILE]

Each FOLDER is a run of src.train with a curve.csv, or has such runs below it: the parts of one
training of a campaign, of which the newest curve has all lines.
"""

import argparse
import csv
from pathlib import Path

from src.figures import learning


def curve(folder: Path) -> list[dict[str, float]]:
    """Return the lines of the newest curve.csv in `folder` or below; none where there is none."""
    files = sorted(folder.rglob("curve.csv"), key=lambda path: path.stat().st_mtime)
    if not files:
        return []
    with files[-1].open() as file:
        rows = csv.DictReader(file)
        return [{name: float(value or "nan") for name, value in row.items()} for row in rows]


def main() -> None:
    """Read the arguments."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--out", type=Path, default=Path("out/learning.png"))
    given = parser.parse_args()
    print(learning.draw(given.out, {folder.name: curve(folder) for folder in given.folders}))


if __name__ == "__main__":
    main()
