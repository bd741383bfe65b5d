"""Stress tests of the conditions of a clip: turbulence, sensor, window rate, views."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from statistics import fmean
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from src.bench.candidates import Candidate
from src.bench.stress_tests.event_clips import ClipConditions, EventClip, StressBench, require_type
from src.bench.stress_tests.stress_results import StressResult, build_worst_psnr_loss_result
from src.metrics.image import aligned_psnr
from src.sim import noise
from src.sim.optics import centre_view_index, layout
from src.sim.turbulence.simulated import SimulatedTurbulence

Voxels = Float[Tensor, "n views bins h w"]


def measure_worst_psnr_loss(
    network: Candidate, bench: StressBench, *, limit_db: float, parameter: str,
    values: Sequence[Any], fixed: Mapping[str, Any] | None = None,
    reference: Mapping[str, Any] | None = None,
) -> StressResult:  # fmt: skip
    """Return the aligned PSNR lost under other conditions, the worst of `values`.

    `parameter` and the keys of `fixed` and `reference`: a field of ClipConditions such as
    d_over_r0, `sensor.<argument>` of EventSensor or `turbulence.<argument>` of SimulatedTurbulence.
    `fixed` is set with every value; the loss is against clips of the `reference` settings.
    """
    base, curve = (
        bench.mean_aligned_psnr(network, ClipConditions.from_settings(reference or {})),
        [],
    )
    for value in values:
        conditions = ClipConditions.from_settings({parameter: value, **(fixed or {})})
        curve.append((value, base - bench.mean_aligned_psnr(network, conditions)))
    return build_worst_psnr_loss_result(curve, limit_db=limit_db, varied=parameter)


def measure_correlated_views_loss(
    network: Candidate, bench: StressBench, *, limit_db: float, spacings: Sequence[float]
) -> StressResult:
    """Return the aligned PSNR lost as the views look through more and more of the same turbulence,
    against views of independent turbulence.

    `spacings`: distance between neighbouring sub-apertures in diameters of one; at 0 all views are
    distorted alike.
    """
    require_type("turbulence", bench.pipeline.turbulence, SimulatedTurbulence)
    aperture_m = bench.pipeline.draw(bench.indices[0]).turbulence.aperture_m
    found = measure_worst_psnr_loss(
        network, bench, limit_db=limit_db, parameter="turbulence.baseline_m",
        values=[spacing * aperture_m for spacing in spacings],
        fixed={"turbulence.views_correlation": "baseline"},
    )  # fmt: skip
    curve = [(spacing, loss) for spacing, (_, loss) in zip(spacings, found.curve, strict=True)]
    return build_worst_psnr_loss_result(
        curve, limit_db=limit_db, varied="sub-aperture spacing in diameters"
    )


def measure_window_rate_loss(
    network: Candidate, bench: StressBench, *, limit_db: float, rates_hz: Sequence[float],
    duration_s: float = 0.3,
) -> StressResult:  # fmt: skip
    """Return the aligned PSNR lost, at the same instants, when the events are cut at another rate.

    `rates_hz`: windows a second, easy to hard; each is a multiple or a whole part of the clip's
    own.  `duration_s`: how much of the clip is used; its second half is scored.
    """

    def score(clip: EventClip, rate_hz: float) -> float:
        windows = clip.windows(rate_hz, duration_s)
        frames, _ = network.reconstruct(windows, clip.positions, 1 / rate_hz)
        slowest = min(clip.fps, *rates_hz)  # at whose instants all rates have a frame
        count = int(min(duration_s, clip.duration_s) * slowest)
        if count < 2:
            raise ValueError(f"stress_tests: {count} instants at {slowest} a second are too few")
        instants = torch.arange(count // 2, count) + 1
        at = (instants * (rate_hz / slowest)).round().long() - 1
        truth = (instants * (clip.fps / slowest)).round().long()
        return float(aligned_psnr(frames[at], clip.target[truth, None]).mean())

    totals = torch.zeros(len(rates_hz))
    for clip in bench.clips():
        own = score(clip, clip.fps)
        totals += torch.tensor([own - score(clip, rate_hz) for rate_hz in rates_hz])
    curve = list(zip(rates_hz, (totals / len(bench.clips())).tolist(), strict=True))
    return build_worst_psnr_loss_result(curve, limit_db=limit_db, varied="windows a second")


def measure_event_dropout_loss(
    network: Candidate, bench: StressBench, *, limit_db: float, kept_shares: Sequence[float]
) -> StressResult:
    """Return the aligned PSNR lost when only a share of the entries of the grids is kept, at
    random: that of the last of `kept_shares`.
    """

    def thin(share: float) -> Callable[[Tensor], Tensor]:
        generator = noise.generator(noise.key("probes", "share", str(share)))
        return lambda voxels: voxels * (torch.rand(voxels.shape, generator=generator) < share)

    curve = bench.aligned_psnr_losses(network, {share: thin(share) for share in kept_shares})
    return StressResult(curve[-1][1], "dB", limit_db, curve, "share of events kept")


def require_views(network: Candidate, least: int) -> None:
    """Raise ValueError unless the network is given at least so many views."""
    if network.views < least:
        raise ValueError("it is given the centre view only")


def measure_view_dropout_loss(
    network: Candidate, bench: StressBench, *, limit_db: float, counts: Sequence[int],
    draws: int = 4,
) -> StressResult:  # fmt: skip
    """Return the aligned PSNR lost when `counts` of the views are dark from the start, the worst of
    `draws`.

    A network that takes any number of views is given the others; one of a fixed number sees zeros.
    """
    require_views(network, max(counts) + 1)
    base, rng, curve = bench.mean_aligned_psnr(network), np.random.default_rng(0), []
    middle = centre_view_index(layout(network.views))
    for count in counts:
        lost = [rng.permutation(network.views)[:count].tolist() for _ in range(draws)]
        lost[0] = [middle, *(v for v in lost[0] if v != middle)][:count]  # the centre view, too
        losses = [base - _psnr_without_views(network, bench, views) for views in lost]
        curve.append((count, max(losses)))
    return build_worst_psnr_loss_result(curve, limit_db=limit_db, varied="views lost")


def _psnr_without_views(network: Candidate, bench: StressBench, lost: list[int]) -> float:
    positions = list(layout(network.views))
    kept = [i for i in range(network.views) if i not in lost]
    scores = []
    for clip in bench.clips():
        state, frames = None, []
        for window in clip.windows():
            views, _ = network.select_views(window, clip.positions)
            if network.loaded.views is None:
                given, views = [positions[i] for i in kept], views[:, kept]
            else:
                given, views = positions, views.index_fill(1, torch.tensor(lost), 0.0)
            frame, state = network.step(views, state, given, 1 / clip.fps)
            frames.append(frame)
        scores.append(bench.clip_aligned_psnr(torch.cat(frames), clip))
    return fmean(scores)


def measure_view_shift_loss(
    network: Candidate, bench: StressBench, *, limit_db: float, parallax: bool = False,
    shifts_px: Sequence[int] = (1, 2, 4), judged_px: int,
) -> StressResult:  # fmt: skip
    """Return the aligned PSNR lost when views are displaced by `judged_px`.

    One view beside the centre is displaced by `shifts_px`; with `parallax` all, by so much between
    neighbouring views: the scene is nearer than the plane that the views are registered for.
    """
    require_views(network, 2)
    changes, positions = {}, bench.clips()[0].positions
    own = layout(network.views)
    moved = positions.index(own[centre_view_index(own) - 1])  # the last one: the centre comes first
    for px in shifts_px:
        everywhere = {i: (px * row, px * col) for i, (row, col) in enumerate(positions)}
        shifts = everywhere if parallax else {moved: (0, px)}
        changes[px] = partial(shift_views, shifts_px=shifts)
    curve = bench.aligned_psnr_losses(network, changes)
    return StressResult(dict(curve)[judged_px], "dB", limit_db, curve, "px of shift")


def shift_views(voxels: Voxels, shifts_px: dict[int, tuple[int, int]]) -> Voxels:
    """Return the grids with view i moved by shifts_px[i] (down, right), zeros at the edges."""
    moved = voxels.clone()
    for view, shift in shifts_px.items():
        pairs = list(zip(shift, voxels.shape[-2:], strict=True))
        to = [slice(max(px, 0), length + min(px, 0)) for px, length in pairs]
        source = [slice(max(-px, 0), length + min(-px, 0)) for px, length in pairs]
        moved[:, view] = 0
        moved[:, view, :, to[0], to[1]] = voxels[:, view, :, source[0], source[1]]
    return moved
