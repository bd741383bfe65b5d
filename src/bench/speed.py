"""Speed from the events of a window to a frame: every network in every form and size.

Events fall everywhere, so that no part of a frame can be left out.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import cycle, product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch.nn import functional

from src.bench.candidates import Candidate
from src.deploy.cost import (
    count_macs,
    macs_per_frame,
    time_calls,
)
from src.deploy.cpu_features import is_bf16_faster
from src.deploy.forms import convert_to_form
from src.deploy.onnx_export import OnnxNetwork, export_onnx
from src.deploy.runtime import EVENT_LIST_FORMS, EventListRuntime, supports_event_lists
from src.models.folding import inference_copy
from src.models.network import WINDOW_S, EventToVideoNetwork, FramePostprocessor
from src.sim.optics import layout
from src.sim.voxel import voxel_grid

FORM_DTYPES = {  # what a form computes in
    "float32": torch.float32, "bf16": torch.bfloat16, "compiled": torch.bfloat16,
    "openvino": torch.bfloat16 if is_bf16_faster() else torch.float32,
    "onnx": torch.float32,
}  # fmt: skip
TIMED_FORMS = tuple(FORM_DTYPES)
LONGEST_S, ONNX_SIDE = 1.0, 176
PREVIEW_SIDE = 64  # frames that tell what a post-processor costs on larger ones
PEAK_SIDE, PEAK_CHANNELS = 176, 64  # of the convolution that shows what the machine can do
EVENTS_PER_PIXEL = 0.15  # of each view and window: five million a second of nine views of 176x176
WINDOWS = 4  # of events, played in turn
EventStep = Callable[..., Float[np.ndarray, "h w"]]  # of t, x, y, p, view, t0, t1, as a runtime's


@dataclass(frozen=True)
class SpeedMeasurement:
    """One network in one form on frames `side` pixels square; `reason`: why there is no time."""

    network: str
    trained: bool
    views: int
    side: int
    device: str
    threads: int
    form: str
    ms: float | None = None
    least_ms: float | None = None
    frames: int = 0
    clock: str = ""
    gmac: float | None = None
    params: int | None = None
    reason: str = ""


class SpeedBenchmark:
    """Times networks for `seconds` each.

    What would take more than LONGEST_S a frame by arithmetic alone is left out and says so.  ONNX
    files, only for frames up to ONNX_SIDE, go to `folder`.
    """

    def __init__(self, folder: Path, *, seconds: float, bins: int):
        self.folder, self.seconds, self.bins = folder, seconds, bins
        self._peak_macs_per_s = cache(measure_peak_conv_macs_per_s)
        self._macs = cache(self._count_macs)
        self._postprocessor_ms = cache(time_postprocessor)
        self._onnx_file = cache(self._export_onnx)

    def measure(
        self, candidate: Candidate, sides: Sequence[int], thread_counts: Sequence[int],
        forms: Sequence[str], devices: Sequence[str],
    ) -> Iterable[SpeedMeasurement]:  # fmt: skip
        """Yield one measurement for each combination; a GPU has no threads to choose, no OpenVINO
        and no ONNX."""
        for side, device, form, threads in product(sides, devices, forms, thread_counts):
            if device == "cpu":
                skipped = form == "onnx" and side > ONNX_SIDE
            else:
                skipped = form in ("openvino", "onnx") or threads != thread_counts[0]
            if not skipped:
                threads = threads if device == "cpu" else 1
                whose = candidate.name, candidate.trained, candidate.views
                entry = SpeedMeasurement(*whose, side, device, threads, form)
                yield self._measure_one(candidate, entry)

    def _measure_one(self, candidate: Candidate, entry: SpeedMeasurement) -> SpeedMeasurement:
        try:
            macs, post = self._macs(candidate, entry.side), candidate.postprocessor
            modules = [candidate.loaded, *([post] if post is not None else [])]
            params = sum(p.numel() for module in modules for p in module.parameters())
            entry = replace(entry, gmac=macs / 1e9, params=params)
            if entry.device == "cpu":
                peak = self._peak_macs_per_s(FORM_DTYPES[entry.form], threads=entry.threads)
                if macs / peak > LONGEST_S:
                    raise ValueError(f"more than {LONGEST_S:g} s a frame by arithmetic alone")
            return self._time(candidate, entry)
        except ValueError as error:
            return replace(entry, reason=str(error))

    def _count_macs(self, candidate: Candidate, side: int) -> int:
        """Return the multiply-accumulates of a frame, by shapes alone where the network allows."""
        network, views = candidate.loaded, candidate.views
        try:
            shapes = inference_copy(network).to("meta")
            macs = macs_per_frame(shapes, side, side, views=views, bins=self.bins)
        except (NotImplementedError, RuntimeError):  # it looks at values
            macs = macs_per_frame(network, side, side, views=views, bins=self.bins)
        if (post := candidate.postprocessor) is not None:
            frames = torch.zeros(1, post.WINDOW, 1, PREVIEW_SIDE, PREVIEW_SIDE)
            window = count_macs(lambda: post.restore(frames)) * side**2 // PREVIEW_SIDE**2
            macs += window // (post.WINDOW - post.OVERLAP)
        return macs

    def _time(self, candidate: Candidate, entry: SpeedMeasurement) -> SpeedMeasurement:
        after_ms = self._time_postprocessor(candidate, entry)
        step, windows = self._build_step(candidate.loaded, entry), _draw_windows(entry)
        played = cycle(windows)
        took = time_calls(
            lambda: step(*next(played)),
            threads=entry.threads, device=entry.device, seconds=self.seconds,
        )  # fmt: skip
        return replace(
            entry, ms=took.median_ms + after_ms, least_ms=took.least_ms + after_ms,
            frames=took.frames, clock=took.clock,
        )  # fmt: skip

    def _build_step(self, network: EventToVideoNetwork, entry: SpeedMeasurement) -> EventStep:
        """Return what goes from the events of a window to a frame as `src.reconstruct` does."""
        form, side, threads, views = entry.form, entry.side, entry.threads, entry.views
        if entry.device == "cpu" and form in EVENT_LIST_FORMS and supports_event_lists(network):
            size = {"height": side, "width": side}
            runtime = EventListRuntime(
                network, positions=layout(views), threads=threads, form=form, **size
            )
            return runtime.step
        if form == "onnx":
            network = OnnxNetwork(self._onnx_file(network, entry.network, views, side), threads)
        else:
            network = convert_to_form(inference_copy(network), form)
        return build_grid_step(network.to(entry.device), views, side, side, bins=self.bins)

    def _export_onnx(self, network: EventToVideoNetwork, name: str, views: int, side: int) -> Path:
        path = self.folder / f"{name.replace('/', '_')}_{side}.onnx"
        export_onnx(network, path, views=views, height=side, width=side, bins=self.bins)
        return path

    def _time_postprocessor(self, candidate: Candidate, entry: SpeedMeasurement) -> float:
        """Return its ms for a frame, 0 without one; raises ValueError where a small frame shows
        that it takes more than LONGEST_S, and where it is not timed.
        """
        if (post := candidate.postprocessor) is None:
            return 0.0
        if entry.form != "float32" or entry.device != "cpu":
            raise ValueError("with a post-processor it is timed in float32 on the CPU")
        preview_ms = self._postprocessor_ms(post, PREVIEW_SIDE, threads=entry.threads)
        if preview_ms * entry.side**2 / PREVIEW_SIDE**2 > 1e3 * LONGEST_S:
            raise ValueError(f"more than {LONGEST_S:g} s a frame")
        return self._postprocessor_ms(post, entry.side, threads=entry.threads)


def build_grid_step(
    network: EventToVideoNetwork, views: int, height: int, width: int, *, bins: int = 5,
    window_s: float = WINDOW_S,
) -> EventStep:  # fmt: skip
    """Return a step from a window's events through dense grids and `network`, the state kept."""
    size, state = {"bins": bins, "height": height, "width": width}, None
    device = next((parameter.device for parameter in network.parameters()), torch.device("cpu"))

    @torch.no_grad()
    def step(t, x, y, p, view, t0: float, t1: float) -> Float[np.ndarray, "h w"]:
        nonlocal state
        parts = [slice(None)] if views == 1 else [view == index for index in range(views)]
        grids = [voxel_grid(t[k], x[k], y[k], p[k], t0=t0, t1=t1, **size) for k in parts]
        voxels = torch.stack(grids)[None].to(device)
        frame, state = network(voxels, state, window_s=window_s)
        return frame[0, 0].float().cpu().numpy()

    return step


def _draw_windows(entry: SpeedMeasurement) -> list[tuple[Any, ...]]:
    """Return windows of events, as a step takes them, uniform over views and pixels."""
    rng, side, views = np.random.default_rng(0), entry.side, entry.views
    count, windows = int(EVENTS_PER_PIXEL * views * side**2), []
    for k in range(WINDOWS):
        t0, t1 = k * WINDOW_S, (k + 1) * WINDOW_S
        t = np.sort(rng.uniform(t0, t1, count))
        x, y = rng.integers(0, side, (2, count))
        p, view = rng.choice([-1, 1], count), rng.integers(0, views, count)
        windows.append((t, x, y, p, view, t0, t1))
    return windows


@torch.no_grad()
def time_postprocessor(post: FramePostprocessor, side: int, *, threads: int = 1) -> float:
    """Return the ms for each frame, `side` pixels square, of a long video; the median of three.

    Its windows of WINDOW frames overlap by OVERLAP: what two of them share is paid for twice.
    """
    frames = torch.rand(1, post.WINDOW, 1, side, side)
    took = time_calls(lambda: post.restore(frames), threads=threads, seconds=0, min_calls=3)
    return took.median_ms / (post.WINDOW - post.OVERLAP)


@torch.no_grad()
def measure_peak_conv_macs_per_s(dtype: torch.dtype, *, threads: int = 1) -> float:
    """Return the multiply-accumulates a second of a large 3x3 convolution, channels-last, the best
    of eight: what no network of convolutions exceeds by much.
    """
    x, kernel = (
        torch.randn(size).to(dtype=dtype, memory_format=torch.channels_last)
        for size in ((1, PEAK_CHANNELS, PEAK_SIDE, PEAK_SIDE), (PEAK_CHANNELS, PEAK_CHANNELS, 3, 3))
    )
    convolve = partial(functional.conv2d, x, kernel, padding=1)
    took = time_calls(convolve, threads=threads, seconds=0, min_calls=8)
    return PEAK_SIDE**2 * PEAK_CHANNELS**2 * 9 / (took.least_ms / 1e3)
