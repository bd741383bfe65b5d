"""Windows, views and pixels of clips rearranged: pauses, flips, dropped and shifted views.

Own code, not kornia's: draws come from keys, grids and frames go along, a batch takes one gather.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor
from torch.nn import functional

from src.sim.pipeline import Sample

KeptGrids = Float[Tensor, "n windows kept bins h w"]
ClipGrids = Shaped[Tensor, "windows views bins h w"]
Frames = Float[Tensor, "n windows 1 h w"]
FRAMES = {"target", "turbulent", "teacher_frames"}  # of a sample, transformed like its grids


class ClipTransform(NamedTuple):
    """What a clip becomes: its `source_windows` (windows,), without events where `paused`
    (windows,), flipped along `flip_axes`; the views are those of `view_order` (kept,), of which
    some (view, rows, columns) in `view_shifts` are moved so many pixels down and right.
    """

    source_windows: Int[Tensor, " windows"]
    paused: Bool[Tensor, " windows"]
    flip_axes: list[int]
    view_order: Int[Tensor, " kept"]
    view_shifts: list[tuple[int, int, int]]


def transform_clips(
    samples: Sequence[Sample], transforms: Sequence[ClipTransform], out: KeptGrids
) -> dict[str, Frames]:
    """Write the transformed grids to `out`, window by window, which stays in the CPU's cache;
    return the transformed FRAMES.
    """
    clips = [(sample, clip) for sample in samples for clip in range(len(sample.voxels))]
    frames: dict[str, list[Tensor]] = {}
    for (sample, clip), transform, grids in zip(clips, transforms, out, strict=True):
        source, axes = transform.source_windows, transform.flip_axes
        paused = transform.paused.tolist()
        for grid, window, is_paused in zip(grids, source.tolist(), paused, strict=True):
            if is_paused:
                grid.zero_()
            else:
                views = sample.voxels[clip, window].index_select(0, transform.view_order)
                grid.copy_(flip_frames(views, axes))
        shift_views(grids, transform.view_shifts)
        for name in FRAMES & sample.tensors().keys():
            part = getattr(sample, name)[clip, source]
            frames.setdefault(name, []).append(flip_frames(part, axes))
    return {name: torch.stack(parts) for name, parts in frames.items()}


def transform_batch(
    sample: Sample, transforms: Sequence[ClipTransform], out: KeptGrids
) -> dict[str, Frames]:
    """Do as `transform_clips` in one gather for the grids and one for each of FRAMES."""
    device, (height, width) = out.device, out.shape[-2:]
    clip, bins = (torch.arange(count, device=device) for count in (len(transforms), out.shape[3]))
    window = torch.stack([transform.source_windows for transform in transforms]).to(device)
    paused = torch.stack([transform.paused for transform in transforms]).to(device)
    view = torch.stack([transform.view_order for transform in transforms]).to(device)
    pixel, is_inside = source_pixels(transforms, height, width, device)
    grids = sample.voxels.flatten(-2)[
        clip[:, None, None, None, None], window[:, :, None, None, None],
        view[:, None, :, None, None], bins[:, None], pixel[:, None, :, None],
    ]  # fmt: skip
    is_empty = paused[:, :, None, None, None] | ~is_inside[:, None, :, None]
    out.flatten(-2).copy_(grids.masked_fill_(is_empty, 0))
    if any(transform.view_shifts for transform in transforms):  # frames are not shifted
        unshifted = [transform._replace(view_shifts=[]) for transform in transforms]
        pixel = source_pixels(unshifted, height, width, device)[0]
    place = clip[:, None, None], window[:, :, None], pixel
    return {
        name: getattr(sample, name).flatten(2)[place].unflatten(-1, (1, height, width))
        for name in FRAMES & sample.tensors().keys()
    }


def source_pixels(
    transforms: Sequence[ClipTransform], height: int, width: int, device: torch.device
) -> tuple[Int[Tensor, "n views pixels"], Bool[Tensor, "n views pixels"]]:
    """Return which pixel each pixel of each view comes from (one view for all, where none is
    shifted), and whether there is one, on `device`.
    """
    has_shifts = any(transform.view_shifts for transform in transforms)
    shifts = torch.zeros(len(transforms), len(transforms[0].view_order) if has_shifts else 1, 2)
    for clip, transform in zip(shifts, transforms, strict=True):
        for view, *down_right in transform.view_shifts:
            clip[view] = torch.tensor(down_right)
    flips = torch.tensor([[axis in one.flip_axes for axis in (-2, -1)] for one in transforms])
    shifts, flips = shifts.long().to(device), flips[:, None].to(device)
    places, inside = [], []
    for axis, size in enumerate((height, width)):
        place = torch.arange(size, device=device) - shifts[..., axis, None]
        inside.append((place >= 0) & (place < size))
        place = torch.where(flips[..., axis, None], size - 1 - place, place)
        places.append(place.clamp(0, size - 1))
    pixel = places[0][..., None] * width + places[1][..., None, :]
    return pixel.flatten(2), (inside[0][..., None] & inside[1][..., None, :]).flatten(2)


def flip_frames(frames: Tensor, axes: list[int]) -> Tensor:
    """Return frames (..., h, w) flipped along `axes`; not a copy where there are none."""
    return frames.flip(axes) if axes else frames


def shift_views(voxels: ClipGrids, shifts: Sequence[tuple[int, int, int]]) -> ClipGrids:
    """Move (view, rows, columns) down and right, in place; zeros come in at the border."""
    height, width = voxels.shape[-2:]
    for view, down, right in shifts:
        y, x = max(-height, min(down, height)), max(-width, min(right, width))
        voxels[:, view] = functional.pad(voxels[:, view], (x, -x, y, -y))  # negative: cropped
    return voxels
