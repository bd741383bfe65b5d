"""By how much one network beats another: python -m scripts.margins --ours A B --theirs C D.

Each of A ... D is a folder of src.eval, one per seed, all on the same clips.  Prints a Markdown
table of ours minus theirs with the interval that holds 95 % of the differences when seeds and clips
are resampled, clips in pairs.
"""

import argparse
import csv
from pathlib import Path

from src.metrics.bootstrap import difference
from src.records.results import METRICS

NAMES = {"psnr_aligned": "aligned PSNR, dB", "psnr": "PSNR, dB", "lpips": "LPIPS", "ssim": "SSIM"}
NAMES |= {"wobble": "wobble, px"}
PAPER = {"psnr": 0.56, "ssim": 0.044, "lpips": -0.0275}  # nine views against one at 256, on REDS


def clips(folder: Path) -> list[dict[str, str]]:
    """Return the lines of the folder's clips.csv."""
    with (folder / "clips.csv").open() as file:
        return list(csv.DictReader(file))


def margins(ours: list[list[dict]], theirs: list[list[dict]]) -> str:
    """Return the table; rows of `ours` and `theirs` are seeds.

    Raises ValueError where the clips are not the same.
    """
    names = {tuple(clip["name"] for clip in seed) for seed in [*ours, *theirs]}
    if len(names) != 1:
        raise ValueError(f"every folder must hold the same clips, got {len(names)} sets of them")
    lines = ["| | ours | theirs | ours - theirs | 95 % | the paper's |", "|---" * 6 + "|"]
    for metric in METRICS:
        a, b = ([[float(clip[metric]) for clip in s] for s in side] for side in (ours, theirs))
        low, high = difference(a, b)
        left, right = _mean(a), _mean(b)
        paper = f"{PAPER[metric]:+.4g}" if metric in PAPER else "-"
        lines.append(
            f"| {NAMES[metric]} | {left:.4f} | {right:.4f} | {left - right:+.4f} "
            f"| {low:+.4f} to {high:+.4f} | {paper} |"
        )
    return "\n".join(lines)


def _mean(rows: list[list[float]]) -> float:
    return sum(map(sum, rows)) / sum(map(len, rows))


def main() -> None:
    """Read the arguments."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--ours", type=Path, nargs="+", required=True)
    parser.add_argument("--theirs", type=Path, nargs="+", required=True)
    arguments = parser.parse_args()
    print(margins(*([clips(f) for f in side] for side in (arguments.ours, arguments.theirs))))


if __name__ == "__main__":
    main()
