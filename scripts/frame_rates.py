"""One recording at several frame rates: python -m scripts.frame_rates RECORDING NETWORK ...

A NETWORK is as for scripts.real_recordings.  The first 0.0875 s are reconstructed at 120, 600 and
12,000 frames a second, with windows of the trained length, which overlap, and with windows of a
frame (`span` of `reconstruct`).  Printed of the last 1/120 s: contrast, the standard deviation of a
picture's pixels, and flicker, the mean absolute change of a pixel from one frame to the next over
the contrast.
"""

import argparse
import tempfile
from pathlib import Path

import numpy as np
from hydra import compose, initialize_config_dir

from scripts.real_recordings import CONF
from src.reconstruct import reconstruct
from src.recordings.files import sources

SECONDS, RATES = 0.0875, (120, 600, 12_000)


def measured(recording: Path, network: str, fps: int, span: str) -> tuple[float, float]:
    """Return contrast and flicker per frame of the last 1/120 s."""
    size = ["sensor_size=[180,240]"] if recording.suffix == ".txt" else []  # DAVIS240C
    given = [f"recording='{recording}'", *network.split(), *size, f"fps={fps}", f"span={span}"]
    with tempfile.TemporaryDirectory() as run:
        with initialize_config_dir(str(CONF), version_base=None):
            cfg = compose("reconstruct", [*given, f"end={SECONDS}", "output=hdf5"])
        cfg.paths.run = run
        reconstruct(cfg)
        film = np.stack(list(sources.film(Path(run) / "video.h5")))
    last = film[-max(2, fps // 120) :]
    contrast = float(last.std((1, 2)).mean())
    return contrast, float(np.abs(np.diff(last, axis=0)).mean()) / contrast


def main() -> None:
    """Read the arguments and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recording", type=Path)
    parser.add_argument("networks", nargs="+")
    given = parser.parse_args()
    print("| network | fps | contrast, 1/120 s | flicker | contrast, a frame | flicker |")
    print("|---" * 6 + "|")
    for network in given.networks:
        name = Path(network.split()[0].partition("=")[2]).stem
        for fps in RATES:
            trained = measured(given.recording, network, fps, "trained")
            frame = measured(given.recording, network, fps, "frame") if fps > 120 else trained
            cells = " | ".join(f"{value:.3f}" for value in (*trained, *frame))
            print(f"| {name} | {fps} | {cells} |", flush=True)


if __name__ == "__main__":
    main()
