"""How well task=air measures turbulence that is known:

    python -m scripts.check_turbulence_meter [again | warps | compressed | air.yaml]
        [--clips 20] [--first 1000]

Clip k is a photograph seen through simulated turbulence with a tilt of 0.25 to 1.5 px rms of 256, a
half length of 5 to 70 px (both log-uniform) and a correlation time of 0.04 to 0.2 s: 240 frames of
512 px at 30 a second, `ar1` and `frozen_flow` in turn, noise of 1 %, 8 bits.  Printed is what was
found over what that very clip was given ("of clip": its tilt field less every point's mean, as
footage shows no more) and over what its atmosphere gives on average ("of atmosphere"); 1 for `held`
where the interval holds that.  `again`: besides, a clip drawn from what was measured
(turbulence=measured) is measured, over what was found first.  `air.yaml`: clips drawn from that
file instead, and what is found.  `warps`: a table of Gaussian warps instead, new in each of 24
frames of 256 px, of two photographs.  `compressed`: a table of such footage of a half length of
13.3 px, compressed.
"""

import argparse
import io
import math
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import av
import cv2
import numpy as np
import torch
from jaxtyping import Float
from omegaconf import OmegaConf

from src.app.script import run_script
from src.recordings.files.turbulence_file import (
    IntervalEstimate,
    MeasuredTurbulence,
    TurbulenceFile,
)
from src.recordings.turbulence_measurement import turbulence_meter
from src.recordings.turbulence_measurement.tilt_covariance import find_first_fall
from src.recordings.turbulence_measurement.turbulence_meter import TurbulenceMeasurement
from src.sim.turbulence.atmosphere import AR1_FPS, Atmosphere
from src.sim.turbulence.operator import Turbulence
from src.sim.turbulence.prior import TargetImageStatistics, log_uniform, sample_matching_atmosphere

PHOTOGRAPHS = Path("../shared/data/photos/bsds500_val")
CONF = Path(__file__).resolve().parents[1] / "conf/turbulence/measured.yaml"
SIDE, FILM, FRAMES, FPS, NOISE = 256, 512, 240, 30.0, 0.01
RMS, HALF, DECAY, TIMES = (0.25, 1.5), (5.0, 70.0), (0.04, 0.2), ("ar1", "frozen_flow")
WARPS = (3.3, 6.7, 13.3, 26.6, 53.3), (0.25, 0.75, 1.5)  # half lengths, rms
COMPRESSED_WARPS = 13.3, (0.0, 0.1, 0.25, 0.5)  # half length, rms
KEYS = (
    "tilt_rms_px",
    "tilt_correlation_half_length_px",
    "global_tilt_share",
    "tilt_correlation_time_s",
    "blur_px",
)


def load_photograph(k: int, wide: int = FILM) -> Float[np.ndarray, "h w"]:
    """Return photograph k of PHOTOGRAPHS, the middle square, `wide` pixels, in [0, 1]."""
    files = sorted(PHOTOGRAPHS.glob("*.jpg"))
    picture = cv2.imread(str(files[k % len(files)]), cv2.IMREAD_GRAYSCALE)
    side = min(picture.shape)
    top, left = ((length - side) // 2 for length in picture.shape)
    square = picture[top : top + side, left : left + side]
    way = cv2.INTER_AREA if wide < side else cv2.INTER_CUBIC
    return cv2.resize(square, (wide, wide), interpolation=way).astype(np.float32) / 255


def draw_atmosphere(k: int) -> Atmosphere:
    """Return the atmosphere of clip k: the first of its draws that a camera shows."""
    generator = torch.Generator().manual_seed(k)
    while True:
        u = torch.rand(3, generator=generator).tolist()
        seen = TargetImageStatistics(
            tilt_px=float(log_uniform(u[0], RMS, "rms")),
            tilt_correlation_half_length_px=float(log_uniform(u[1], HALF, "half length")),
            tilt_correlation_time_s=float(log_uniform(u[2], DECAY, "decay")),
        )
        try:
            return sample_matching_atmosphere(seen, generator)
        except ValueError:
            continue


def simulate_footage(
    picture: Float[np.ndarray, "h w"], path: Atmosphere, k: int
) -> tuple[Float[np.ndarray, "frames h w"], Float[np.ndarray, "frames 2 h w"]]:
    """Return footage of the picture through turbulence, and its tilt in pixels of SIDE."""
    size = {"views": 1, "height": FILM, "width": FILM, "fps": FPS}
    air = Turbulence(path, temporal_model=TIMES[k % 2], **size)
    clean = torch.from_numpy(picture).expand(1, FRAMES, -1, -1)
    seen = air.degrade(clean, torch.Generator().manual_seed(k))[0, 0].numpy()
    tilt = air.tilt(FRAMES, torch.Generator().manual_seed(k))[0].numpy()
    return _recorded(seen, k), tilt * (SIDE / FILM)


def warp_photograph(
    picture: Float[np.ndarray, "h w"], half: float, rms: float, k: int
) -> tuple[Float[np.ndarray, "frames h w"], Float[np.ndarray, "frames 2 h w"]]:
    """Return 24 frames of the picture warped by Gaussian fields, and these, in pixels."""
    rng, sigma = np.random.default_rng(k), half / math.sqrt(4 * math.log(2))
    rim = math.ceil(4 * sigma)
    inside = (slice(rim, rim + SIDE),) * 2
    drawn = rng.standard_normal((24, 2, SIDE + 2 * rim, SIDE + 2 * rim), np.float32)
    soft = [[cv2.GaussianBlur(axis, (0, 0), sigma)[inside] for axis in pair] for pair in drawn]
    tilt = np.array(soft) * np.float32(2 * math.sqrt(math.pi) * sigma * rms)
    y, x = np.mgrid[:SIDE, :SIDE].astype(np.float32)
    frames = [
        cv2.remap(picture, x - dx, y - dy, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
        for dx, dy in tilt
    ]
    return _recorded(np.stack(frames), k), tilt


def compress_as_jpeg(frames: Float[np.ndarray, "n h w"], quality: int) -> np.ndarray:
    """Return the frames, each read back from a JPEG of that quality."""
    options = [cv2.IMWRITE_JPEG_QUALITY, quality]
    files = (cv2.imencode(".jpg", frame, options)[1] for frame in _as_bytes(frames))
    read = [cv2.imdecode(file, cv2.IMREAD_GRAYSCALE) for file in files]
    return np.stack(read).astype(np.float32) / 255


def compress_as_h264(frames: Float[np.ndarray, "n h w"], crf: int) -> np.ndarray:
    """Return the frames read back from an H.264 video of that constant rate factor (x264)."""
    file = io.BytesIO()
    with av.open(file, "w", format="mp4") as video:
        stream = video.add_stream("libx264", rate=round(FPS), options={"crf": str(crf)})
        stream.height, stream.width = frames.shape[1:]
        for frame in _as_bytes(frames):
            video.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="gray")))
        video.mux(stream.encode())
    file.seek(0)
    with av.open(file) as video:
        read = [frame.to_ndarray(format="gray") for frame in video.decode(video=0)]
    return np.stack(read).astype(np.float32) / 255


def _as_bytes(frames: np.ndarray) -> np.ndarray:
    return np.round(frames * 255).astype(np.uint8)


def _recorded(seen: np.ndarray, k: int) -> np.ndarray:
    """Return what a camera makes of the light: noise, 8 bits."""
    noisy = seen + NOISE * np.random.default_rng(k).standard_normal(seen.shape, np.float32)
    return np.round(noisy.clip(0, 1) * 255) / 255


def describe_tilt(tilt: Float[np.ndarray, "frames 2 h w"]) -> tuple[float, float, float, float]:
    """Return rms, half length, share of the whole view and decay in seconds of a clip's own tilt,
    less its mean; lengths in pixels of SIDE."""
    tilt = tilt - tilt.mean(0)
    side = tilt.shape[-1]
    wide = 2 * side
    power = sum(np.abs(np.fft.rfft2(frame, s=(wide, wide))) ** 2 for frame in tilt).sum(0)
    pairs = np.fft.irfft2(np.abs(np.fft.rfft2(np.ones((side, side)), s=(wide, wide))) ** 2)
    away = np.fft.fftfreq(wide, 1 / wide)
    ring = np.round(np.hypot(away[:, None], away)).astype(int).ravel()
    near = ring < side
    total = np.bincount(ring[near], np.fft.irfft2(power).ravel()[near])
    product = total / np.bincount(ring[near], pairs.ravel()[near]) / (2 * len(tilt))
    whole = float((tilt.mean((2, 3)) ** 2).mean() / product[0])
    some = tilt[..., ::8, ::8]
    lags = [(some[lag:] * some[: len(some) - lag]).mean() for lag in range(len(some) // 2)]
    half = find_first_fall(np.arange(side) * (SIDE / side), product / product[0], 0.5)
    decay = find_first_fall(np.arange(len(lags)) / FPS, np.array(lags) / lags[0], math.exp(-1))
    return float(product[0]) ** 0.5, half, whole, decay


def draw_from_file(file: Path, k: int) -> Atmosphere:
    """Return an atmosphere drawn from a file of task=air."""
    options = OmegaConf.to_container(OmegaConf.load(CONF)) | {"measured": file}
    options.pop("_target_")
    return MeasuredTurbulence(**options).draw(torch.Generator().manual_seed(k))


def draw_from_measurement(found: TurbulenceFile, k: int) -> Atmosphere:
    """Return an atmosphere drawn from what was found."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "air.yaml"
        file.write_text(found.to_yaml())
        return draw_from_file(file, k)


def measure_or_refusal(frames: Float[np.ndarray, "frames h w"]) -> TurbulenceMeasurement | str:
    """Return what the meter finds, or why it refuses."""
    try:
        return turbulence_meter.measure_turbulence(frames, FPS)
    except ValueError as error:
        return str(error)


def compare_measurement(
    path: Atmosphere, tilt: np.ndarray, found: TurbulenceFile
) -> dict[str, float]:
    """Return what was found over what is known, and whether the intervals hold the atmosphere's."""
    rms, half, whole, decay = describe_tilt(tilt)
    length = _number(found.tilt_correlation_half_length_px)
    time_s = _number(found.tilt_correlation_time_s)
    own, reach = path.tilt_std_px(SIDE), path.tilt_correlation_half_length_px(SIDE)
    return {
        "rms of clip": found.tilt_rms_px.value / rms,
        "rms of atmosphere": found.tilt_rms_px.value / own,
        "rms held": _holds(found.tilt_rms_px, own),
        "half length of clip": length / half,
        "half length of atmosphere": length / reach,
        "half length held": _holds(found.tilt_correlation_half_length_px, reach),
        "whole view less clip's": found.global_tilt_share.value - whole,
        "decay of clip": time_s / decay,
        "decay of atmosphere": time_s / tilt_correlation_time_s(path),
        "blur of atmosphere": found.blur_px.value / path.blur_px(SIDE),
        "blur held": _holds(found.blur_px, path.blur_px(SIDE)),
    }


def measure_again(
    found: TurbulenceFile, k: int, picture: Float[np.ndarray, "h w"]
) -> dict[str, float]:
    """Return what is found in a clip drawn from what was found, over that."""
    again = measure_or_refusal(simulate_footage(picture, draw_from_measurement(found, k), k)[0])
    if isinstance(again, str):
        return {}
    ratios = {}
    for key in KEYS:
        one, two = (_number(getattr(each, key)) for each in (found, again.found))
        ratios[f"again {key}"] = two / one if one else math.nan
    return ratios


def tilt_correlation_time_s(path: Atmosphere) -> float:
    """Return the time to 1 / e that an atmosphere was drawn with."""
    return -1 / (AR1_FPS * math.log(path.ar1_coefficient))


def _number(one: IntervalEstimate) -> float:
    return math.nan if one.value is None else one.value


def _holds(one: IntervalEstimate, number: float) -> float:
    return float((one.low or 0) <= number <= (one.high or math.inf))


def summarise(rows: Sequence[Mapping[str, float]]) -> Iterator[str]:
    """Yield, of every number, how many are within 20 % of 1 and quantiles; or how many hold."""
    for name in dict.fromkeys(name for row in rows for name in row):
        values = np.array([row[name] for row in rows if name in row])
        values = values[np.isfinite(values)]
        if name.endswith("held"):
            yield f"{name} by its interval: {values.sum():.0f} of {len(values)}"
            continue
        near = int((np.abs(values - 1) <= 0.2).sum())
        low, middle, high = np.percentile(values, [10, 50, 90])
        within = "" if "less" in name else f"within 20 % {near} of {len(values)}, "
        yield f"{name}: {within}10 / 50 / 90 % {low:.2f} / {middle:.2f} / {high:.2f}"


def warp_table() -> Iterator[str]:
    """Yield the rows of the table of warps, as Markdown."""
    for half in WARPS[0]:
        cells = (measure_warps(half, rms) for rms in WARPS[1])
        yield f"| {half} | " + " | ".join(cells) + " |"


def compression_table() -> Iterator[str]:
    """Yield the rows of the table of compressed footage, as Markdown."""
    half, spreads = COMPRESSED_WARPS
    ways: dict[str, Callable[[np.ndarray], np.ndarray]] = {"none": lambda frames: frames}
    for quality in (75, 50):
        ways[f"JPEG {quality}"] = lambda frames, q=quality: compress_as_jpeg(frames, q)
    for crf in (23, 28):
        ways[f"H.264 {crf}"] = lambda frames, c=crf: compress_as_h264(frames, c)
    for name, way in ways.items():
        cells = (measure_warps(half, rms, way) for rms in spreads)
        yield f"| {name} | " + " | ".join(cells) + " |"


def measure_warps(
    half: float, rms: float, compress: Callable[[np.ndarray], np.ndarray] = lambda frames: frames
) -> str:
    """Return what is found over what is known in footage of two photographs."""
    rows = []
    for k in range(2):
        frames, tilt = warp_photograph(load_photograph(k, SIDE), half, rms, k)
        found = measure_or_refusal(compress(frames))
        if not isinstance(found, str):
            known = describe_tilt(tilt)
            length = _number(found.found.tilt_correlation_half_length_px)
            rows.append((found.found.tilt_rms_px.value / known[0], length / known[1]))
    ranges = ("-".join(f"{v:.2f}" for v in sorted(v)) for v in zip(*rows, strict=True))
    return ", ".join(ranges) or "refused"


def simulated_clips(numbers: range, again: bool) -> Iterator[str]:
    """Yield a line for every clip, and what they come to."""
    rows = []
    for k in numbers:
        picture, path = load_photograph(k), draw_atmosphere(k)
        seen, tilt = simulate_footage(picture, path, k)
        length = path.tilt_correlation_half_length_px(SIDE)
        air = f"{path.tilt_std_px(SIDE):.2f} px, half length {length:.0f} px"
        air = f"{k} {TIMES[k % 2]}, rms {air}, decay {tilt_correlation_time_s(path):.2f} s"
        air += f", D/r0 {path.d_over_r0:.1f}, lambda / D {path.lambda_over_d_px(SIDE):.1f} px: "
        found = measure_or_refusal(seen)
        if isinstance(found, str):
            yield air + found
            continue
        row = compare_measurement(path, tilt, found.found)
        row |= measure_again(found.found, k, picture) if again else {}
        rows.append(row)
        shown = ", ".join(f"{name} {value:.2f}" for name, value in row.items())
        yield f"{air}{len(found.place)} points, {shown}"
    yield from summarise(rows)


def clips_like_file(file: Path, numbers: range) -> Iterator[str]:
    """Yield what is found in photographs drawn from a file of task=air."""
    for k in numbers:
        found = measure_or_refusal(
            simulate_footage(load_photograph(k), draw_from_file(file, k), k)[0]
        )
        shown = {"refused": found} if isinstance(found, str) else vars(found.found)
        yield f"{k} " + ", ".join(f"{key} {one}" for key, one in shown.items())


def main() -> None:
    """Print what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", nargs="?", help="again, warps, compressed or a file of task=air")
    parser.add_argument("--clips", type=int, default=20)
    parser.add_argument("--first", type=int, default=1000)
    given = parser.parse_args()
    tables = {"warps": warp_table, "compressed": compression_table}
    if not (given.what in (None, "again", *tables) or Path(given.what).is_file()):
        allowed = f"again, {', '.join(tables)} or a file of task=air"
        parser.error(f"what must be {allowed}, got {given.what}")
    torch.set_num_threads(1)
    numbers = range(given.first, given.first + given.clips)
    if given.what in tables:
        lines = tables[given.what]()
    elif given.what in (None, "again"):
        lines = simulated_clips(numbers, given.what == "again")
    else:
        lines = clips_like_file(Path(given.what), numbers)
    for line in lines:
        print(line, flush=True)


if __name__ == "__main__":
    run_script(main)
