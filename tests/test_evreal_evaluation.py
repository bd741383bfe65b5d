"""src.eval data=evreal: sequences of data sets, scores beside the published."""

import csv
import json
import math
import shutil

import cv2
import numpy as np
import pytest
from omegaconf import OmegaConf

from src.app.evreal_evaluation import (
    MSE,
    average_by_data_set,
    average_frames,
    describe_other_protocol,
    find_protocol_changes,
)
from src.convert import convert
from src.eval import evaluate
from src.records.results import summarize_scores
from src.report import report
from tests.conftest import ROOT
from tests.recordings.files.frames import LAYOUTS, make_events, make_frames, write_recording
from tests.test_recording_entry_points import config

HIGHPASS = ["data=evreal", "baseline=highpass"]
FIRENET_PLUS = "FireNet+/firenet_plus_state_dict.pth"
# EVREAL@398f035's own eval.py with FireNet+ on slider_depth's excerpt, written by src.convert; its
# LPIPS, pyiqa's, by the network of this project on the pictures that it is given.
EVENTS = ["data.window=events", "data.events_per_window=4000", "data.tolerance_ms=5"]
SECONDS = ["data.window=seconds", "data.window_s=0.009", "data.tolerance_ms=3"]
SLOW = {  # also covered without data, in tests/recordings/test_evreal_protocol.py
    "histogram=global": (0.130578, 0.200622, 0.606061, 5),
    "histogram=local": (0.123614, 0.200491, 0.617202, 5),
    "histogram=clahe": (0.076868, 0.296042, 0.545332, 5),
    "output_normalisation=robust": (0.165159, 0.312643, 0.550652, 5),
    "output_normalisation=standard": (0.11944, 0.356603, 0.521829, 5),
    "output_normalisation=exprobust": (0.138483, 0.324535, 0.548977, 5),
}
GOLDEN = [
    ([], (0.06734, 0.377581, 0.512944, 5)),
    (EVENTS, (0.063229, 0.389298, 0.411310, 4)),
    (SECONDS, (0.065741, 0.395577, 0.403159, 3)),
    (["data.start_s=0.03", "data.end_s=0.12"], (0.069693, 0.373829, 0.433613, 3)),
    *(pytest.param([f"data.{option}"], scores, marks=pytest.mark.slow)
      for option, scores in SLOW.items()),
]  # fmt: skip


@pytest.fixture
def run(tmp_path):
    """Return a call of src.eval with overrides, on the sequences of tmp_path/data."""

    def run(*overrides: str) -> dict:
        given = [*HIGHPASS, f"scene.root={tmp_path}/data", *overrides]
        return evaluate(config("eval", tmp_path / "run", *given))

    return run


@pytest.fixture(scope="module")
def excerpt(shared_data, tmp_path_factory):
    """Return slider_depth's excerpt in EVREAL's layout."""
    folder = tmp_path_factory.mktemp("excerpt")
    source = shared_data / "events/slider_depth/events_chunk.txt"
    given = [f"recording={source}", "layout=evreal", f"out={folder}/data/excerpt"]
    given.append("sensor_size=[180,240]")
    with pytest.warns(UserWarning, match="81 of 87 frames come after the last event"):
        convert(config("convert", folder / "run", *given))
    return folder / "data"


@pytest.mark.parametrize(("options", "expected"), GOLDEN)
def test_scores_are_those_of_evreals_own_code(shared_data, excerpt, run, options, expected):
    weights = f"baseline.weights={shared_data}/weights/{FIRENET_PLUS}"
    method = ["baseline=firenet_plus", weights, f"scene.root={excerpt}"]
    found = run(*method, *options)["benchmarks"]["data"]
    assert found["frames"] == expected[-1]
    for name, value in zip(("mse", "ssim", "lpips"), expected, strict=False):
        assert found[name] == pytest.approx(value, abs=2e-4), name


def test_firenet_normalises_its_grids_as_evreal_does(shared_data, excerpt, run):
    weights = f"baseline.weights={shared_data}/weights/FireNet/firenet_state_dict.pth"
    method = ["baseline=firenet", weights, f"scene.root={excerpt}"]
    found = run(*method)["benchmarks"]["data"]
    expected = {"mse": 0.149344, "ssim": 0.393214, "lpips": 0.537985}
    assert {name: found[name] for name in expected} == pytest.approx(expected, abs=2e-4)


@pytest.mark.filterwarnings("ignore:.*frames come after the last event")
def test_every_layout_has_the_same_scores(tmp_path, run):
    for layout in LAYOUTS:
        events, frames = make_events(), make_frames()
        write_recording(tmp_path / "data/own" / layout, layout, events, frames)
    record = run("data.save_frames=true", "metrics.lpips=null")
    with (tmp_path / "run/clips.csv").open() as file:
        clips = list(csv.DictReader(file))
    assert len(clips) == len(LAYOUTS) and {clip["frames"] for clip in clips} == {"4"}
    for clip in clips:
        assert float(clip["mse"]) == pytest.approx(float(clips[0]["mse"]), abs=2e-5), clip["name"]
        assert float(clip["ssim"]) == pytest.approx(float(clips[0]["ssim"]), abs=2e-4)
    with (tmp_path / "run/frames.csv").open() as file:
        lines = [line for line in csv.DictReader(file) if line["sequence"] == clips[0]["name"]]
    assert [line["frame"] for line in lines] == ["0", "1", "2", "3"]
    assert np.mean([float(line["mse"]) for line in lines]) == pytest.approx(float(clips[0]["mse"]))
    picture = cv2.imread(f"{tmp_path}/run/frames/{clips[0]['name']}/frame_0000000001.png", 0)
    truth = make_frames()[1] / 255
    assert np.mean((picture / 255 - truth) ** 2) == pytest.approx(float(lines[1]["mse"]), abs=1e-3)
    kept = json.loads((tmp_path / "run/results.json").read_text())
    assert kept["benchmarks"] == record["benchmarks"]
    assert list((tmp_path / "run").glob(".sequence*")) == []


def test_a_known_sequence_has_its_range_and_its_peers(tmp_path, run, capsys):
    for name in ("ECD/shapes_6dof", "ECD/mine"):
        write_recording(tmp_path / "data" / name, "evreal", make_events(), make_frames())
    times = np.load(tmp_path / "data/ECD/shapes_6dof/images_ts.npy")
    np.save(tmp_path / "data/ECD/shapes_6dof/images_ts.npy", times + 4.95)  # scored from 5 s on
    events = np.load(tmp_path / "data/ECD/shapes_6dof/events_ts.npy")
    np.save(tmp_path / "data/ECD/shapes_6dof/events_ts.npy", events + 4.95)
    found = run("metrics.lpips=null")["benchmarks"]
    assert {name: (row["sequences"], row["frames"]) for name, row in found.items()} == {
        "other": (1, 4), "ECD": (1, 2),
    }  # fmt: skip
    said = capsys.readouterr().out
    assert "published scores left out" not in said
    assert "ECD: 1 of 7 sequences, 2 frames" in said and "other: 1 sequences, 4 frames" in said
    (line,) = [line for line in said.splitlines() if "PIE-Net " in line and "0.196" in line]
    assert [cell.strip() for cell in line.split("│")[2:6]] == ["0.026", "0.612", "0.196", "PIE-Net"]


def test_no_published_scores_beside_a_run_outside_their_protocol(tmp_path, run, capsys):
    write_recording(tmp_path / "data/ECD/shapes_6dof", "evreal", make_events(), make_frames())
    run("metrics.lpips=null", "data.start_s=0", "data.end_s=10")
    said = capsys.readouterr().out
    assert "PIE-Net" not in said
    assert "published scores left out: not by their protocol (data.start_s, data.end_s)" in said


def test_the_mean_of_a_data_set_is_over_its_frames():
    given = [("A", 1, 0.1), ("B", 5, 0.4), ("A", 3, 0.5)]
    clips = [{"data_set": s, "frames": n, "left_out": n, "mse": mse} for s, n, mse in given]
    found = average_by_data_set(clips)
    assert found["A"] == {"sequences": 2, "frames": 4, "left_out": 4, "mse": pytest.approx(0.4)}
    assert found["B"] == {"sequences": 1, "frames": 5, "left_out": 5, "mse": pytest.approx(0.4)}


def test_a_frame_without_finite_scores_is_no_part_of_the_mean_nor_of_its_weight():
    lines = [{"mse": mse, "ssim": 0.5} for mse in (0.1, math.nan, 0.3)]
    expected = {"frames": 2, "left_out": 1, "mse": pytest.approx(0.2), "ssim": 0.5}
    assert average_frames(lines) == expected
    none = average_frames([{"mse": math.nan, "ssim": 0.5}] * 2)
    assert (none["frames"], none["left_out"]) == (2, 0) and math.isnan(none["ssim"])


def test_frames_left_out_are_said(tmp_path, run, capsys):
    write_recording(tmp_path / "data/own", "evreal", make_events(), make_frames())
    found = run("data.output_normalisation=robust", "metrics.lpips=null")["benchmarks"]["data"]
    assert (found["frames"], found["left_out"]) == (3, 1)
    assert math.isfinite(found["mse"])
    said = " ".join(capsys.readouterr().out.split())  # the title of a table is folded
    assert said.count("3 frames (1 without finite scores left out)") == 2


@pytest.mark.parametrize(
    ("change", "left_out"),
    [
        ({"start_s": 5.0}, "data.start_s"),
        ({"window": "events", "histogram": "local"}, "data.window, data.histogram"),
        ({"max_grid_s": 0.00834}, "data.max_grid_s"),
        ({"sequences": {"ECD": {"slider_depth": [0.0, 1.0]}}}, "data.sequences.ECD"),
        ({"sequences": {"MVSEC": {"indoor_flying1_data": [0.0, 1.0]}}}, ""),
        ({"save_frames": True, "tolerance_ms": 5.0}, ""),
    ],
)
def test_published_scores_stand_beside_runs_of_their_protocol_only(change, left_out):
    protocol = OmegaConf.load(ROOT / "conf/data/evreal.yaml").data
    data = OmegaConf.merge(protocol, change)
    said = f"published scores left out: not by their protocol ({left_out})" if left_out else ""
    assert describe_other_protocol(data, ["ECD"]) == said
    assert bool(find_protocol_changes(data, "ECD")) == bool(left_out)
    assert describe_other_protocol(data, ["mine"]) == ""


def test_a_report_takes_it(tmp_path, run):
    write_recording(tmp_path / "data/own", "evreal", make_events(), make_frames())
    scores = run()["test"]
    report(config("report", tmp_path / "report", f"run=[{tmp_path}/run]"))
    (page,) = (tmp_path / "report").glob("*.md")
    (row,) = [line for line in page.read_text().splitlines() if line.startswith("| eval |")]
    cells = [cell.strip(" *") for cell in row.split("|")]
    for name in ("lpips", "ssim", "mse"):
        assert f"{scores[name]['mean']:.3f}" in cells, name


def test_sequences_count_by_their_frames_in_every_table():
    clips = [{"data_set": "A", "frames": 1, "left_out": 0, "mse": 0.1, "ssim": 0.2},
             {"data_set": "A", "frames": 3, "left_out": 0, "mse": 0.5, "ssim": 0.6}]  # fmt: skip
    found = summarize_scores(clips, (MSE,))
    assert found["mse"]["mean"] == pytest.approx(average_by_data_set(clips)["A"]["mse"])
    assert found["ssim"]["mean"] == pytest.approx(0.5)
    low, high = found["ssim"]["interval"]
    assert low == pytest.approx(0.2) and high == pytest.approx(0.6)
    assert found["ssim"]["std"] == pytest.approx(np.std([0.2, 0.6, 0.6, 0.6]))


def test_the_deviation_of_simulated_clips_is_that_of_numpy_to_the_digit():
    values = np.random.default_rng(0).random((50, 27))
    for row in values.tolist():
        assert summarize_scores([{"ssim": one} for one in row])["ssim"]["std"] == np.std(row)
        same = [{"ssim": one, "frames": 120} for one in row]
        assert summarize_scores(same)["ssim"]["std"] == pytest.approx(np.std(row), rel=1e-12)


def _remove(name):
    return lambda folder: (folder / f"{name}.npy").unlink()


def _events_end(folder):
    for name in ("ts", "xy", "p"):
        np.save(folder / f"events_{name}.npy", np.load(folder / f"events_{name}.npy")[:9])
    index = np.load(folder / "image_event_indices.npy")
    np.save(folder / "image_event_indices.npy", index.clip(0, 8))


def _frames_alone(folder):
    for name in ("ts", "xy", "p"):
        (folder / f"events_{name}.npy").unlink()


def _no_frames(folder):
    for name in ("images", "images_ts", "image_event_indices"):
        (folder / f"{name}.npy").unlink()


@pytest.mark.parametrize(
    ("spoil", "overrides", "words"),
    [
        (_remove("events_xy"), [], r"events_xy\.npy is missing"),
        (_frames_alone, [], r"events_ts\.npy is missing"),
        (_no_frames, [], "holds events but no frames"),
        (_events_end, [], r"the events end at .* before 3 of 4 frames"),
        (None, ["data.start_s=5"], "no frame to score between"),
        (
            None,
            ["data.start_s=5", "data.end_s=1"],
            "data.start_s must be >= 0 and before data.end_s",
        ),
        (None, ["data.window=seconds", "data.tolerance_ms=0"], "no window ends within"),
        (None, ["data.window=x"], "data.window must be one of frames, events, seconds"),
        (None, ["scene.root=nowhere"], "scene.root must be a folder of sequences, got nowhere"),
        (shutil.rmtree, [], "scene.root must hold sequences of EVREAL"),
        (None, ["backward_warmup_s=0.1"], "data=evreal needs postprocess=none"),
    ],
)
def test_what_cannot_be_scored_is_named(tmp_path, run, spoil, overrides, words):
    folder = write_recording(tmp_path / "data/own", "evreal", make_events(), make_frames())
    if spoil:
        spoil(folder)
    with pytest.raises(ValueError, match=words):
        run("metrics.lpips=null", *overrides)
    assert not list(tmp_path.rglob("results.json"))


def test_a_network_of_nine_views_is_refused(tmp_path):
    given = ["data=evreal", "ckpt=lf3x3", f"scene.root={tmp_path}"]
    with pytest.raises(ValueError, match="ckpt must take one view for data=evreal, got one of 9"):
        evaluate(config("eval", tmp_path / "run", *given))


def test_a_recording_without_frames_is_named(tmp_path, run):
    path = write_recording(tmp_path / "data/own", "ecd", make_events(), make_frames())
    (path.parent / "events.txt").rename(path.parent / "other.txt")
    with pytest.raises(ValueError, match=r"own: events\.txt is missing, 0 other files"):
        run()
    (path.parent / "other.txt").rename(path)
    (path.parent / "images.txt").write_text("")
    with pytest.raises(ValueError, match=r"events\.txt: holds events but no frames"):
        run()
