"""The map of the sweep `air`: python -m scripts.air_map out/sweep/air [--out FILE]

Where nine views beat one, by how much in LPIPS and aligned PSNR, and how many views SetNet needs.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

from src.figures import air_map
from src.metrics.bootstrap import difference
from src.records import runs
from src.records.runs import Run

SETNET = {1: "setnet_one", 3: "setnet_three", 5: "setnet_five", 9: "setnet_nine"}
ENOUGH = 0.005  # LPIPS above that of nine views
AIR = "turbulence.atmosphere"
Places = dict[tuple[float, float], dict[str, Run]]


def places(found: Sequence[Run]) -> Places:
    """Return the runs by (half length, spread) in pixels and by name."""
    made: Places = {}
    for run in found:
        half, spread = (
            run.settings[f"{AIR}.half_length_px"],
            run.settings[f"{AIR}.spread_px.strong"],
        )
        made.setdefault((half[0], spread[0]), {})[run.record["experiment"]] = run
    return made


def margin(cells: Places, ours: str, theirs: str, metric: str, digits: int) -> air_map.Cells:
    """Return ours - theirs on the same clips; a star where the interval of 95 % excludes zero."""
    made = {}
    for place, by_name in cells.items():
        if ours in by_name and theirs in by_name:
            sides = [[[float(clip[metric]) for clip in by_name[n].clips]] for n in (ours, theirs)]
            value = sum(sides[0][0]) / len(sides[0][0]) - sum(sides[1][0]) / len(sides[1][0])
            low, high = difference(*sides)
            made[place] = (value, f"{value:+.{digits}f}" + ("*" if low * high > 0 else ""))
    return made


def enough(cells: Places) -> air_map.Cells:
    """Return the fewest views whose mean LPIPS is within ENOUGH of that of nine."""
    made = {}
    for place, by_name in cells.items():
        if all(name in by_name for name in SETNET.values()):
            lpips = {n: by_name[name].record["test"]["lpips"]["mean"] for n, name in SETNET.items()}
            fewest = min(n for n in SETNET if lpips[n] <= lpips[9] + ENOUGH)
            made[place] = (float(fewest), str(fewest))
    return made


def main() -> None:
    """Read the arguments."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--out", type=Path, default=Path("out/air_map.png"))
    given = parser.parse_args()
    cells = places(runs.find(given.folders))
    maps = {
        "LF-E2VID, nine views - one: LPIPS": margin(cells, "lf3x3", "single256", "lpips", 3),
        "the same: aligned PSNR, dB": margin(cells, "lf3x3", "single256", "psnr_aligned", 2),
        "SetNet, nine views - one: LPIPS": margin(cells, SETNET[9], SETNET[1], "lpips", 3),
        "views that are enough": enough(cells),
    }
    print(air_map.draw(given.out, {title: found for title, found in maps.items() if found}))


if __name__ == "__main__":
    main()
