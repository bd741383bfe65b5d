"""Stress tests of the conditions of a clip: turbulence, sensor, window rate, views."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from statistics import fmean
from typing import Any

import numpy as np
import torch
from torch import Tensor

from src.bench.candidates import Candidate
from src.bench.stress_tests.event_clips import (
    ClipConditions,
    EventClip,
    StressBench,
    compute_losses_against_best,
    require_type,
)
from src.bench.stress_tests.stress_results import StressResult, build_worst_psnr_loss_result
from src.metrics.video_metrics import score_aligned_psnr
from src.models.network import unroll
from src.sim import noise
from src.sim.optics import layout, most_central_view_index
from src.sim.turbulence.simulated import SimulatedTurbulence
from src.training.clip_transforms import shift_views

INDEPENDENT_SPACING = 1e3  # diameters between sub-apertures that share no turbulence


def measure_worst_psnr_loss(
    network: Candidate, bench: StressBench, *, limit_db: float, parameter: str,
    values: Sequence[Any], fixed: Mapping[str, Any] | None = None,
    reference: Mapping[str, Any] | None = None,
) -> StressResult:  # fmt: skip
    """Return the aligned PSNR lost under other conditions, the worst of `values`.

    `parameter` and the keys of `fixed` and `reference`: a field of ClipConditions such as
    d_over_r0, `sensor.<argument>` of EventSensor or `turbulence.<argument>` of SimulatedTurbulence.
    `fixed` is set with every value; the loss is against the best of clips of the `reference`
    settings and of the values before.
    """

    def psnr(settings: Mapping[str, Any]) -> float:
        return bench.mean_aligned_psnr(network, ClipConditions.from_settings(settings))

    base = psnr(reference or {})
    scores = [(value, psnr({parameter: value, **(fixed or {})})) for value in values]
    curve = compute_losses_against_best(base, scores)
    return build_worst_psnr_loss_result(curve, limit_db=limit_db, varied=parameter)


def measure_correlated_views_loss(
    network: Candidate, bench: StressBench, *, limit_db: float,
    spacings_over_aperture: Sequence[float],
) -> StressResult:  # fmt: skip
    """Return the aligned PSNR lost as the views look through more and more of the same turbulence,
    against views too far apart to share any; the centre view sees the same in all of them.

    `spacings_over_aperture`: distance between neighbouring sub-apertures in diameters of one; at 0
    all views are distorted alike.
    """
    require_views(network, 2)
    require_type("turbulence", bench.pipeline.turbulence, SimulatedTurbulence)
    aperture_m = bench.pipeline.draw(bench.indices[0]).turbulence.aperture_m
    name, fixed = "turbulence.baseline_m", {"turbulence.views_correlation": "baseline"}
    found = measure_worst_psnr_loss(
        network, bench, limit_db=limit_db, parameter=name, fixed=fixed,
        values=[spacing * aperture_m for spacing in spacings_over_aperture],
        reference={name: INDEPENDENT_SPACING * aperture_m, **fixed},
    )  # fmt: skip
    losses = [loss for _, loss in found.curve]
    curve = list(zip(spacings_over_aperture, losses, strict=True))
    return replace(found, curve=curve, varied="sub-aperture spacing in diameters")


def measure_window_rate_loss(
    network: Candidate, bench: StressBench, *, limit_db: float, rates_hz: Sequence[float],
    duration_s: float = 0.3,
) -> StressResult:  # fmt: skip
    """Return the aligned PSNR lost, at the same instants, when the events are cut at another rate.

    Windows grow for a network that uses their length; those of others are a frame long, where
    src.reconstruct gives them overlapping ones.
    `rates_hz`: windows a second, easy to hard; all and the clip's own are multiples of the lowest
    of them.  `duration_s`: how much of the clip is used; its second half is scored.
    """

    def score(clip: EventClip, rate_hz: float) -> float:
        slowest = min(clip.fps, *rates_hz)  # at whose instants all rates have a frame
        count = int(min(duration_s, clip.duration_s) * slowest)
        if count < 2:
            raise ValueError(f"{count} windows at {slowest:g} a second are too few to score")
        instants = torch.arange(count // 2, count) + 1
        at = (instants * (rate_hz / slowest)).round().long()
        truth = (instants * (clip.fps / slowest)).round().long()
        frames = clip.reconstruct_at_rate(network, rate_hz, at.tolist())
        return float(score_aligned_psnr(frames, clip.target[truth, None]).mean())

    clips = bench.clips()
    base = fmean(score(clip, clip.fps) for clip in clips)
    scores = [(rate, fmean(score(clip, rate) for clip in clips)) for rate in rates_hz]
    curve = compute_losses_against_best(base, scores)
    return build_worst_psnr_loss_result(curve, limit_db=limit_db, varied="windows a second")


def measure_voxel_dropout_loss(
    network: Candidate, bench: StressBench, *, limit_db: float, kept_shares: Sequence[float]
) -> StressResult:
    """Return the aligned PSNR lost when only a share of the entries of the voxel grids is kept, at
    random: that of the last of `kept_shares`.  An event has two entries, which are drawn apart.
    """

    def thin(share: float) -> Callable[[Tensor], Tensor]:
        generator = noise.generator(noise.key("probes", "share", str(share)))
        return lambda voxels: voxels * (torch.rand(voxels.shape, generator=generator) < share)

    curve = bench.aligned_psnr_losses(network, {share: thin(share) for share in kept_shares})
    return StressResult(curve[-1][1], "dB", limit_db, curve, "share of voxels kept")


def require_views(network: Candidate, least: int) -> None:
    """Raise ValueError unless the network is given at least so many views."""
    if network.views == 1:
        raise ValueError("it is given the centre view only")
    if network.views < least:
        raise ValueError(f"it is given {network.views} views, {least} are needed")


def measure_worst_view_dropout_loss(
    network: Candidate, bench: StressBench, *, limit_db: float, counts: Sequence[int],
    draws: int = 4,
) -> StressResult:  # fmt: skip
    """Return the aligned PSNR lost when `counts` of the views are dark from the start, the worst of
    `draws`.

    A network that takes any number of views is given the others; one of a fixed number sees zeros.
    """
    require_views(network, max(counts) + 1)
    rng, scores = np.random.default_rng(0), []
    middle = most_central_view_index(layout(network.views))
    for count in counts:
        lost = [rng.permutation(network.views)[:count].tolist() for _ in range(draws)]
        lost[0] = [middle, *(v for v in lost[0] if v != middle)][:count]  # the centre view, too
        drawn = [_psnr_without_views(network, bench, views) for views in lost]
        scores.append((count, float(np.min(drawn))))
    curve = compute_losses_against_best(bench.mean_aligned_psnr(network), scores)
    return build_worst_psnr_loss_result(curve, limit_db=limit_db, varied="views lost")


@torch.no_grad()
def _psnr_without_views(network: Candidate, bench: StressBench, lost: list[int]) -> float:
    positions, scores = list(layout(network.views)), []
    kept = [i for i in range(network.views) if i not in lost]
    for clip in bench.clips():
        views = [network.select_views(window, clip.positions)[0] for window in clip.windows()]
        voxels = torch.stack(views, 1).index_fill(2, torch.tensor(lost), 0.0)
        given = positions
        if network.loaded.views is None:
            given, voxels = [positions[i] for i in kept], voxels[:, :, kept]
        frames, _ = unroll(network.loaded, voxels, window_s=1 / clip.fps, positions=given)
        scores.append(bench.clip_aligned_psnr(frames[0].float().clamp(0, 1), clip))
    return fmean(scores)


def measure_view_shift_loss(
    network: Candidate, bench: StressBench, *, limit_db: float, parallax: bool = False,
    shifts_px: Sequence[int] = (1, 2, 4), judged_shift_px: int,
) -> StressResult:  # fmt: skip
    """Return the aligned PSNR lost when views are displaced by `judged_shift_px`.

    One view beside the centre is displaced by `shifts_px`; with `parallax` all, by so much between
    neighbouring views: the scene is nearer than the plane that the views are registered for.
    """
    require_views(network, 2)
    changes, positions = {}, bench.clips()[0].positions
    own = layout(network.views)
    # The last one where the centre comes first.
    moved = positions.index(own[most_central_view_index(own) - 1])
    for px in shifts_px:
        everywhere = [(i, px * row, px * col) for i, (row, col) in enumerate(positions)]
        shifts = everywhere if parallax else [(moved, 0, px)]
        changes[px] = lambda voxels, shifts=shifts: shift_views(voxels.clone(), shifts)
    curve = bench.aligned_psnr_losses(network, changes)
    return StressResult(dict(curve)[judged_shift_px], "dB", limit_db, curve, "px of shift")
