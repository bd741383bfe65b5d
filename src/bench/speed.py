"""The stopwatch of the chart: every network in every form, on pictures of every size."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import nn

from src.bench import timing
from src.bench.candidates import Candidate
from src.models import stopwatch
from src.models.cost import macs, macs_per_frame
from src.models.export import OnnxNetwork, export
from src.models.fast import computes_bf16, plain, running

PEAKS = {  # what a form computes in
    "float32": torch.float32, "bf16": torch.bfloat16, "compiled": torch.bfloat16,
    "openvino": torch.bfloat16 if computes_bf16() else torch.float32,
    "onnx": torch.float32,
}  # fmt: skip
FORMS = tuple(PEAKS)
ON_CPU = ("openvino", "onnx")  # and nowhere else
SMALL = 64  # side of the picture that says what a post-processor costs on larger ones
FILLED = 0.05  # share of a grid's entries that are not zero, as in our streams


@dataclass(frozen=True)
class Speed:
    """One network in one form on one size of picture; `limit_ms`, what the arithmetic alone takes.

    `reason`: why there is no time.
    """

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
    peak_mib: float | None = None
    energy_mj: float | None = None
    limit_ms: float | None = None
    reason: str = ""


class Stopwatch:
    """Times networks.  `seconds` for each entry; what would take more than `longest_s` a frame by
    arithmetic alone is left out and says so.  ONNX files, only for pictures up to `onnx_side`, go
    to `folder`.
    """

    def __init__(
        self, folder: Path, *, seconds: float, longest_s: float, bins: int, onnx_side: int
    ):
        self.folder, self.seconds, self.longest_s = folder, seconds, longest_s
        self.bins, self.onnx_side = bins, onnx_side
        self.peaks: dict[tuple[str, int], float] = {}
        self._macs: dict[tuple[str, int], int] = {}
        self._behind: dict[tuple[str, int, int], float] = {}
        self._bytes: dict[tuple[str, str, int, str], int] = {}

    def peak(self, form: str, count: int) -> float:
        """Return the machine's multiply-accumulates a second, measured once."""
        if (form, count) not in self.peaks:
            self.peaks[form, count] = timing.convolution_peak(PEAKS[form], count=count)
        return self.peaks[form, count]

    def rows(
        self, candidate: Candidate, sides: Sequence[int], counts: Sequence[int],
        forms: Sequence[str], devices: Sequence[str],
    ) -> Iterable[Speed]:  # fmt: skip
        """Yield one entry for each combination; a GPU has no threads to choose, no OpenVINO and no
        ONNX."""
        for side in sides:
            for device in devices:
                left_out = ON_CPU if device != "cpu" else ["onnx"] if side > self.onnx_side else []
                for form in (form for form in forms if form not in left_out):
                    for count in counts if device == "cpu" else [1]:
                        yield self._row(candidate, side, device, count, form)

    def _row(self, candidate: Candidate, side: int, device: str, count: int, form: str) -> Speed:
        entry: dict[str, Any] = {
            "network": candidate.name, "trained": candidate.trained, "views": candidate.views,
            "side": side, "device": device, "threads": count, "form": form,
        }  # fmt: skip
        if candidate.network is None:
            return Speed(**entry, reason=candidate.missing)
        work = self._count(candidate, side)
        entry |= {
            "gmac": work / 1e9,
            "params": sum(p.numel() for part in candidate.parts for p in part.parameters()),
            "energy_mj": 1e3 * work * timing.JOULE_PER_MAC,
        }
        if device == "cpu":
            entry["limit_ms"] = 1e3 * work / self.peak(form, count)
            if entry["limit_ms"] > 1e3 * self.longest_s:
                reason = f"more than {self.longest_s:g} s a frame by arithmetic alone"
                return Speed(**entry, reason=reason)
        try:
            return self._timed(candidate, entry)
        except ValueError as error:
            return Speed(**entry, reason=str(error))

    def _count(self, candidate: Candidate, side: int) -> int:
        """Return the multiply-accumulates of a frame, by shapes alone where the network allows."""
        which = (candidate.name, side)
        if which not in self._macs:
            size = {"views": candidate.views, "bins": self.bins}
            try:
                shapes = plain(candidate.network).to("meta")
                self._macs[which] = macs_per_frame(shapes, side, side, **size)
            except (NotImplementedError, RuntimeError):  # it looks at values
                self._macs[which] = macs_per_frame(candidate.network, side, side, **size)
            if candidate.restorer is not None:
                restorer = candidate.restorer
                frames = torch.zeros(1, restorer.WINDOW, 1, SMALL, SMALL)
                behind = macs(lambda: restorer.restore(frames)) * side**2 // SMALL**2
                self._macs[which] += behind // (restorer.WINDOW - restorer.OVERLAP)
        return self._macs[which]

    def _timed(self, candidate: Candidate, entry: dict[str, Any]) -> Speed:
        side, form, device = entry["side"], entry["form"], entry["device"]
        after = 0.0
        if candidate.restorer is not None:
            if form != "float32" or device != "cpu":
                raise ValueError("with a post-processor it is timed in float32 on the CPU")
            after = self._restoration(candidate, side, entry["threads"])
        size = (1, candidate.views, self.bins, side, side)
        drawn = torch.Generator().manual_seed(0)
        voxels = torch.randn(size, generator=drawn)
        voxels = (voxels * (torch.rand(size, generator=drawn) < FILLED)).to(device)
        network = self._running(candidate, form, side, entry["threads"]).to(device)
        if form in ("float32", "bf16"):  # of the others nobody sees the maps
            which = (candidate.name, form, side, device)
            if which not in self._bytes:
                self._bytes[which] = timing.peak_bytes(network, voxels)
            entry["peak_mib"] = self._bytes[which] / 2**20
        took = stopwatch.frame(network, voxels, count=entry["threads"], seconds=self.seconds)
        ms = {"ms": took.median_ms + after, "least_ms": took.least_ms + after}
        return Speed(**entry, **ms, frames=took.frames, clock=took.clock)

    def _restoration(self, candidate: Candidate, side: int, count: int) -> float:
        """Return the ms of a frame, measured once; ValueError where a small picture says that it
        takes more than `longest_s`."""
        for measured in (SMALL, side):
            which = (candidate.name, measured, count)
            if which not in self._behind:
                took = timing.restoration(candidate.restorer, measured, count=count)
                self._behind[which] = took
            ms = self._behind[which] * side**2 / measured**2
            if measured == SMALL and ms > 1e3 * self.longest_s:
                raise ValueError(f"more than {self.longest_s:g} s a frame")
        return ms

    def _running(self, candidate: Candidate, form: str, side: int, count: int) -> nn.Module:
        if form == "float32":
            return plain(candidate.network)
        if form != "onnx":
            return running(candidate.network, form)
        path = self.folder / f"{candidate.name}_{side}.onnx"
        if not path.is_file():
            size = {"views": candidate.views, "height": side, "width": side, "bins": self.bins}
            export(candidate.network, path, **size)
        return OnnxNetwork(path, count)
