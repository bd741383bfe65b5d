"""From a config to objects: classes of one's own, optics as the network wants them, the trainer."""

import platform
import resource
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from lightning.pytorch.callbacks import ProgressBar
from omegaconf import OmegaConf

from baselines import postprocess
from src.app import build, compared_networks, hardware, methods
from src.app.instantiate import instantiate_node, read_user_packages
from src.eval import evaluate
from src.models import files
from src.recordings.files import event_file, event_writers, recording_inputs
from src.train import train
from tests.conftest import ROOT
from tests.faults.harness import Run
from tests.test_train import TINY, config

OWN = """
import torch
from lightning.pytorch.callbacks import ModelCheckpoint
from lightning.pytorch.loggers import CSVLogger
from torch import nn, optim

from baselines.highpass import HighPass
from baselines.mambatm import MambaTM
from src.losses.terms import L1Term
from src.models.network import EventToVideoNetwork
from src.sim.optics import Optics
from src.sim.scenes.photographs import Photographs
from src.sim.sensor.sensor import EventSensor
from src.sim.turbulence.simulated import SimulatedTurbulence
from src.training.augment import Augment


class Net(EventToVideoNetwork):
    def __init__(self, gain: float):
        super().__init__()
        self.gain = nn.Parameter(torch.tensor(gain))

    def forward(self, voxels, state=None, *, window_s=1 / 120, positions=None):
        change = voxels.mean((1, 2))[:, None]
        state = change if state is None else 0.9 * state + change
        return (0.5 + self.gain * state).clamp(0, 1), state
"""
PARTS = {
    "scene": "Photographs", "optics": "Optics", "turbulence": "SimulatedTurbulence",
    "sensor": "EventSensor", "augment": "Augment", "loss.l1": "L1Term", "optimizer": "Adam",
    "reference_baseline.method": "HighPass", "logger.csv": "CSVLogger",
    "callbacks.checkpoint": "ModelCheckpoint", "postprocessor": "MambaTM",
}  # fmt: skip


@pytest.fixture
def own(tmp_path, monkeypatch):
    """A package `mypackage` with a class of its own for every part of a config."""
    classes = [
        f"class My{name}({'optim.' if name == 'Adam' else ''}{name}):\n    pass\n"
        for name in PARTS.values()
    ]
    (tmp_path / "mypackage").mkdir()
    (tmp_path / "mypackage" / "__init__.py").write_text("")
    (tmp_path / "mypackage" / "parts.py").write_text("\n\n".join([OWN, *classes]))
    monkeypatch.syspath_prepend(str(tmp_path))
    yield ["allowed_packages=[mypackage]"]
    for name in [name for name in sys.modules if name.split(".")[0] == "mypackage"]:
        del sys.modules[name]


def mine(key: str) -> str:
    return f"{key}._target_=mypackage.parts.My{PARTS[key]}"


NET = ["~model", "+model={_target_: mypackage.parts.Net, gain: 0.05}"]


def test_every_part_of_a_training_may_be_a_class_of_ones_own(own, tmp_path):
    chosen = [*NET, *(mine(key) for key in PARTS if key != "postprocessor")]
    train(config("train", tmp_path / "a", *TINY, *chosen, *own))
    ckpt = tmp_path / "a" / "checkpoints" / "last.ckpt"
    more = ["trainer.max_steps=2", f"ckpt={ckpt}"]
    train(config("train", tmp_path / "b", *TINY, *chosen, *own, *more))
    tested = ["debug=fdr", "metrics.lpips=null", f"ckpt={ckpt}"]
    evaluate(config("eval", tmp_path / "c", *tested, *own))
    (candidate,) = compared_networks.load_candidates(
        config("chart", tmp_path, f"ckpt={ckpt}", *own)
    )
    assert type(candidate.network).__name__ == "Net"
    with pytest.raises(ValueError, match=r"allowed_packages=\[<package>\]"):
        evaluate(config("eval", tmp_path / "d", *tested))


def test_arguments_of_a_network_of_ones_own_may_be_any_numbers(own, tmp_path):
    cfg = config("train", tmp_path, *TINY, *NET, "model.gain=5000.0", *own)
    network, spec = build.build_untrained_network(cfg)
    files.save(tmp_path / "own.safetensors", network, spec, {})
    assert files.load(tmp_path / "own.safetensors", ["mypackage"]).gain.item() == 5000


@pytest.mark.parametrize("key", [*PARTS, "model"])
def test_a_class_of_ones_own_is_refused_unless_its_package_is_named(own, key, tmp_path):
    if key == "postprocessor":
        pytest.skip("no part of a training")
    chosen = NET if key == "model" else [mine(key)]
    with pytest.raises(ValueError, match=r"_target_ must.*allowed_packages=\[<package>\]"):
        train(config("train", tmp_path, *TINY, *chosen, "allowed_packages=[other]"))


def test_a_post_processor_of_ones_own_is_loaded(own, tmp_path):
    from mypackage import parts

    spec = {
        "target": "mypackage.parts.MyMambaTM",
        "kwargs": {"frame_channels": 1, "base_channels": 8},
    }
    files.save(tmp_path / "mine.safetensors", parts.MyMambaTM(1, 8), spec, {})
    named = f"postprocess.postprocessor={tmp_path}/mine.safetensors"
    cfg = config("eval", tmp_path, "postprocess=mambatm", named, "baseline=frames", *own)
    assert type(methods.load_method_with_postprocess(cfg).postprocessor).__name__ == "MyMambaTM"
    with pytest.raises(ValueError, match="allowed_packages="):
        postprocess.load_postprocessor(f"{tmp_path}/mine.safetensors")


def test_a_network_and_a_baseline_are_not_both_taken(tmp_path):
    cfg = config("reconstruct", tmp_path, "recording=a.raw", "ckpt=any", "baseline=highpass")
    with pytest.raises(ValueError, match="^ckpt must be null with baseline=..., got any"):
        methods.load_ckpt_or_baseline(cfg)


@pytest.mark.parametrize("given", ["mypackage", "[1a]", "[..]", "['']"])
def test_allowed_packages_are_a_list_of_names(given, tmp_path):
    with pytest.raises(ValueError, match="allowed_packages must be a list of packages"):
        read_user_packages(config("eval", tmp_path, f"allowed_packages={given}"))


ENTRY_POINTS = ("train", "eval", "simulate", "reconstruct", "calibrate", "chart", "stress", "live")


@pytest.mark.parametrize("entry_point", ENTRY_POINTS)
def test_every_entry_point_that_builds_allows_no_package_of_ones_own(entry_point):
    assert OmegaConf.load(ROOT / "conf" / f"{entry_point}.yaml").allowed_packages == []


SMALL = ["scene.height=64", "scene.width=64", "data.test_clips=1", "data.test_windows=4"]
SMALL += ["data.unscored_windows=1", "data.workers=0", "metrics.lpips=null"]


def test_a_network_of_one_view_is_given_the_centre_of_nine(tmp_path):
    scores = [
        evaluate(config("eval", tmp_path / optics, *SMALL, "ckpt=single256", f"optics={optics}"))
        for optics in ("single", "lf3x3")
    ]
    assert scores[0]["test"] == scores[1]["test"]


def test_a_network_of_nine_views_is_not_given_one(tmp_path):
    with pytest.raises(ValueError, match="optics.views must be 9 for lf3x3, got 1"):
        evaluate(config("eval", tmp_path, *SMALL, "ckpt=lf3x3", "optics=single"))


def test_what_stands_in_for_missing_weights_has_their_layers():
    entries = OmegaConf.create({"networks": OmegaConf.load(ROOT / "conf/networks/all.yaml")})
    shipped = [entry for entry in entries.networks.values() if "ckpt" in entry]
    assert len(shipped) >= 6
    for entry in shipped:
        networks = files.load(entry.ckpt), instantiate_node(entry.model)
        layers = [[(name, p.shape) for name, p in net.state_dict().items()] for net in networks]
        assert layers[0] == layers[1], entry.ckpt


def test_without_a_progress_bar_training_goes_on_without_it(tmp_path):
    bars = []
    for shown in ("true", "false"):
        cfg = config("train", tmp_path, f"trainer.enable_progress_bar={shown}")
        trainer = build.build_trainer(cfg)
        bars.append(any(isinstance(found, ProgressBar) for found in trainer.callbacks))
    assert bars == [True, False]


@pytest.mark.parametrize(
    ("budget", "device", "able", "precision"),
    [
        ("minutes", "cpu", True, "bf16-mixed"),
        ("hours", "cpu", False, "32-true"),
        ("hours", "gpu", False, "bf16-mixed"),
        ("paper", "cpu", True, "32-true"),
    ],
)
def test_precision_is_what_the_device_is_fast_in(
    budget, device, able, precision, tmp_path, monkeypatch
):
    monkeypatch.setattr(hardware, "is_bf16_faster", lambda: able)
    cfg = config("train", tmp_path, f"budget={budget}", f"trainer.accelerator={device}")
    hardware.fill_in_precision(cfg)
    assert cfg.trainer.precision == precision


@pytest.mark.parametrize(
    ("devices", "first", "graphs"),
    [
        ("1", 0, True), ("[1]", 1, True), ("'1,'", 1, True), ("2", 0, False), ("[1,0]", 1, False),
        ("auto", 0, False), ("-1", 0, False), ("1 +trainer.num_nodes=2", 0, False),
    ],
)  # fmt: skip
def test_a_test_runs_on_the_first_gpu_and_graphs_are_of_one(
    devices, first, graphs, tmp_path, monkeypatch
):
    options: dict = {}
    monkeypatch.setattr(build, "build_part", lambda *_, **given: options.update(given))
    monkeypatch.setattr(build.evaluation, "test_network", lambda *_, **__: None)
    monkeypatch.setattr(hardware.torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(hardware.torch.cuda, "device_count", lambda: 2)
    cfg = config("train", tmp_path, "trainer=gpu", *f"trainer.devices={devices}".split())
    build.test_method(cfg, "any", None, None, None)
    assert options["devices"] == [first] and hardware.uses_cuda_graphs(cfg) == graphs


def test_devices_that_are_none_are_refused(tmp_path):
    cfg = config("train", tmp_path, "trainer=gpu", "trainer.devices=two")
    with pytest.raises(ValueError, match=r"trainer.devices must be a number .*, got two"):
        hardware.requested_gpus(cfg)


def test_a_missing_size_is_asked_for_by_its_key(tmp_path):
    events = np.array([(0, 1, 1, 1), (5, 2, 2, -1)], event_file.EVENT)
    event_writers.write_events(tmp_path / "a.raw", events, width=8, height=8)
    (tmp_path / "a.txt").write_text("0 1 1 1\n5e-6 2 2 0\n")
    with pytest.raises(ValueError, match=r"give sensor_size=\[height,width\]"):
        recording_inputs.find_sensor_size(tmp_path / "a.txt")
    with pytest.warns(UserWarning, match=r"states a sensor of 8x8: read as sensor_size=\[4,4\]"):
        assert recording_inputs.find_sensor_size(tmp_path / "a.raw", [4, 4]) == (4, 4)


def test_views_that_stand_anywhere_are_scored_and_timed(tmp_path):
    places = "[[0,0],[0,1],[0,2],[1,0],[1,1],[1,2]]"  # six: a number without a layout
    chosen = ["ckpt=setnet_small", "optics.views=6", f"optics.positions={places}"]
    record = evaluate(config("eval", tmp_path, *SMALL, *chosen))
    assert record["model"]["macs_per_frame"] > 0 and list(record["latency_ms"]) == ["64x64"]


def test_a_clip_read_backwards_first_is_scored(tmp_path):
    chosen = [*SMALL, "ckpt=lf3x3", "sensor.threshold=0.1"]  # the same work in every window
    once, ahead = (
        evaluate(config("eval", tmp_path / seconds, *chosen, f"backward_warmup_s={seconds}"))
        for seconds in ("0", "0.02")
    )
    assert ahead["test"]["psnr"]["mean"] != once["test"]["psnr"]["mean"]
    ratio = ahead["model"]["macs_per_frame"] / once["model"]["macs_per_frame"]
    assert ratio == pytest.approx(1.5)  # two of four windows are read twice


def page_faults() -> int:
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    torch.ones(16, 1024, 1024)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before


def count_page_faults(told: Path) -> None:
    """Write to `told` the page faults before and after memory is kept."""
    given_back = [page_faults() for _ in range(3)][-1]
    hardware.retain_freed_memory(OmegaConf.create({"trainer": {"accelerator": "cpu"}}))
    kept = [page_faults() for _ in range(3)][-1]
    told.write_text(f"{given_back} {kept}")


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="memory is kept by glibc only")
def test_a_training_on_a_cpu_keeps_the_memory_it_frees(tmp_path):
    """In a process of its own, with all that a training has loaded."""
    assert Run(tmp_path / "log", count_page_faults, tmp_path / "told").wait() == 0
    given_back, kept = map(int, (tmp_path / "told").read_text().split())
    assert kept < 0.01 * given_back


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ("optimizer.lr=-1", "optimizer takes no such values: Invalid learning rate: -1"),
        ("+optimizer.speed=2", "optimizer takes no such values: .*'speed'"),
        ("+scheduler.speed=2", "scheduler takes no such values: .*'speed'"),
        (
            "~optimizer +optimizer._target_=torch.optim.LBFGS +optimizer._partial_=true",
            "optimizer takes no such values: .*'closure'",
        ),
        (
            "~scheduler +scheduler._target_=torch.optim.lr_scheduler.ReduceLROnPlateau "
            "+scheduler._partial_=true",
            "scheduler takes no such values: .*'metrics'",
        ),
        ("+trainer.accumulate_grad_batches=2", "trainer.accumulate_grad_batches must be 1 or null"),
        ("+trainer.gradient_clip_val=1", "gradient_clip_val must be 0 .*, got 1: grad_clip_norm"),
        ("+trainer.overfit_batches=1", "trainer.overfit_batches must be 0 or null, got 1"),
        ("~callbacks.checkpoint ~callbacks.rotation", "callbacks must have a ModelCheckpoint with"),
        ("experiment=lf3x3 +model.extra=[5000]", "model.extra must hold sizes up to 4096, got 50"),
    ],
)
def test_what_cannot_train_is_refused_before_anything_runs(wrong, message, tmp_path):
    cfg = config("train", tmp_path / "run", *TINY, *wrong.split())
    with pytest.raises(ValueError, match=message):
        train(cfg)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("key", ["batch_view_dropout_probability", "batch_centre_view_probability"])
def test_a_network_of_a_fixed_number_of_views_loses_none(key, tmp_path):
    cfg = config("train", tmp_path, *TINY, "experiment=lf3x3", f"augment.{key}=0.5")
    with pytest.raises(ValueError, match=f"augment.{key} must be 0, got 0.5: .* takes 9 views"):
        build.build_reconstructor(cfg, *build.build_untrained_network(cfg))


@pytest.mark.parametrize("content", [b"", b"\xff\xd8\xff\xe0", "5x5"])
def test_a_small_file_that_is_no_photograph_is_named_before_anything_runs(content, tmp_path):
    for number in range(10):
        photo = np.random.default_rng(number).integers(0, 255, (64, 64), np.uint8)
        cv2.imwrite(str(tmp_path / f"{number}.png"), photo)
    build.build_data_module(_of_photographs(tmp_path), ("train",))
    small = cv2.imencode(".png", np.zeros((5, 5), np.uint8))[1].tobytes()
    (tmp_path / "3.png").write_bytes(small if content == "5x5" else content)
    with pytest.raises(ValueError, match="scene.root must hold readable photographs .*3.png"):
        build.build_data_module(_of_photographs(tmp_path), ("train",))


def _of_photographs(root):
    return config("train", root, f"scene.root={root}")
