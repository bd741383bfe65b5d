"""From runs to shipped weights and figures."""

import shutil

import pytest
import torch

from scripts import air_map as air
from scripts import alignment, gallery, narrow_memory, readme, surroundings, widen_setnet
from scripts.scales import missing
from scripts.ship_weights import recard, ship
from src.app import build
from src.figures import air_map
from src.metrics.table import METRICS
from src.models import files
from src.models.setnet import SetNet
from src.models.unroll import unroll
from src.records.runs import Run
from src.train import train
from src.training import handover
from tests.conftest import ROOT
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
    assert handover.REACHED not in card and handover.reached(path)["steps"] == 2
    train(config("train", tmp_path / "on", *TINY, "trainer.max_steps=1", f"ckpt={path}"))
    assert files.newest(tmp_path / "on") and torch.load(files.newest(tmp_path / "on"))["steps"] == 3
    assert "`ckpt=tiny/one`" in card and "| steps | 2 |" in card and "9 view(s)" in card
    first, last = tmp_path / "parts/part000", tmp_path / "parts/part001"
    shutil.copytree(run, last)
    first.mkdir()
    config_of = (run / "config.yaml").read_text()
    (first / "config.yaml").write_text(config_of.replace("ckpt: null", "ckpt: a/one.safetensors"))
    parts = ship(tmp_path / "parts", "tiny/parts", []).with_suffix(".md").read_text()
    assert "| started_from | one.safetensors |" in parts
    later = tmp_path / "later"
    shutil.copytree(run, later)
    (later / "config.yaml").write_text(config_of.replace("ckpt: null", f"ckpt: {first}"))
    gone_on = ship(later, "tiny/later", []).with_suffix(".md").read_text()
    assert "| started_from | one.safetensors |" in gone_on
    whole = path.read_bytes()
    assert recard("tiny/one", [run, run]) == path and path.read_bytes() == whole
    anew = path.with_suffix(".md").read_text().splitlines()
    assert len(anew) == len(card.splitlines()) + 1 and set(anew) == set(card.splitlines())


def test_the_mean_of_a_run_and_other_weights_is_shipped(tmp_path, monkeypatch):
    monkeypatch.setattr(files, "WEIGHTS", tmp_path / "weights")
    runs, shipped = [tmp_path / "one", tmp_path / "two"], []
    for seed, run in enumerate(runs):
        step = ["trainer.max_steps=1", "callbacks.curve.every_h=1", f"seed={seed}"]
        train(config("train", run, *TINY, *step))
        shipped.append(files.load(ship(run, run.name, [])).state_dict())
    path = ship(runs[0], "mean", [], files.WEIGHTS / "two.safetensors")
    for name, value in files.load(path).state_dict().items():
        expected = (shipped[0][name] + shipped[1][name]) / 2
        assert torch.allclose(value, expected, atol=2e-3), name
    assert "| mean_with | two.safetensors, 0.0 hours |" in path.with_suffix(".md").read_text()
    with pytest.raises(ValueError, match="--mean must be weights of the same network, got .*small"):
        ship(runs[0], "mean", [], ROOT / "weights/setnet_small.safetensors")


def test_scores_take_the_place_of_older_ones_on_a_card(tmp_path):
    card = tmp_path / "one.md"
    card.write_text("| tested on |\n|---|\n\nIn brackets: the interval.\n")
    scored = {metric.name: 0.5 for metric in METRICS}
    readme.on_card(card, "data=test_photos", "abc", [scored])
    readme.on_card(card, "data=test_photos sensor=drawn", "abc", [scored])
    readme.on_card(card, "data=test_photos", "abc", [scored, scored])
    rows = card.read_text().splitlines()[2:]
    assert rows[0].startswith("| `data=test_photos`, by scripts.readme, at abc | 2 | 0.5")
    assert rows[1].startswith("| `data=test_photos sensor=drawn`") and "| 1 | 0.5" in rows[1]
    assert rows[2:] == ["", "In brackets: the interval."]


def test_a_map_of_air_says_where_views_pay(tmp_path):
    def run(name: str, half: float, spread: float, lpips: list[float]) -> Run:
        settings = {air.AIR + ".half_length_px": [half, half]}
        settings[air.AIR + ".spread_px.strong"] = [spread, spread]
        clips = [{"lpips": str(value)} for value in lpips]
        record = {"experiment": name, "test": {"lpips": {"mean": sum(lpips) / len(lpips)}}}
        return Run(tmp_path, record, settings, clips)

    found = [run("single256", 7, 1, [0.5, 0.6]), run("lf3x3", 7, 1, [0.4, 0.5])]
    found += [run("single256", 40, 1, [0.5, 0.6]), run("lf3x3", 40, 1, [0.6, 0.5])]
    found += [run(name, 7, 1, [0.4 + 0.1 / n]) for n, name in air.SETNET.items()]
    cells = air.places(found)
    margins = air.margin(cells, "lf3x3", "single256", "lpips", 2)
    assert {place: text for place, (_, text) in margins.items()} == {
        (7, 1): "-0.10*",
        (40, 1): "+0.00",
    }
    assert air.enough(cells) == {(7, 1): (9.0, "9")}
    assert air_map.draw(tmp_path / "map.png", {"a": margins, "b": air.enough(cells)}).is_file()


def test_views_brought_back_by_their_own_tilt_are_the_picture_again():
    y, x = torch.meshgrid(torch.arange(48.0), torch.arange(48.0), indexing="ij")

    def seen(dx: float) -> torch.Tensor:
        return 0.5 * torch.sin((x - dx) / 3) * torch.cos(y / 4)

    shifts = torch.linspace(-3, 3, 9)
    events = torch.stack(
        [torch.stack([seen(dx) for dx in shifts.tolist()]), torch.zeros(9, 48, 48)]
    )
    tilt = torch.zeros(9, 2, 2, 48, 48)
    tilt[:, :, 0] = shifts[:, None, None, None]
    truth = 0.5 + alignment.GAIN * seen(0.0)

    def error(name: str, moved: torch.Tensor) -> float:
        film = alignment.drawn(events, moved, keep=1.0, centre=4)[name][-1, 0]
        return float((film - truth)[:, 6:-6].abs().mean())

    assert error("nine, local", tilt) < error("nine as they are", tilt) / 5
    assert error("one view", tilt) < 1e-6
    assert abs(error("nine, whole", tilt) - error("nine, local", tilt)) < 1e-3
    torn = tilt.clone()
    torn[..., 24:, :] *= -1  # whole views do not move
    assert abs(error("nine, whole", torn) - error("nine as they are", torn)) < 1e-3


def test_what_lies_around_is_taught_while_the_memory_rests(tmp_path):
    start, export = tmp_path / "start.safetensors", tmp_path / "taught.safetensors"
    given = "experiment=setnet_small", f"ckpt={start}", f"export={export}"
    cfg = config("train", tmp_path, *TINY, *given)
    network, spec = build.network(cfg)
    files.save(start, network, spec, {"hours": 1.0, "curve": []})
    surroundings.teach(cfg, clips=3, steps=2)
    before, taught = files.load(start).state_dict(), files.load(export).state_dict()
    rested = [torch.equal(before[n], taught[n]) for n in before if n.startswith("cell2")]
    assert all(rested) and not torch.equal(before["mix2.weight"], taught["mix2.weight"])
    assert float(taught["around.ups.0.weight"].abs().max()) > 0
    card = files.card(files.require(export, spec))
    assert card["hours"] > 1 and card["curve"] == []
    for name in ("ckpt", "export"):
        with pytest.raises(ValueError, match="ckpt and export must be files"):
            surroundings.teach(config("train", tmp_path, *TINY, *given, f"{name}=null"), 3, 2)


def talkative(**sizes) -> SetNet:
    """A SetNet none of whose layers is silent."""
    network = SetNet(bins=3, **sizes)
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, std=0.2)
    return network


@torch.no_grad()
@pytest.mark.parametrize("rank", [None, 5])
@pytest.mark.parametrize(("before", "after"), [(False, False), (False, True), (True, True)])
def test_a_widened_network_draws_what_it_was_begun_as_and_its_copies_part(before, after, rank):
    torch.manual_seed(0)
    old = talkative(half=6, around=[8, 10], refined=before, rank=rank)
    wide = talkative(half=15, around=[16, 10], refined=after, rank=rank)
    if after and not before:  # blocks that are new are silent
        wide.around.joined = SetNet(bins=3, half=15, around=[16, 10], refined=True).around.joined
    widen_setnet.widen(wide, old)
    voxels = torch.randn(2, 5, 4, 3, 32, 24)
    expected, drawn = (unroll(network.eval(), voxels)[0] for network in (old, wide))
    assert float(expected.std()) > 0.01 and torch.allclose(drawn, expected, atol=1e-5)
    with torch.enable_grad():
        unroll(wide, voxels)[0].square().mean().backward()
    same = wide.mix2.bias == wide.mix2.bias[0]
    steps = wide.mix2.weight.grad.flatten(1)[same]  # of the copies of a channel
    assert len(steps) > 1
    assert float(torch.pdist(steps).min()) > 0.1 * float(steps.norm(dim=1).max())
    less = [{"half": 4, "around": [8, 10]}, {"half": 6, "around": [8]}]
    less += [{"half": 6, "around": [8, 10], "refined": before, "rank": 4}]
    for narrow in less + ([{"half": 6, "around": [8, 10]}] if before else []):
        with pytest.raises(ValueError, match="a SetNet .* widened, not"):
            widen_setnet.widen(talkative(**narrow), old)


@torch.no_grad()
def test_a_memory_of_a_rank_draws_what_that_in_full_does_the_more_the_higher_it_is():
    torch.manual_seed(0)
    old, told = talkative(half=6, around=[8, 10]).eval(), []
    hook = old.cell2.seen.register_forward_hook(lambda _, __, maps: told.append(maps))
    voxels = 0.2 * torch.randn(2, 5, 4, 3, 32, 24)
    expected = unroll(old, voxels)[0]
    hook.remove()
    told = torch.cat(told).movedim(1, -1).flatten(0, -2)

    def error(rank: int) -> float:
        narrowed = narrow_memory.narrow(old, rank, told).eval()
        assert narrowed.arguments == old.arguments | {"rank": rank}
        return float((unroll(narrowed, voxels)[0] - expected).abs().mean())

    errors = [error(rank) for rank in (2, 8, 12)]
    assert errors[2] < 1e-5 < errors[1] < errors[0] / 2
    with pytest.raises(ValueError, match="rank must be <= 12 for this network, got 13"):
        narrow_memory.narrow(old, 13, told)


def test_a_size_begins_as_a_smaller_one_with_its_hours(tmp_path):
    start, export = tmp_path / "start.safetensors", tmp_path / "wide.safetensors"
    small, spec = build.network(config("train", tmp_path, *TINY, "experiment=setnet_small"))
    files.save(start, small, spec, {"hours": 1.0, "curve": []})
    given = "experiment=setnet_medium", f"ckpt={start}", f"export={export}"
    widen_setnet.begin(config("train", tmp_path, *TINY, *given))
    begun = files.load(export)
    assert files.card(export)["hours"] == 1 and begun.half == 40
    assert begun.cell2.mixed.weight.shape == (32, 40, 3, 3)  # a memory of the rank asked for
    for wrong in ("ckpt=null", "experiment=lf3x3"):
        with pytest.raises(ValueError, match="ckpt and ex"):
            widen_setnet.begin(config("train", tmp_path, *TINY, *given, wrong))


def test_areas_are_learned_from_what_is_held():
    torch.manual_seed(0)
    network = SetNet(bins=3, half=4, around=(8, 8))
    truth = torch.rand(64, 1, 1, 1).expand(-1, 1, 16, 16)
    maps = torch.randn(64, 4, 8, 8) * 0.1
    maps[:, :, :2, :2] += truth[..., :2, :2]  # told in a corner, wanted everywhere
    errors = surroundings.learn(network, maps.half(), truth.half(), 300)
    assert sum(errors[-20:]) < 0.6 * sum(errors[:20])


def test_what_is_missing_is_told_by_its_size():
    torch.manual_seed(0)
    truth = torch.rand(2, 1, 176, 176)
    assert float(missing(0.2 + 0.5 * truth, truth).max()) < 1e-6  # gain and offset do not count
    checkers = (torch.arange(176)[:, None] + torch.arange(176)) % 2 - 0.5
    fine, *coarser = missing(truth + 0.1 * checkers, truth)
    assert fine > 0.02 and max(coarser) < 1e-3
    grey = torch.nn.functional.avg_pool2d(truth, 16)
    *details, areas, _ = missing(
        truth - grey.repeat_interleave(16, 2).repeat_interleave(16, 3), truth
    )
    assert areas > 0.5 and max(details) < 0.05


def test_a_gallery_has_a_row_for_each_recording_and_a_column_for_each_network():
    recording = str(ROOT / "docs" / "example" / "cat.raw")
    figure = gallery.gallery([recording, recording], ["setnet_small", "highpass"], None)
    assert [panel.get_title() for panel in figure.axes] == ["setnet_small", "highpass", "", ""]
    assert [panel.get_ylabel() for panel in figure.axes] == ["cat", "", "cat", ""]
    assert all(panel.images for panel in figure.axes)
