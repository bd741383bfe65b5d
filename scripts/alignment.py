"""What bringing views together could gain at most: python -m scripts.alignment KEY=VALUE ...

    python -m scripts.alignment data=test_photos scene.root=../shared/data/photos

No network: each view's leaky sum of events, its log intensity of the last half second, is brought
to its place by the tilt that the simulator gave it (`local`), by that tilt's mean over the view
(`whole`), or not at all, and the nine are averaged.  No estimate of the tilt from events can be
better than the tilt itself.  KEY=VALUE: overrides of src.eval.  Printed are the scores, and what
each way gains over the average as it is, in pairs of clips with an interval of 95 %, also apart for
the weaker and the stronger half of the clips' air, and for shorter and longer half lengths.
"""

import math
import sys
from collections.abc import Iterator, Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from scripts.readme import config, gains
from src.app import build
from src.metrics.scores import Scores
from src.metrics.table import METRICS
from src.metrics.temporal import pull
from src.sim.pipeline import Pipeline

MEMORY_S = 0.5  # time constant of the leaky sums: SetNet's longer one
GAIN = 0.45  # grey levels for a change of log intensity by one
AS_THEY_ARE = "nine as they are"
Row = dict[str, dict[str, float]]


def drawn(
    events: Float[Tensor, "windows views h w"],
    tilt: Float[Tensor, "views windows 2 h w"],
    keep: float,
    centre: int,
) -> dict[str, Float[Tensor, "windows 1 h w"]]:
    """Return the films that each way makes of `events`, log intensity gained; `tilt` in pixels."""
    total, films = torch.zeros_like(events[0]), {}
    for now, moved in zip(events, tilt.transpose(0, 1), strict=True):
        total = keep * total + now
        whole = moved.mean((2, 3), keepdim=True).expand_as(moved)
        pictures = {"one view": total[centre, None], AS_THEY_ARE: total.mean(0, True)}
        for name, by in {"nine, whole": whole, "nine, local": moved}.items():
            pictures[name] = pull(total[:, None], by).mean(0)
        for name, picture in pictures.items():
            films.setdefault(name, []).append((0.5 + GAIN * picture).clamp(0, 1))
    return {name: torch.stack(film) for name, film in films.items()}


def clip(pipeline: Pipeline, number: int, scores: Scores, warmup: int) -> tuple[Row, dict]:
    """Return the scores of every way on a clip, and what is known of its air."""
    draw = pipeline.draw(number)
    sample = pipeline.expose([draw], pipeline.views(draw))
    events = draw.threshold * sample.voxels[0].sum(2)
    keep = math.exp(-float(sample.window_s) / MEMORY_S)
    films = drawn(events, pipeline.tilt(draw)[:, 1:], keep, pipeline.optics.centre)
    truth = sample.target[0, warmup:]
    row = {name: scores(film[warmup:], truth) for name, film in films.items()}
    return row, sample.drawn[0]


def table(rows: Sequence[Row], airs: Sequence[dict]) -> Iterator[str]:
    """Yield the lines of two Markdown tables: scores, and gains over the nine as they are."""
    heads = [m.heading for m in METRICS]
    rule = "|---" * (len(heads) + 1) + "|"
    yield from (_line("", heads), rule)
    for name in rows[0]:
        yield _line(name, [m.written(np.mean([r[name][m.name] for r in rows])) for m in METRICS])
    yield from ("", _line("gain over the nine as they are", heads), rule)
    for group, chosen in _groups(airs).items():
        part = [row for row, is_in in zip(rows, chosen, strict=True) if is_in]
        for name in ("nine, whole", "nine, local"):
            cells = gains([row[name] for row in part], [row[AS_THEY_ARE] for row in part])
            yield _line(f"{name}, {group} ({len(part)} clips)", cells)


def _line(name: str, cells: Sequence[str]) -> str:
    return f"| {name} | " + " | ".join(cells) + " |"


def _groups(airs: Sequence[dict]) -> dict[str, Sequence[bool]]:
    tilt, half = (np.array([air[key] for air in airs]) for key in ("tilt_px", "half_length_px"))
    strong, long = tilt > np.median(tilt), half > np.median(half)
    return {
        "all": np.ones(len(airs), bool),
        f"tilt up to {np.median(tilt):.2f} px": ~strong,
        "tilt above it": strong,
        f"half length up to {np.median(half):.0f} px": ~long,
        "half length above it": long,
    }


def main(overrides: Sequence[str]) -> None:
    """Score the test clips of the config, print the tables."""
    torch.set_num_threads(1)
    cfg = config("eval", *overrides)
    pipeline, scores = build.pipeline(cfg, "test"), build.scores(cfg)
    both = [clip(pipeline, k, scores, cfg.data.warmup) for k in range(cfg.data.test_clips)]
    print("\n".join(table(*zip(*both, strict=True))))


if __name__ == "__main__":
    main(sys.argv[1:])
