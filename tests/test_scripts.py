"""From runs to shipped weights and figures."""

import shutil

import cv2
import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from scripts import (
    error_by_detail_size,
    gallery,
    pretrain_context,
    readme,
    ship_weights,
    turbulence_map,
    widen_setnet,
)
from scripts.error_by_detail_size import measure, missing
from scripts.fit_p2s import __main__ as fit_p2s
from scripts.ship_weights import CARD_NOTE, Given, rewrite_card, ship
from src.app import build
from src.metrics.table import METRICS
from src.models import files
from src.models.network import unroll
from src.models.setnet import SetNet
from src.recordings.files.event_writers import write_events
from src.recordings.files.recording import read_events
from src.records import results
from src.records.runs import Run
from src.train import train
from src.training import learning_curve
from tests.conftest import ROOT
from tests.test_train import TINY, config

ALONE = [*TINY, "reference_baseline=null"]


@pytest.fixture
def clean(monkeypatch):
    """A working tree without changes."""
    monkeypatch.setattr(results, "git_commit", lambda: "0123456789ab")


def test_a_trained_run_is_shipped_whole_with_its_card(tmp_path, monkeypatch, clean):
    run, weights = tmp_path / "run", tmp_path / "weights"
    two_steps = ["trainer.max_steps=2", "callbacks.learning_curve.interval_h=1"]
    train(config("train", run, *ALONE, *two_steps))
    monkeypatch.setattr(files, "WEIGHTS", weights)
    path = ship(run, "tiny/one", [run])
    shipped, trained = files.load("tiny/one"), files.load(files.newest_checkpoint(run))
    voxels = torch.randn(1, 2, 9, 5, 16, 16)
    assert torch.allclose(unroll(shipped, voxels)[0], unroll(trained, voxels)[0], atol=2e-3)
    card = path.with_suffix(".md").read_text()
    assert path.with_suffix(".png").is_file() and "![learning curve](one.png)" in card
    assert "| windows_seen | 4 |" in card and "| started_from | nothing |" in card
    assert (
        learning_curve.TRAINING_STATE not in card
        and learning_curve.read_training_progress(path)["steps"] == 2
    )
    train(config("train", tmp_path / "on", *ALONE, "trainer.max_steps=1", f"ckpt={path}"))
    assert (
        files.newest_checkpoint(tmp_path / "on")
        and torch.load(files.newest_checkpoint(tmp_path / "on"))["steps"] == 3
    )
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
    whole, by_hand = path.read_bytes(), "\n## A section\n\nWritten by hand.\n"
    path.with_suffix(".md").write_text(card + by_hand)
    assert rewrite_card("tiny/one", [run, run]) == path and path.read_bytes() == whole
    text = path.with_suffix(".md").read_text()
    anew = text.removesuffix(by_hand).splitlines()
    assert text.endswith(by_hand) and len(anew) == len(card.splitlines()) + 1
    assert set(anew) == set(card.splitlines())
    refuse_what_is_there(run, path, monkeypatch)
    (run / "curve.csv").unlink()
    ship(run, "tiny/one", [run], Given(replace=True))
    other = path.with_suffix(".md").read_text()
    assert by_hand not in other and "![learning curve]" not in other
    assert not path.with_suffix(".png").exists(), "the figure is of another network"
    assert sorted(file.name for file in path.parent.glob("one*")) == ["one.md", "one.safetensors"]


def refuse_what_is_there(run, path, monkeypatch):
    """Neither a name that is taken nor weights too large change what is there."""
    around = sorted(path.parent.iterdir())
    before = [file.read_bytes() for file in around]
    with pytest.raises(ValueError, match="--name must be a new one, got tiny/one, which .* has"):
        ship(run, "tiny/one", [])
    with monkeypatch.context() as patched:
        patched.setattr(ship_weights, "LARGEST", 1000)
        with pytest.raises(ValueError, match="weights must have at most 1000 bytes, got"):
            ship(run, "tiny/one", [], Given(replace=True))
    assert sorted(path.parent.iterdir()) == around
    assert [file.read_bytes() for file in around] == before


def test_weights_of_a_stage_are_shipped_with_the_card_of_a_run(tmp_path, monkeypatch, clean):
    run = tmp_path / "one"
    train(config("train", run, *ALONE, "trainer.max_steps=1"))
    first = ship(run, "one", [], Given(folder=tmp_path))
    doubled = files.load(first)
    for parameter in doubled.parameters():
        parameter.data *= 2
    other = tmp_path / "stage.safetensors"
    files.save(other, doubled, files.read_network_spec(first), {"mean_of": {"a": 0.5, "b": 0.5}})
    elsewhere = Given("mine, width=8", folder=tmp_path)
    text = ship(run, "own", [], elsewhere).with_suffix(".md").read_text()
    assert "| recipe | mine, width=8 |" in text, "no link to a file that is not there"
    path = ship(run, "mean", [], Given("lf3x3", other, tmp_path / "weights"))
    for name, value in files.load(path).state_dict().items():
        assert torch.allclose(value, doubled.state_dict()[name], atol=2e-3), name
    card = path.with_suffix(".md").read_text()
    recipe = "| recipe | [lf3x3](../conf/recipe/lf3x3.yaml) |"
    assert recipe in card and "| mean_of | {'a': 0.5, 'b': 0.5} |" in card
    monkeypatch.setattr(results, "git_commit", lambda: "abc-dirty")
    (run / "results.json").unlink()
    with pytest.raises(ValueError, match="weights are shipped from a commit, .* is of abc-dirty"):
        ship(run, "mean", [], Given(folder=tmp_path))


def test_a_mean_without_an_interval_is_written_alone():
    assert ship_weights._cell(METRICS[0], {"mean": 0.3, "interval": None}) == "0.300"
    assert ship_weights._cell(METRICS[0], {"mean": 0.3, "interval": [0.2, 0.4]}).endswith("0.400)")


def test_scores_take_the_place_of_older_ones_on_a_card(tmp_path):
    card = tmp_path / "one.md"
    card.write_text(f"| tested on |\n|---|\n\n{CARD_NOTE}\n")
    scored = {metric.name: 0.5 for metric in METRICS}
    readme.update_card(card, "data=test_photos", "abc", [scored])
    readme.update_card(card, "data=test_photos sensor=randomized", "abc", [scored])
    readme.update_card(card, "data=test_photos", "abc", [scored, scored])
    rows = card.read_text().splitlines()[2:]
    assert rows[0].startswith("| `data=test_photos`, by scripts.readme, at abc | 2 | 0.5")
    assert rows[1].startswith("| `data=test_photos sensor=randomized`") and "| 1 | 0.5" in rows[1]
    assert rows[2:] == ["", CARD_NOTE]


def test_intervals_of_a_table_are_over_photographs_and_scores_that_clips_have():
    values = [0.1, 0.2, 0.6, 0.7]
    clips = [{"source": source, **{metric.name: value for metric in METRICS}}
             for source, value in zip("aabb", values, strict=True)]  # fmt: skip
    clips.append({"source": "c", **clips[0], METRICS[0].name: None})
    first, second = readme.format_means(clips, METRICS[:2])
    assert first == "0.400 (0.150 to 0.650)" and second.startswith("0.340 (0.1")
    gains = [readme.subtract_scores(clip, clips[0]) for clip in clips]
    assert gains[-1][METRICS[0].name] is None and gains[1]["source"] == "a"
    assert readme.format_means(gains[:2], METRICS[:1], "+") == ["+0.050"]


def test_documents_have_the_rows_and_differences_of_their_tables():
    for table in (table for tables in readme.TABLES.values() for table in tables):
        name, text = table.section, (ROOT / table.document).read_text()
        section = text.partition(f"<!-- report:{name} -->")[2].partition(f"<!-- end:{name} -->")[0]
        rows = [line.split(" | ")[0].strip("| *") for line in section.splitlines() if " | " in line]
        assert rows[1:] == [*table.rows, *table.pairs], f"{table.document}, {name}"


def test_rows_of_published_networks_that_are_not_scored_again_stay():
    table = readme.Table("README.md", "results", (readme.PAPER, readme.FIRENET, readme.PIENET), {})
    scored = [{metric.name: 0.5 for metric in METRICS}]
    before = f"| {readme.PAPER} | 0.4 |\n| {readme.FIRENET} | 0.3 |\n"
    rows = readme.format_table({readme.PAPER: scored}, table, before).splitlines()[2:]
    assert rows[0].startswith(f"| {readme.PAPER} | 0.5")
    assert rows[1:3] == [f"| {readme.FIRENET} | 0.3 |", ""]
    assert rows[3].endswith(" Published networks: measured before.")
    rows = readme.format_table({readme.FIRENET: scored}, table, before).splitlines()[2:]
    assert rows[0].startswith(f"| {readme.FIRENET} | 0.5") and rows[1] == ""
    assert "before" not in rows[2]


def test_the_turbulence_map_shows_where_more_views_help(tmp_path):
    def run(name: str, half: float, spread: float, lpips: list[float]) -> Run:
        settings = {turbulence_map.ATMOSPHERE + ".tilt_correlation_half_length_px": [half, half]}
        settings[turbulence_map.ATMOSPHERE + ".tilt_and_blur_px.strong"] = [spread, spread]
        clips = [{"name": f"clip{k}", "lpips": str(value)} for k, value in enumerate(lpips)]
        record = {"experiment": name, "test": {"lpips": {"mean": sum(lpips) / len(lpips)}}}
        return Run(tmp_path / name, record | {"seed": 0}, settings, clips)

    found = [run("single256", 7, 1, [0.5, 0.6]), run("lf3x3", 7, 1, [0.4, 0.5])]
    found += [run("single256", 40, 1, [0.5, 0.6]), run("lf3x3", 40, 1, [0.6, 0.5])]
    found += [run(name, 7, 1, [0.4 + 0.1 / n]) for n, name in turbulence_map.SETNET.items()]
    cells = turbulence_map.group_runs(found)
    margins = turbulence_map.compute_differences(cells, "lf3x3", "single256", "lpips", 2)
    assert {place: text for place, (_, text) in margins.items()} == {
        (7, 1): "-0.10*",
        (40, 1): "+0.00",
    }
    assert turbulence_map.count_views_needed(cells) == {(7, 1): (9.0, "9")}
    with pytest.raises(ValueError, match=r"one run of lf3x3 for each setting, got .*lf3x3 and"):
        turbulence_map.group_runs([*found, run("lf3x3", 7, 1, [0.4, 0.5])])
    del cells[7, 1]["lf3x3"].clips[0]["lpips"]
    for clip in cells[40, 1]["lf3x3"].clips:
        del clip["lpips"]
    margins = turbulence_map.compute_differences(cells, "lf3x3", "single256", "lpips", 2)
    assert margins == {(7, 1): (pytest.approx(-0.1), "-0.10")}
    cells[7, 1]["lf3x3"].clips[0]["name"] = "another"
    with pytest.raises(ValueError, match="folders must hold the same clips, got 2 sets"):
        turbulence_map.compute_differences(cells, "lf3x3", "single256", "lpips", 2)


def test_maps_of_one_metric_have_one_scale_and_better_is_purple(tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(turbulence_map, "save_figure", lambda figure, _: drawn.append(figure))
    cells = [{(7, 1): (value, "")} for value in (-0.02, 0.2, -0.04, 3.0)]
    metrics = ("lpips", "psnr_aligned", "lpips", "")
    panels = [turbulence_map.Panel("a", *each) for each in zip(cells, metrics, strict=True)]
    turbulence_map.draw_maps(tmp_path / "map.png", panels)
    pictures = [axes.images[0] for axes in drawn[0].axes]
    assert pictures[0].get_clim() == pictures[2].get_clim() == pytest.approx((-0.072, 0.072))
    shades = [np.array(picture.to_rgba(picture.get_array())[0, 0]) for picture in pictures]
    assert all(blue > red > green for red, green, blue, _ in shades[:3])
    assert np.ptp(shades[3][:3]) < 0.01 and "purple: nine views" in turbulence_map.KEY


def test_a_difference_that_rounds_to_zero_has_no_minus(tmp_path):
    def run(name: str, psnr: float) -> Run:
        settings = {turbulence_map.ATMOSPHERE + ".tilt_correlation_half_length_px": [7, 7]}
        settings[turbulence_map.ATMOSPHERE + ".tilt_and_blur_px.strong"] = [1, 1]
        record = {"experiment": name, "seed": 0}
        return Run(tmp_path / name, record, settings, [{"name": "clip0", "psnr": str(psnr)}])

    cells = turbulence_map.group_runs([run("lf3x3", 20.0), run("single256", 20.001)])
    found = turbulence_map.compute_differences(cells, "lf3x3", "single256", "psnr", 2)
    assert found[7, 1][1].startswith("+0.00")


def test_what_lies_around_is_taught_while_the_memory_rests(tmp_path):
    start, export = tmp_path / "start.safetensors", tmp_path / "taught.safetensors"
    given = "experiment=setnet_small", f"ckpt={start}", f"export={export}"
    cfg = config("train", tmp_path, *TINY, *given)
    network, spec = build.build_untrained_network(cfg)
    files.save(start, network, spec, {"hours": 1.0, "curve": []})
    pretrain_context.teach(cfg, clips=3, steps=2)
    before, taught = files.load(start).state_dict(), files.load(export).state_dict()
    rested = [torch.equal(before[n], taught[n]) for n in before if n.startswith("memory")]
    assert all(rested) and not torch.equal(
        before["decoder_conv.weight"], taught["decoder_conv.weight"]
    )
    assert float(taught["context.ups.0.weight"].abs().max()) > 0
    card = files.read_card(files.find_checkpoint(export, spec))
    assert card["hours"] > 1 and card["curve"] == []
    for name in ("ckpt", "export"):
        with pytest.raises(ValueError, match="ckpt and export must be files"):
            pretrain_context.teach(config("train", tmp_path, *TINY, *given, f"{name}=null"), 3, 2)


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
    old = talkative(channels=6, context_channels=[8, 10], refine_fusion=before, gate_rank=rank)
    wide = talkative(channels=15, context_channels=[16, 10], refine_fusion=after, gate_rank=rank)
    if after and not before:  # blocks that are new are silent
        fresh = SetNet(3, 15, [16, 10], refine_fusion=True)
        wide.context.fusion_blocks = fresh.context.fusion_blocks
    widen_setnet.widen(wide, old)
    voxels = torch.randn(2, 5, 4, 3, 32, 24)
    expected, drawn = (unroll(network.eval(), voxels)[0] for network in (old, wide))
    assert float(expected.std()) > 0.01 and torch.allclose(drawn, expected, atol=1e-5)
    with torch.enable_grad():
        unroll(wide, voxels)[0].square().mean().backward()
    same = wide.decoder_conv.bias == wide.decoder_conv.bias[0]
    steps = wide.decoder_conv.weight.grad.flatten(1)[same]  # of the copies of a channel
    assert len(steps) > 1
    assert float(torch.pdist(steps).min()) > 0.1 * float(steps.norm(dim=1).max())
    less = [{"channels": 4, "context_channels": [8, 10]}, {"channels": 6, "context_channels": [8]}]
    less += [{"channels": 6, "context_channels": [8, 10], "refine_fusion": before, "gate_rank": 4}]
    for narrow in less + ([{"channels": 6, "context_channels": [8, 10]}] if before else []):
        with pytest.raises(ValueError, match="a SetNet .* widened, not"):
            widen_setnet.widen(talkative(**narrow), old)


def test_a_size_begins_as_a_smaller_one_with_its_hours(tmp_path):
    start, export = tmp_path / "start.safetensors", tmp_path / "wide.safetensors"
    small, spec = build.build_untrained_network(
        config("train", tmp_path, *TINY, "experiment=setnet_small")
    )
    files.save(start, small, spec, {"hours": 1.0, "curve": []})
    given = "experiment=setnet_medium", f"ckpt={start}", f"export={export}"
    widen_setnet.begin(config("train", tmp_path, *TINY, *given))
    begun = files.load(export)
    assert files.read_card(export)["hours"] == 1 and begun.channels == 40
    assert begun.memory.input_features.weight.shape == (
        32,
        40,
        3,
        3,
    )  # a memory of the rank asked for
    for wrong in ("ckpt=null", "experiment=lf3x3"):
        with pytest.raises(ValueError, match="ckpt and ex"):
            widen_setnet.begin(config("train", tmp_path, *TINY, *given, wrong))
    shipped = "experiment=setnet_medium", "ckpt=setnet_small", f"export={export}"
    widen_setnet.begin(config("train", tmp_path, *TINY, *shipped))
    assert files.read_card(export)["hours"] == pytest.approx(14.99, abs=0.01)  # of its card


def test_areas_are_learned_from_what_is_held():
    torch.manual_seed(0)
    network = SetNet(bins=3, channels=4, context_channels=(8, 8))
    truth = torch.rand(64, 1, 1, 1).expand(-1, 1, 16, 16)
    maps = torch.randn(64, 4, 8, 8) * 0.1
    maps[:, :, :2, :2] += truth[..., :2, :2]  # told in a corner, wanted everywhere
    errors = pretrain_context.learn(network, maps.half(), truth.half(), 300)
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


def test_a_network_gets_the_views_that_it_wants_and_photographs_are_named(tmp_path, monkeypatch):
    monkeypatch.setattr(error_by_detail_size, "CLIPS", 1)
    small = ["data.test_windows=12", "data.test_crop=176", "turbulence=none"]
    cfg = config("train", tmp_path, *small)
    assert float(measure(cfg, ["single256"])["single256"].min()) > 0
    with pytest.raises(ValueError, match="CKPT must be a network for events, mambatm is none"):
        measure(cfg, ["mambatm"])
    cfg.scene.root = "/nowhere"
    with pytest.raises(ValueError, match="^--root must be .*/nowhere"):
        measure(cfg, ["single256"])


def test_the_table_of_psfs_is_written_whole_and_once(tmp_path, monkeypatch):
    def measure_error_tables(bands):
        assert len(bands) == len(fit_p2s.PLANS) and not out.exists()
        return {"errors.power": torch.zeros(2)}

    out, shipped = tmp_path / "new.safetensors", fit_p2s.FILE.read_bytes()
    monkeypatch.setattr(fit_p2s, "measure_error_tables", measure_error_tables)
    monkeypatch.setattr("sys.argv", ["fit_p2s", "0", "--out", str(out)])
    fit_p2s.main()
    written, before = load_file(out), load_file(fit_p2s.FILE)
    assert [name for name in written if name.startswith("errors.")] == ["errors.power"]
    assert all(torch.equal(written[n], t) for n, t in before.items() if n[:7] != "errors.")
    assert fit_p2s.FILE.read_bytes() == shipped and list(tmp_path.iterdir()) == [out]


def test_a_camera_frame_is_found_in_a_list_with_comments_and_names_with_spaces(tmp_path):
    for grey, name in ((50, "a.png"), (200, "the second one.png")):
        cv2.imwrite(str(tmp_path / name), np.full((8, 8), grey, np.uint8))
    listing = tmp_path / "images.txt"
    listing.write_text("# seconds file\n\n0.1 a.png\n0.2 the second one.png\n")
    recording = f"{tmp_path}/events.txt@8x8"
    assert [255 * gallery.camera(recording, at).mean() for at in (0, 1)] == pytest.approx([50, 200])
    listing.write_text("# seconds file\n")
    assert gallery.camera(recording, 0) is None
    listing.write_text("a.png\n")
    with pytest.raises(ValueError, match="must have seconds and a file in each line"):
        gallery.camera(recording, 0)


def test_a_gallery_has_a_row_for_each_recording_and_a_column_for_each_network(tmp_path):
    recording = str(tmp_path / "cat.raw")
    events = read_events(ROOT / "docs" / "example" / "cat.raw")
    write_events(tmp_path / "cat.raw", events[:10_000], width=512, height=384)
    figure = gallery.gallery([recording, recording], ["setnet_small", "highpass"], None)
    assert [panel.get_title() for panel in figure.axes] == ["setnet_small", "highpass", "", ""]
    assert [panel.get_ylabel() for panel in figure.axes] == ["cat", "", "cat", ""]
    assert all(panel.images for panel in figure.axes)
