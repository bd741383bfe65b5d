"""Pre-train the context pyramid of a SetNet, before it is trained as a whole:

    python -m scripts.pretrain_context experiment=setnet_small ckpt=FILE export=FILE

Further: +clips= and +steps=.

A training step sees a few clips, too few for the brightness of uniform areas: what follows the
memory, `SetNet.context` above all, learns nothing from them for hours (docs/decisions/07).  Here
the memory of `ckpt` is frozen.  Its state in a few windows of many clips is computed once; then
what follows, begun anew, is trained on pictures of many clips a step, by their mean absolute error.
`export` is to go on from: `python -m src.train ... ckpt=FILE`.  The config is that of the training.
"""

import math
import time
from collections.abc import Iterable
from pathlib import Path

import hydra
import lightning
import torch
from jaxtyping import Float
from omegaconf import DictConfig
from torch import Tensor
from torch.nn import functional

from src.app import build, entry_point, hardware
from src.app.renamed_keys import refuse_renamed_keys
from src.deploy.cpu_features import is_bf16_faster
from src.models import files
from src.models.setnet import CELL_PX, SetNet
from src.sim.pipeline import Sample
from src.training.batch_sampler import SampleId
from src.training.datamodule import BatchSimulator, LightFieldData
from src.training.learning_curve import read_training_progress

FROZEN = ("voxel_kernels", "sum_kernels", "spread_conv", "memory")  # parts that are not trained
EVERY = 7  # windows between two that are learned from; the last one is
PICTURES = 24  # a step
RATE, RISE = 1.5e-3, 50  # of Adam, falling by a cosine; steps over which it rises


def rounded() -> torch.autocast:
    """Return a context that computes in bf16 where the processor is faster in it."""
    return torch.autocast("cpu", torch.bfloat16, enabled=is_bf16_faster())


def begun_anew(network: SetNet) -> SetNet:
    """Return a fresh network that remembers as `network` does."""
    fresh = type(network)(**network.init_kwargs)
    kept = network.state_dict()
    known = {name: kept[name] for name in kept if name.split(".")[0] in FROZEN}
    fresh.load_state_dict(known, strict=False)
    return fresh


@torch.no_grad()
def held(
    network: SetNet, samples: Iterable[Sample]
) -> tuple[Float[Tensor, "m c h2 w2"], Float[Tensor, "m 1 h w"]]:
    """Return what the memory holds in every EVERY-th window of all clips, up to the last, and the
    true pictures; float16.
    """
    maps, truth = [], []
    for sample in samples:
        clips, windows = sample.voxels.shape[:2]
        seen: list[Tensor] = []
        hook = network.memory.register_forward_hook(lambda _, x, y, seen=seen: seen.append(y[0]))
        with rounded():
            network.sequence(sample.voxels, window_s=sample.window_s, positions=sample.positions)
        hook.remove()
        chosen = slice((windows - 1) % EVERY, None, EVERY)
        every = seen[0].unflatten(0, (windows, clips))[chosen]
        maps.append(every.transpose(0, 1).flatten(0, 1).half())
        truth.append(sample.target[:, chosen].flatten(0, 1).half())
    return torch.cat(maps), torch.cat(truth)


def new_context(network: SetNet, maps: Float[Tensor, "m c h2 w2"]) -> Float[Tensor, "m c h4 w4"]:
    """Return the context of the maps, each a clip of its own, updated everywhere."""
    sizes = network.context.held_map_sizes(*maps.shape[2:])
    nothing = tuple(maps.new_zeros(len(maps), *size) for size in sizes)
    return network.context(maps, nothing, torch.ones_like(maps[:, :1]) > 0)[0]


def learn(network: SetNet, maps: Tensor, truth: Tensor, steps: int) -> list[float]:
    """Train what follows the memory on what `held` returns; return the error of every step."""
    follows = [part for name, part in network.named_children() if name not in (*FROZEN, "relu")]
    parameters = [parameter for part in follows for parameter in part.parameters()]
    optimizer, errors = torch.optim.Adam(parameters, RATE), []
    for step in range(steps):
        fallen = 0.5 * (1 + math.cos(math.pi * step / steps))
        optimizer.param_groups[0]["lr"] = RATE * min(1, (step + 1) / RISE) * fallen
        some = torch.randint(len(maps), (PICTURES,))
        seen = maps[some].float()
        with rounded():
            cells = network.decode_logits(seen, new_context(network, seen))
        frames = functional.pixel_shuffle(cells, CELL_PX).sigmoid()
        error = (frames - truth[some]).abs().mean()
        optimizer.zero_grad()
        error.backward()
        optimizer.step()
        errors.append(float(error.detach()))
        if len(errors) % 100 == 0:
            print(f"{len(errors)} steps: mean error {sum(errors[-100:]) / 100:.4f}", flush=True)
    return errors


def samples(data: LightFieldData, clips: int) -> Iterable[Sample]:
    """Return the first training clips, as a training sees them, a batch at a time."""
    pipeline = data.pipelines["train"]
    simulated = BatchSimulator([pipeline], data.augment, seed=data.seed)
    for first in range(0, clips, data.batch_size):
        numbers = range(first, min(first + data.batch_size, clips))
        yield simulated([(SampleId(number, number), pipeline.draw(number)) for number in numbers])


def teach(cfg: DictConfig, clips: int, steps: int) -> None:
    """Read `cfg.ckpt`, write `cfg.export`; the hours that this took are added to its own."""
    if not (cfg.ckpt and cfg.export and files.is_weights_file(Path(cfg.export))):
        got = f"{cfg.ckpt} and {cfg.export}"
        raise ValueError(f"ckpt and export must be files, export a .safetensors, got {got}")
    if any(type(count) is not int or count < 1 for count in (clips, steps)):
        raise ValueError(f"clips and steps must be whole numbers >= 1, got {clips} and {steps}")
    hardware.reserve_worker_cores(cfg)
    hardware.retain_freed_memory(cfg)
    _, spec = build.build_untrained_network(cfg)
    source, start = files.find_checkpoint(cfg.ckpt, spec), time.process_time()
    before = files.load(source)
    if not isinstance(before, SetNet):
        raise ValueError(f"ckpt must be a SetNet, got {type(before).__name__} in {source}")
    lightning.seed_everything(cfg.seed, verbose=False)
    network, card = begun_anew(before), read_training_progress(source)
    maps, truth = held(network, samples(build.build_data_module(cfg), clips))
    learn(network, maps, truth, steps)
    card["hours"] += (time.process_time() - start) / 3600
    files.save(Path(cfg.export), network, spec, card)


@hydra.main(version_base=None, config_path="../conf", config_name="train")
def main(cfg: DictConfig) -> None:
    """Glue between Hydra and `teach`."""
    refuse_renamed_keys(cfg)
    teach(cfg, cfg.get("clips", 800), cfg.get("steps", 1000))


if __name__ == "__main__":
    entry_point.run_main(main)
