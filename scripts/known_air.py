"""What the meter of task=air finds in air that is known: python -m scripts.known_air [clips, 20] [first, 1000] [again | warps | air.yaml].

Clip k is a photograph seen through air that shows an rms of 0.25 to 1.5 px of 256, a half length
of 5 to 70 px (both log-uniform) and a decay of 0.04 to 0.2 s: 240 frames of 512 px at 30 a second,
as many and as large as task=air works on, `ar1` and `flow` in turn, noise of 1 %, 8 bits.  Printed is what was found "of clip",
over what that very clip was given: its tilt field less every point's mean, as a film shows no more;
and "of air", over what its atmosphere gives on average; 1 for `held` where the interval holds that.
`again`: besides, a clip of the same photograph in air drawn from what was measured
(turbulence=measured) is measured, over what was found first; of `blur_ratio`, its excess of one.
`air.yaml`: photographs in air drawn from that file instead, and what is found.
`warps`: a table of Gaussian warps instead, new in each of 24 frames of 256 px, of two photographs:
rms and half length found over those given.
"""  # noqa: E501

import math
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float
from omegaconf import OmegaConf

from src.recordings.calibration import air_meter
from src.recordings.calibration.air_meter import Air
from src.recordings.calibration.covariance import crossing
from src.recordings.files.measured import AirFile, Estimate, MeasuredAir
from src.sim.turbulence.atmosphere import ALPHA_FPS, Atmosphere
from src.sim.turbulence.operator import Turbulence
from src.sim.turbulence.prior import Appearance, matching
from src.sim.turbulence.ranges import log_between

PHOTOGRAPHS = Path("../shared/data/photos/bsds500_val")
CONF = Path(__file__).resolve().parents[1] / "conf/turbulence/measured.yaml"
SIDE, FILM, FRAMES, FPS, NOISE = 256, 512, 240, 30.0, 0.01
RMS, HALF, DECAY, TIMES = (0.25, 1.5), (5.0, 70.0), (0.04, 0.2), ("ar1", "flow")
WARPS = (3.3, 6.7, 13.3, 26.6, 53.3), (0.25, 0.75, 1.5)  # half lengths, rms
KEYS = ("rms_px", "half_length_px", "whole_share", "decay_s", "blur_ratio")


def photograph(k: int, wide: int = FILM) -> Float[np.ndarray, "h w"]:
    """Return photograph k of PHOTOGRAPHS, the middle square, `wide` pixels, in [0, 1]."""
    files = sorted(PHOTOGRAPHS.glob("*.jpg"))
    picture = cv2.imread(str(files[k % len(files)]), cv2.IMREAD_GRAYSCALE)
    side = min(picture.shape)
    top, left = ((length - side) // 2 for length in picture.shape)
    square = picture[top : top + side, left : left + side]
    way = cv2.INTER_AREA if wide < side else cv2.INTER_CUBIC
    return cv2.resize(square, (wide, wide), interpolation=way).astype(np.float32) / 255


def path_of(k: int) -> Atmosphere:
    """Return the air of clip k: the first of its draws that a camera shows."""
    generator = torch.Generator().manual_seed(k)
    while True:
        u = torch.rand(3, generator=generator).tolist()
        seen = Appearance(
            tilt_px=float(log_between(u[0], RMS, "rms")),
            half_length_px=float(log_between(u[1], HALF, "half length")),
            decay_s=float(log_between(u[2], DECAY, "decay")),
        )
        try:
            return matching(seen, generator)
        except ValueError:
            continue


def film(
    picture: Float[np.ndarray, "h w"], path: Atmosphere, k: int
) -> tuple[Float[np.ndarray, "frames h w"], Float[np.ndarray, "frames 2 h w"]]:
    """Return a film of the picture through the air, and its tilt in pixels of SIDE."""
    size = {"views": 1, "height": FILM, "width": FILM, "fps": FPS}
    air = Turbulence(path, temporal=TIMES[k % 2], **size)
    clean = torch.from_numpy(picture).expand(1, FRAMES, -1, -1)
    seen = air.degrade(clean, torch.Generator().manual_seed(k))[0, 0].numpy()
    tilt = air.tilt(FRAMES, torch.Generator().manual_seed(k))[0].numpy()
    return _recorded(seen, k), tilt * (SIDE / FILM)


def warped(
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


def _recorded(seen: np.ndarray, k: int) -> np.ndarray:
    """Return what a camera makes of the light: noise, 8 bits."""
    noisy = seen + NOISE * np.random.default_rng(k).standard_normal(seen.shape, np.float32)
    return np.round(noisy.clip(0, 1) * 255) / 255


def given(tilt: Float[np.ndarray, "frames 2 h w"]) -> tuple[float, float, float, float]:
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
    half = crossing(np.arange(side) * (SIDE / side), product / product[0], 0.5)
    decay = crossing(np.arange(len(lags)) / FPS, np.array(lags) / lags[0], math.exp(-1))
    return float(product[0]) ** 0.5, half, whole, decay


def drawn(file: Path, k: int) -> Atmosphere:
    """Return air drawn from a file of task=air."""
    options = OmegaConf.to_container(OmegaConf.load(CONF)) | {"measured": file}
    options.pop("_target_")
    return MeasuredAir(**options).draw(torch.Generator().manual_seed(k))


def drawn_again(found: AirFile, k: int) -> Atmosphere:
    """Return air drawn from what was found."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "air.yaml"
        file.write_text(found.text())
        return drawn(file, k)


def found_in(frames: Float[np.ndarray, "frames h w"]) -> Air | str:
    """Return what the meter finds, or why it refuses."""
    try:
        return air_meter.measure(frames, FPS)
    except ValueError as error:
        return str(error)


def compared(path: Atmosphere, tilt: np.ndarray, found: AirFile) -> dict[str, float]:
    """Return what was found over what is known, and whether the intervals hold the air's."""
    rms, half, whole, decay = given(tilt)
    length = _number(found.half_length_px)
    own, reach = path.tilt_std_px(SIDE), path.half_length_px(SIDE)
    return {
        "rms of clip": found.rms_px.value / rms,
        "rms of air": found.rms_px.value / own,
        "rms held": _holds(found.rms_px, own),
        "half length of clip": length / half,
        "half length of air": length / reach,
        "half length held": _holds(found.half_length_px, reach),
        "whole view less clip's": found.whole_share.value - whole,
        "decay of clip": _number(found.decay_s) / decay,
        "decay of air": _number(found.decay_s) / decay_s(path),
    }


def repeated(found: AirFile, k: int, picture: Float[np.ndarray, "h w"]) -> dict[str, float]:
    """Return what is found in a clip drawn from what was found, over that."""
    again = found_in(film(picture, drawn_again(found, k), k)[0])
    if isinstance(again, str):
        return {}
    ratios = {}
    for key in KEYS:
        one, two = (_number(getattr(each, key)) for each in (found, again.found))
        ratios[f"again {key}"] = (two - 1) / (one - 1) if key == "blur_ratio" else two / one
    return ratios


def decay_s(path: Atmosphere) -> float:
    """Return the time to 1 / e that an air was drawn with."""
    return -1 / (ALPHA_FPS * math.log(path.alpha))


def _number(one: Estimate) -> float:
    return math.nan if one.value is None else one.value


def _holds(one: Estimate, number: float) -> float:
    return float((one.low or 0) <= number <= (one.high or math.inf))


def summary(rows: Sequence[Mapping[str, float]]) -> Iterator[str]:
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


def table() -> Iterator[str]:
    """Yield the rows of the table of warps, as Markdown."""
    for half in WARPS[0]:
        cells = []
        for rms in WARPS[1]:
            rows = []
            for k in range(2):
                frames, tilt = warped(photograph(k, SIDE), half, rms, k)
                found, known = found_in(frames), given(tilt)
                if not isinstance(found, str):
                    length = _number(found.found.half_length_px)
                    rows.append((found.found.rms_px.value / known[0], length / known[1]))
            ranges = ("-".join(f"{v:.2f}" for v in sorted(v)) for v in zip(*rows, strict=True))
            cells.append(", ".join(ranges) or "refused")
        yield f"| {half} | " + " | ".join(cells) + " |"


def known(numbers: range, again: bool) -> Iterator[str]:
    """Yield a line for every clip, and what they come to."""
    rows = []
    for k in numbers:
        picture, path = photograph(k), path_of(k)
        seen, tilt = film(picture, path, k)
        air = f"{path.tilt_std_px(SIDE):.2f} px, half length {path.half_length_px(SIDE):.0f} px"
        air = f"{k} {TIMES[k % 2]}, rms {air}, decay {decay_s(path):.2f} s"
        air += f", D/r0 {path.d_over_r0:.1f}, lambda / D {path.airy_px(SIDE):.1f} px: "
        found = found_in(seen)
        if isinstance(found, str):
            yield air + found
            continue
        row = compared(path, tilt, found.found)
        row |= repeated(found.found, k, picture) if again else {}
        rows.append(row)
        shown = ", ".join(f"{name} {value:.2f}" for name, value in row.items())
        yield f"{air}{len(found.place)} points, {shown}"
    yield from summary(rows)


def like(file: Path, numbers: range) -> Iterator[str]:
    """Yield what is found in photographs seen through air drawn from a file of task=air."""
    for k in numbers:
        found = found_in(film(photograph(k), drawn(file, k), k)[0])
        shown = {"refused": found} if isinstance(found, str) else vars(found.found)
        yield f"{k} " + ", ".join(f"{key} {one}" for key, one in shown.items())


def main(words: Sequence[str]) -> None:
    """Print what the command line asks for."""
    torch.set_num_threads(1)
    given_numbers = [int(word) for word in words if word.isdecimal()]
    count, first = (*given_numbers, *(20, 1000)[len(given_numbers) :])
    numbers = range(first, first + count)
    files = [Path(word) for word in words if word.endswith(".yaml")]
    lines = table() if "warps" in words else known(numbers, "again" in words)
    for line in like(files[0], numbers) if files else lines:
        print(line, flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
