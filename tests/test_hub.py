"""The shipped networks through torch.hub, from another folder and process, without Lightning."""

import subprocess
import sys

import torch

from src.models import files
from tests.conftest import ROOT

CODE = """
import sys, torch
class NoLightning:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("lightning", "hydra", "kornia", "wandb"):
            raise ImportError(name)
sys.meta_path.insert(0, NoLightning())
frames = []
for name in sys.argv[2:]:
    net = torch.hub.load(sys.argv[1], name, source="local")
    torch.manual_seed(0)
    with torch.no_grad():
        frames.append(net(torch.randn(1, net.views or 9, 5, 16, 16), None)[0])
torch.save(frames, "out.pt")
"""
NAMES = ("setnet_small", "setnet_medium", "setnet_large", "lf3x3", "single256")


def test_the_shipped_networks_are_loaded_from_anywhere(tmp_path):
    run = [sys.executable, "-W", "ignore", "-c", CODE, str(ROOT), *NAMES]
    subprocess.run(run, cwd=tmp_path, check=True, capture_output=True, timeout=600)
    found = torch.load(tmp_path / "out.pt", weights_only=True)
    for name, frame in zip(NAMES, found, strict=True):
        network = files.load(name)
        torch.manual_seed(0)
        with torch.no_grad():
            shown, _ = network(torch.randn(1, network.views or 9, 5, 16, 16), None)
        assert torch.equal(frame, shown), name
