"""How much a still scene wanders: python -m scripts.wander FILM ... [--last 25].

A FILM is a film, a folder of pictures or the video.h5 of a reconstruction; all are shrunk to the
size of the smallest.  Printed for each: the median, over rows and columns 8 px apart, of the rms
shift of what they show against its mean (metrics/straightness.py), in pixels, and the contrast, the
standard deviation of a picture's pixels.
"""

import argparse
from pathlib import Path

import cv2
import numpy as np

from src.figures import slices
from src.metrics import straightness
from src.recordings.files import sources

STEP = 8  # pixels between two lines, and from the border


def wander(film: np.ndarray) -> float:
    """Return the median wander of the rows and columns of `film` (frames, h, w), in pixels."""
    height, width = film.shape[1:]
    rows = [((STEP, y), (width - 1 - STEP, y)) for y in range(STEP, height - STEP, STEP)]
    columns = [((x, STEP), (x, height - 1 - STEP)) for x in range(STEP, width - STEP, STEP)]
    cuts = (slices.sample(film, slices.line(*ends)) for ends in rows + columns)
    return float(np.nanmedian([straightness.wander(cut) for cut in cuts]))


def main() -> None:
    """Read the arguments and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("films", type=Path, nargs="+")
    parser.add_argument("--last", type=int, default=25, help="frames at the end that count")
    given = parser.parse_args()
    films = [np.stack(list(sources.film(path))[-given.last :]) for path in given.films]
    height, width = min(film.shape[1:] for film in films)
    print("| film | frames | wander, px | contrast |\n|---|---|---|---|")
    for path, film in zip(given.films, films, strict=True):
        small = [cv2.resize(frame, (width, height), interpolation=cv2.INTER_AREA) for frame in film]
        film = np.stack(small)
        name = path.parent.name if path.suffix == ".h5" else path.name
        contrast = film.std((1, 2)).mean()
        print(f"| {name} | {len(film)} | {wander(film):.2f} | {contrast:.3f} |")


if __name__ == "__main__":
    main()
