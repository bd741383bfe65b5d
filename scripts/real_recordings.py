"""Real recordings through networks: python -m scripts.real_recordings FOLDER OUT NETWORK ...

A NETWORK is `ckpt=NAME` or "baseline=NAME baseline.weights=PATH".  Every event file of FOLDER
becomes a video below OUT, and one picture shows the last frame of each, `recordings.png`.  Where a
folder also has a camera's frames (`images.txt`: seconds and file), SSIM, LPIPS and correlation with
them, each against the reconstruction nearest in time, are printed as a Markdown table.
"""

import argparse
from pathlib import Path

import cv2
import numpy as np
import torch
from hydra import compose, initialize_config_dir

from src.metrics.image import ssim
from src.metrics.lpips import LPIPS
from src.reconstruct import reconstruct
from src.recordings.files import sources

CONF = Path(__file__).resolve().parents[1] / "conf"
FPS, PANEL = 120.0, 200  # frames a second; height of a panel


def recordings(folder: Path) -> list[Path]:
    """Return the event files of `folder`, in order."""
    kinds = {".raw", ".es", ".aedat4", ".dat"}
    found = {path for path in folder.rglob("*") if path.suffix in kinds}
    return sorted(found | set(folder.rglob("events*.txt")))


def film(recording: Path, network: str, out: Path) -> np.ndarray:
    """Reconstruct `recording`; returns the film (frames, h, w)."""
    size = ["sensor_size=[180,240]"] if recording.suffix == ".txt" else []  # DAVIS240C
    given = [f"recording='{recording}'", *network.split(), *size, f"fps={FPS}", "output=hdf5"]
    with initialize_config_dir(str(CONF), version_base=None):
        cfg = compose("reconstruct", [*given, f"paths.out={out}"])
    cfg.paths.run = str(out)
    reconstruct(cfg)
    return np.stack(list(sources.film(out / "video.h5")))


def compared(pictures: np.ndarray, out: Path, recording: Path, lpips: LPIPS) -> dict | None:
    """Return SSIM, LPIPS and correlation with the camera's frames; None where there are none."""
    listed = recording.parent / "images.txt"
    if not listed.is_file():
        return None
    clock = np.loadtxt(out / "frames.csv", delimiter=",", skiprows=1, usecols=1, ndmin=1)
    scores = []
    for line in listed.read_text().splitlines():
        second, name = line.split()
        nearest = int(np.abs(clock - float(second)).argmin())
        if abs(clock[nearest] - float(second)) > 0.5 / FPS or nearest < 2:
            continue
        truth = next(sources.film(recording.parent / name))
        a, b = (torch.from_numpy(p.copy())[None, None] for p in (pictures[nearest], truth))
        together = np.corrcoef(pictures[nearest].ravel(), truth.ravel())[0, 1]
        scores.append([float(ssim(a, b)), float(lpips(a, b)), together])
    return dict(zip(("ssim", "lpips", "correlation"), np.mean(scores, 0), strict=True))


def events_picture(recording: Path, size: tuple[int, int]) -> np.ndarray:
    """Return the balance of events of the last 1/FPS seconds as grey levels."""
    events = np.concatenate(list(sources.events(recording, size)))
    late = events[events["t"] >= events["t"][-1] - 1e6 / FPS]
    balance = np.zeros(size, np.float32)
    np.add.at(balance, (late["y"], late["x"]), late["p"])
    return np.clip(0.5 + balance / 6, 0, 1)


def panel(picture: np.ndarray, text: str) -> np.ndarray:
    """Return the picture at the panels' height with `text` in its corner."""
    width = round(picture.shape[1] * PANEL / picture.shape[0])
    grey = cv2.resize(picture, (width, PANEL), interpolation=cv2.INTER_AREA)
    grey = np.ascontiguousarray(np.round(255 * grey).astype(np.uint8))
    font = (cv2.FONT_HERSHEY_SIMPLEX, 0.45)
    (wide, _), _ = cv2.getTextSize(text, *font, 1)
    cv2.rectangle(grey, (0, 0), (wide + 8, 20), 0, cv2.FILLED)
    cv2.putText(grey, text, (4, 15), *font, 255, 1, cv2.LINE_AA)
    return np.pad(grey, 2, constant_values=255)


def main() -> None:
    """Read the arguments, reconstruct everything, write the picture, print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("networks", nargs="+")
    arguments = parser.parse_args()
    lpips, rows = LPIPS(), []
    print(
        "| recording | network | frames | SSIM | LPIPS | correlation |\n|---|---|---|---|---|---|"
    )
    for recording in recordings(arguments.folder):
        panels, name = [], "/".join(recording.parts[-2:])
        for network in arguments.networks:
            short = Path(network.split()[0].partition("=")[2]).stem
            out = arguments.out / name.replace("/", "_") / short
            pictures = film(recording, network, out)
            found = compared(pictures, out, recording, lpips)
            cells = [f"{value:.3f}" for value in found.values()] if found else ["-"] * 3
            print(f"| {name} | {short} | {len(pictures)} | " + " | ".join(cells) + " |", flush=True)
            panels.append(panel(pictures[-1], short))
        rows.append([panel(events_picture(recording, pictures.shape[1:]), name), *panels])
    widest = max(sum(part.shape[1] for part in row) for row in rows)
    lines = [np.concatenate(row, 1) for row in rows]
    lines = [np.pad(ln, ((0, 0), (0, widest - ln.shape[1])), constant_values=255) for ln in lines]
    cv2.imwrite(str(arguments.out / "recordings.png"), np.concatenate(lines))


if __name__ == "__main__":
    main()
