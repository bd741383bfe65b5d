"""Stress tests of the recurrent state: retention, drift, start-up, recovery, stability, bf16."""

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import chain, cycle, islice
from statistics import fmean
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from src.bench.candidates import Candidate
from src.bench.stress_tests.event_clips import ClipConditions, StressBench
from src.bench.stress_tests.stress_results import StressResult, largest_value
from src.deploy.forms import convert_to_form
from src.metrics.image import aligned_psnr
from src.metrics.temporal import temporal_jitter_px
from src.models.network import unroll
from src.sim import noise

SCORED_EVERY = 4  # windows of a long run
LEAST_RMS = 1e-12  # difference of frames, below which there is none


def measure_contrast_retention_percent(
    network: Candidate, bench: StressBench, *, limit_percent: float, windows: Sequence[int]
) -> StressResult:
    """Return the contrast kept, in %, after the last number of `windows` without an event: the
    contrast against that of the last frame with events, times the squared correlation with it, so
    that noise in the picture's place is not contrast kept; of an inverted picture it is negative.
    """
    per_clip = []
    for clip in bench.clips():
        given = list(clip.windows())
        frames, state = clip.reconstruct(network, given)
        before, kept = frames[-1], []
        for done, count in zip((0, *windows), windows, strict=False):
            empty = [torch.zeros_like(given[0])] * (count - done)
            frames, state = clip.reconstruct(network, empty, state)
            kept.append(100 * _kept_contrast(before, frames[-1]))
        per_clip.append(kept)
    kept = torch.tensor(per_clip).mean(0).tolist()
    curve = list(zip(windows, kept, strict=True))
    return StressResult(kept[-1], "%", limit_percent, curve, "empty windows", True)


def _kept_contrast(before: Tensor, after: Tensor) -> float:
    """Return std(after) / std(before) times the signed square of their correlation; 0 where one
    has no contrast, NaN where a value is none.
    """
    before, after = ((frame - frame.mean()).double() for frame in (before, after))
    spread = before.square().mean().sqrt(), after.square().mean().sqrt()
    shared = (before * after).mean() / (spread[0] * spread[1]).clamp(min=1e-12)
    return float(spread[1] / spread[0].clamp(min=1e-9) * shared * shared.abs())


def measure_long_sequence_drift(
    network: Candidate, bench: StressBench, *, limit_db: float, windows: int
) -> StressResult:
    """Return the aligned PSNR in dB lost between the second and the last loop of the first clip,
    played back and forth; the curve has one entry a tenth of the run.
    """
    clip = bench.clips()[0]
    loop, truth = clip.back_and_forth()
    length = len(loop)
    if windows < 3 * length:
        key = "stress_tests.long_sequence_drift.test.windows"
        raise ValueError(f"{key} must be >= {3 * length}, got {windows}")
    scores, state = torch.full((windows,), torch.nan), None
    for k, window in enumerate(islice(cycle(loop), windows)):
        frames, state = clip.reconstruct(network, [window], state)
        if k % SCORED_EVERY == 0:
            scores[k] = aligned_psnr(frames, truth[k % length][None, None])[0]
    per_loop = scores[: windows // length * length].view(-1, length).nanmean(1)
    losses = (per_loop[1] - per_loop[1:]).tolist()
    curve = [(length * (k + 2), loss) for k, loss in enumerate(losses)]
    thinned = [*curve[: -1 : max(1, len(curve) // 10)], curve[-1]]
    return StressResult(losses[-1], "dB", limit_db, thinned, "windows")


def measure_convergence_windows(
    network: Candidate, bench: StressBench, *, limit_windows: float, within_db: float = 1.0
) -> StressResult:
    """Return the windows until the frame is within `within_db` of the clip's second half, for good;
    inf where one clip does not get there in its first half.
    """
    scores = [aligned_psnr(clip.reconstruct(network)[0], clip.truth) for clip in bench.clips()]
    times = [count_settling_windows(s, within_db) for s in scores]
    return StressResult(fmean(times), "windows", limit_windows)


def measure_flicker_recovery(
    network: Candidate, bench: StressBench, *, limit_windows: float, flicker_windows: int = 10,
    events_per_pixel: float = 3.0, within_db: float = 1.0,
) -> StressResult:  # fmt: skip
    """Return the windows until the frame is back within `within_db` after `flicker_windows`
    windows in which every pixel makes `events_per_pixel` ON events, in the next as many OFF events;
    inf where it is not back by the end of one clip.
    """
    times = []
    for clip in bench.clips():
        windows, truth = list(clip.windows()), clip.truth
        half = len(windows) // 2
        flash = torch.full_like(windows[0], events_per_pixel / windows[0].shape[2])
        flashes = [(-1) ** k * flash for k in range(flicker_windows)]
        plain, _ = clip.reconstruct(network, windows)
        disturbed, _ = clip.reconstruct(network, chain(windows[:half], flashes, windows[half:]))
        after = aligned_psnr(disturbed[half + flicker_windows :], truth[half:])
        losses = aligned_psnr(plain[half:], truth[half:]) - after
        times.append(count_windows_to_last_exceedance(losses, within_db))
    return StressResult(fmean(times), "windows", limit_windows)


def measure_static_scene_jitter_percent(
    network: Candidate, bench: StressBench, *, limit_percent: float, stop_after_share: float = 0.0
) -> StressResult:
    """Return the temporal jitter of a static scene's video, in % of that of one view's turbulent
    frames.

    `stop_after_share`: the share of the clip in which the scene moves before it stops; at 0 all
    events come from turbulence.  At 100 % one view's frames would be as steady.
    """
    shares = []
    for clip in bench.clips(ClipConditions(stop_after_share=stop_after_share)):
        truth = clip.truth
        start = int(stop_after_share * len(truth)) + bench.warmup
        if start > len(truth) - 2:
            raise ValueError(f"data.test_windows must be > {start + 1}, got {len(truth)}")
        one_view, ours = (
            temporal_jitter_px(video, truth)[start:].mean()
            for video in (clip.turbulent[1:, None].clone(), clip.reconstruct(network)[0])
        )
        shares.append(100 * float(ours / one_view.clamp(min=1e-9)))
    return StressResult(fmean(shares), "%", limit_percent)


def measure_input_perturbation_growth(
    network: Candidate, bench: StressBench, *, limit_growth_per_window: float,
    perturbation_rms: float = 1e-3, skipped_windows: int = 3,
) -> StressResult:  # fmt: skip
    """Return the growth exponent, per window, of a perturbation of `perturbation_rms` in one.

    Fitted to the logarithm of the rms difference of the frames (a Lyapunov exponent); above 0 the
    perturbation grows, at 0 it has no effect.  The first `skipped_windows` windows after it do not
    count.
    """
    exponents = []
    for clip in bench.clips():
        windows = list(clip.windows())
        start = len(windows) // 3
        drawn = _draw_normal(windows[0], "growth")
        # Where there were events anyway, so that the same pixels are active.
        perturbed = windows[start] + perturbation_rms * drawn * (windows[start] != 0)
        plain, _ = clip.reconstruct(network, windows)
        changed = [*windows[:start], perturbed, *windows[start + 1 :]]
        other, _ = clip.reconstruct(network, changed)
        difference = (plain - other)[start + skipped_windows :].double()
        exponents.append(_fit_growth(difference.square().mean((1, 2, 3)).sqrt()))
    return StressResult(fmean(exponents), "per window", limit_growth_per_window)


def _fit_growth(rms: Float[Tensor, " windows"]) -> float:
    """Return the growth exponent per window; 0 where all are below LEAST_RMS, NaN where one is."""
    if rms.isnan().any():
        return math.nan
    if (rms <= LEAST_RMS).all():
        return 0.0
    logs = rms.clamp(min=LEAST_RMS).log()
    return float(np.polyfit(np.arange(len(logs)), logs.numpy(), 1)[0])


def measure_adversarial_gain(
    network: Candidate, bench: StressBench, *, limit_gain: float, windows: int = 12,
    steps: int = 8, perturbation_rms: float = 0.02,
) -> StressResult:  # fmt: skip
    """Return the largest gain from input to output: rms change of the last frame over rms of a
    perturbation.

    The perturbation, of `perturbation_rms`, is added to the first of `windows` windows and found by
    `steps` of gradient ascent (Tanay et al., arXiv 2010.05099), on the first clip.
    """
    network.require_float_parameters("its response is linear")
    clip = bench.clips()[0]
    given = list(islice(clip.windows(), bench.warmup + windows))
    _, start_state = clip.reconstruct(network, given[: bench.warmup])
    selected = [network.select_views(window, clip.positions) for window in given[bench.warmup :]]
    first, *later = (voxels for voxels, _ in selected)
    options: Any = {"window_s": 1 / clip.fps, "positions": selected[0][1]}

    def last_frame(extra: Tensor) -> Tensor:
        voxels = torch.stack([first + extra, *later], 1)
        return unroll(network.loaded, voxels, start_state, **options)[0][:, -1]

    plain, extra = last_frame(torch.zeros(())), _draw_normal(first, "worst")
    curve = []
    for step in range(steps):
        extra = (extra * perturbation_rms / extra.square().mean().sqrt()).detach().requires_grad_()
        change = (last_frame(extra) - plain).square().mean() + 0 * extra.sum()  # 0: unused inputs
        (gradient,) = torch.autograd.grad(change, extra)
        curve.append((step, math.sqrt(float(change.detach())) / perturbation_rms))
        extra = gradient + 1e-12
    return StressResult(largest_value(curve), "x", limit_gain, curve, "steps of ascent")


def measure_bf16_psnr_difference(
    network: Candidate, bench: StressBench, *, limit_db: float, windows: int
) -> StressResult:
    """Return the mean difference of aligned PSNR, in dB, between bf16 and float32 in the last
    quarter of a long run of the first clip.
    """
    network.require_float_parameters("there is nothing to round")
    clip, quarter = bench.clips()[0], windows // 4
    loop, truth = clip.back_and_forth()
    half = replace(network, network=convert_to_form(network.loaded, "bf16"))
    scores = []
    for form in (network, half):
        frames, _ = clip.reconstruct(form, islice(cycle(loop), quarter * 4))
        at = torch.arange(len(frames)) % len(truth)
        scores.append(aligned_psnr(frames, truth[at, None]))
    gaps = (scores[0] - scores[1]).view(4, -1).mean(1).abs().tolist()
    curve = [(quarter * (k + 1), gap) for k, gap in enumerate(gaps)]
    return StressResult(gaps[-1], "dB", limit_db, curve, "windows")


def count_settling_windows(scores: Float[Tensor, " windows"], within_db: float) -> float:
    """Return the first window from which on the scores, averaged over five windows, stay within
    `within_db` of the mean of their second half; inf where none of the first half does.
    """
    plateau = scores[len(scores) // 2 :].mean()
    smooth = scores.unfold(0, 5, 1).mean(1) if len(scores) >= 5 else scores
    return count_windows_to_last_exceedance(plateau - smooth[: len(scores) // 2], within_db)


def count_windows_to_last_exceedance(losses: Float[Tensor, " windows"], limit: float) -> float:
    """Return how many windows pass until `losses` is above `limit`, or NaN, for the last time; inf
    where the last one is."""
    beyond = (~(losses <= limit)).nonzero()
    last = int(beyond[-1]) + 1 if len(beyond) else 0
    return math.inf if last == len(losses) else float(last)


def _draw_normal(like: Tensor, name: str) -> Tensor:
    return noise.normal(noise.key("probes", name), torch.arange(like.numel())).view_as(like)
