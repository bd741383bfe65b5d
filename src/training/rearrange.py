"""Which windows, views and pixels of a clip a training sees, gathered clip by clip or at once."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor
from torch.nn import functional

from src.sim.pipeline import Sample


class Change(NamedTuple):
    """What a clip becomes: its window `steps` (windows,) are shown, without events where `paused`
    (windows,), flipped along `axes`, rows and columns swapped if `swap`; the views are those of
    `order` (kept,), some `away` from their places, as `misplacements` has it.
    """

    steps: Int[Tensor, " windows"]
    paused: Bool[Tensor, " windows"]
    axes: list[int]
    swap: bool
    order: Int[Tensor, " kept"]
    away: list[tuple[int, int, int]]


def rearrange_clips(
    samples: Sequence[Sample],
    changes: Sequence[Change],
    out: Float[Tensor, "n windows kept bins h w"],
) -> list[Tensor]:
    """Fill `out` with the windows, views and pixels that each clip's change asks for, window by
    window, so that what is turned is in the cache still; return the pictures (n, windows, 1, h, w)
    alike: clean, turbulent and, where there are any, taught.
    """
    clips = [(sample, number) for sample in samples for number in range(len(sample.voxels))]
    pictures = []
    for (sample, number), change, grids in zip(clips, changes, out, strict=True):
        for window, step, empty in zip(
            grids, change.steps.tolist(), change.paused.tolist(), strict=True
        ):
            if empty:
                window.zero_()
            else:
                shown = sample.voxels[number, step].index_select(0, change.order)
                window.copy_(turned(shown, change.axes, change.swap))
        misplace(grids, change.away)
        pictures.append(
            [
                turned(part[number, change.steps], change.axes, change.swap)
                for part in pictures_of(sample)
            ]
        )
    return [torch.stack(part) for part in zip(*pictures, strict=True)]


def rearrange_batch(
    sample: Sample, changes: Sequence[Change], out: Float[Tensor, "n windows kept bins h w"]
) -> list[Tensor]:
    """Do as `rearrange_clips` in one gather for the grids and one for each kind of pictures."""
    device, (height, width) = out.device, out.shape[-2:]
    clip = torch.arange(len(changes), device=device)
    step = torch.stack([change.steps for change in changes]).to(device)
    paused = torch.stack([change.paused for change in changes]).to(device)
    view = torch.stack([change.order for change in changes]).to(device)
    bins = torch.arange(out.shape[3], device=device)
    pixel, seen = (part.to(device) for part in source_pixels(changes, height, width))
    grids = sample.voxels.flatten(-2)[
        clip[:, None, None, None, None], step[:, :, None, None, None],
        view[:, None, :, None, None], bins[:, None], pixel[:, None, :, None],
    ]  # fmt: skip
    hidden = paused[:, :, None, None, None] | ~seen[:, None, :, None]
    out.flatten(-2).copy_(grids.masked_fill_(hidden, 0))
    if any(change.away for change in changes):  # pictures stay where they are
        still = [change._replace(away=[]) for change in changes]
        pixel = source_pixels(still, height, width)[0].to(device)
    where = clip[:, None, None], step[:, :, None], pixel
    return [
        part.flatten(2)[where].unflatten(-1, (1, height, width)) for part in pictures_of(sample)
    ]


def source_pixels(
    changes: Sequence[Change], height: int, width: int
) -> tuple[Int[Tensor, "n views pixels"], Bool[Tensor, "n views pixels"]]:
    """Return the number of the pixel that is shown at each pixel of each view (or of all, where no
    view is misplaced), and whether there is one.
    """
    numbers = torch.arange(height * width).view(1, 1, 1, height, width)
    away = any(change.away for change in changes)
    sources = []
    for change in changes:
        pixels = turned(numbers, change.axes, change.swap)
        views = pixels.repeat(1, len(change.order) if away else 1, 1, 1, 1) + 1
        sources.append(misplace(views, change.away).flatten(3)[0, :, 0] - 1)
    source = torch.stack(sources)
    return source.clamp(min=0), source >= 0


def pictures_of(sample: Sample) -> list[Tensor]:
    """Return what is turned and paused with the grids: clean, turbulent and, if any, taught."""
    parts = (sample.target, sample.turbulent, sample.taught)
    return [part for part in parts if part is not None]


def turned(pictures: Tensor, axes: list[int], swap: bool) -> Tensor:
    """Return pictures (..., h, w) flipped along `axes`, then with rows and columns swapped."""
    if swap and pictures.shape[-2] != pictures.shape[-1]:
        height, width = pictures.shape[-2:]
        raise ValueError(
            f"augment.transpose must be 0 for crops that are no squares, got {height} x {width}"
        )
    pictures = pictures.flip(axes) if axes else pictures
    return pictures.mT if swap else pictures


def misplace(
    voxels: Shaped[Tensor, "windows views bins h w"], away: Sequence[tuple[int, int, int]]
) -> Shaped[Tensor, "windows views bins h w"]:
    """Move views as `misplacements` has it, in place; zeros come in at the border."""
    height, width = voxels.shape[-2:]
    for view, up, left in away:
        reach = max(abs(up), abs(left))
        wide = functional.pad(voxels[:, view], (reach,) * 4)
        rows, columns = slice(reach + up, reach + up + height), slice(reach + left, None)
        voxels[:, view] = wide[..., rows, columns][..., :width]
    return voxels
