"""From runs to shipped weights."""

import torch

from scripts.ship_weights import recard, ship
from src.models import files
from src.models.unroll import unroll
from src.train import train
from tests.test_train import TINY, config


def test_a_trained_run_is_shipped_whole_with_its_card(tmp_path, monkeypatch):
    run, weights = tmp_path / "run", tmp_path / "weights"
    train(config("train", run, *TINY, "trainer.max_steps=2", "callbacks.curve.every_h=1"))
    monkeypatch.setattr(files, "WEIGHTS", weights)
    path = ship(run, "tiny/one", [run])
    shipped, trained = files.load("tiny/one"), files.load(files.newest(run))
    voxels = torch.randn(1, 2, 9, 5, 16, 16)
    assert torch.allclose(unroll(shipped, voxels)[0], unroll(trained, voxels)[0], atol=2e-3)
    card = path.with_suffix(".md").read_text()
    assert path.with_suffix(".png").is_file() and "![learning curve](one.png)" in card
    assert "| windows_seen | 4 |" in card and "| started_from | nothing |" in card
    assert "`ckpt=tiny/one`" in card and "| steps | 2 |" in card and "9 view(s)" in card
    whole = path.read_bytes()
    assert recard("tiny/one", [run, run]) == path and path.read_bytes() == whole
    anew = path.with_suffix(".md").read_text().splitlines()
    assert len(anew) == len(card.splitlines()) + 1 and set(anew) == set(card.splitlines())
