"""Batches for training, validation and test, simulated on the fly: number -> draw -> sample."""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import torch
from lightning import LightningDataModule
from torch.utils.data import DataLoader

from src.sim import noise
from src.sim.pipeline import Draw, Pipeline, Sample, joined
from src.training.augment import Augment
from src.training.bank_filler import Filler
from src.training.batch_sampler import Item, LargeStream, Numbered, StepSampler
from src.training.teachers import Teachers


class LightFieldData(LightningDataModule):
    """`pipelines` has one Pipeline for each of train, val and test.

    `epoch_clips`: training clips between two validations; `val_clips`, `test_clips`: their numbers.
    `reuse`: steps in a row that train on one simulated batch, each augmented anew; saves
    simulation with at most one worker.
    `workers`: processes that simulate beside the training; 0 simulates in the training process.
    `simulate_on`: `worker` (CPU) or `device` (the training device, for GPUs).
    `filler`: fills the banks of air in the background of a training, where there are some.
    `teachers`: what they make of the training clips is a part of these.
    `large`: a second stream of training batches, of larger pictures, spread evenly among the first.
    """

    def __init__(
        self,
        pipelines: dict[str, Pipeline],
        augment: Augment | None = None,
        *,
        batch_size: int = 8,
        reuse: int = 1,
        epoch_clips: int = 216,
        val_clips: int = 27,
        test_clips: int = 27,
        workers: int = 0,
        simulate_on: str = "worker",
        seed: int = 0,
        filler: Filler | None = None,
        teachers: Teachers | None = None,
        large: LargeStream | None = None,
    ):
        super().__init__()
        if simulate_on not in ("worker", "device"):
            raise ValueError(f"data.simulate_on must be worker or device, got {simulate_on}")
        counts = {"batch_size": batch_size, "reuse": reuse, "epoch_clips": epoch_clips}
        for name, value in counts.items():
            if value < 1:
                raise ValueError(f"data.{name} must be >= 1, got {value}")
        if epoch_clips < batch_size:
            raise ValueError(f"data.epoch_clips must be >= data.batch_size, got {epoch_clips}")
        self.pipelines, self.augment, self.seed = pipelines, augment, seed
        self.filler, self.teachers, self.large = filler, teachers, large
        self.batch_size, self.reuse, self.epoch_clips = batch_size, reuse, epoch_clips
        self.val_clips, self.test_clips = val_clips, test_clips
        self.workers, self.simulate_on = workers, simulate_on
        self.simulators: dict[tuple[str, torch.device], Callable[[list], Sample]] = {}

    def setup(self, stage: str) -> None:
        """Start filling the bank; one process of each machine does."""
        if stage == "fit" and self.filler is not None and self.trainer.local_rank == 0:
            self.trainer.print(self.filler.status())
            self.filler.start()

    def teardown(self, stage: str) -> None:
        """Stop filling the bank."""
        if stage == "fit" and self.filler is not None:
            self.filler.stop()

    def train_dataloader(self) -> DataLoader:
        """Return endless clips, from the training's step on: what goes on sees others."""
        trainer = self.trainer
        sampler = StepSampler(
            self.batch_size,
            max(1, self.epoch_clips // (self.batch_size * trainer.world_size)),
            lambda: trainer.lightning_module.steps,
            reuse=self.reuse,
            rank=trainer.global_rank,
            world=trainer.world_size,
            large=(self.large.share, self.large.batch_size) if self.large else (0.0, 1),
        )
        return self._loader("train", batch_sampler=sampler)

    def val_dataloader(self) -> DataLoader:
        """Return clips 0 .. val_clips - 1 of the validation split, one at a time."""
        return self._loader("val", sampler=[Item(clip, clip) for clip in range(self.val_clips)])

    def test_dataloader(self) -> DataLoader:
        """Return clips 0 .. test_clips - 1 of the test split, one at a time."""
        return self._loader("test", sampler=[Item(clip, clip) for clip in range(self.test_clips)])

    def validation_samples(self) -> Iterator[Sample]:
        """Yield the validation clips on the training device; a training need not be interrupted."""
        for batch in self.val_dataloader():
            sample = batch if isinstance(batch, Sample) else self._on_device("val", batch)
            yield sample.to(self.trainer.strategy.root_device)

    def on_after_batch_transfer(self, batch: Sample | list, dataloader_idx: int) -> Sample:
        """Simulate drawn clips on the training device when no worker has."""
        if isinstance(batch, Sample):
            return batch
        split = "train" if self.trainer.training else "test" if self.trainer.testing else "val"
        return self._on_device(split, batch)

    def transfer_batch_to_device(self, batch, device: torch.device, dataloader_idx: int):
        """Leave drawn clips where they are; move samples."""
        return batch.to(device) if isinstance(batch, Sample) else batch

    def _loader(self, split: str, **sampling) -> DataLoader:
        on_worker = self.simulate_on == "worker"
        return DataLoader(
            Numbered(*self._streams(split)),
            num_workers=self.workers,
            collate_fn=self._simulator(split, "cpu") if on_worker else list,
            worker_init_fn=_one_thread,
            persistent_workers=self.workers > 0,
            **sampling,
        )

    def _on_device(self, split: str, batch: list) -> Sample:
        device = self.trainer.strategy.root_device
        if (split, device) not in self.simulators:  # kept, so that a batch can be used again
            self.simulators[split, device] = self._simulator(split, device)
        return self.simulators[split, device](batch)

    def _simulator(self, split: str, device) -> Callable[[Sequence], Sample]:
        training = (self.augment, self.teachers) if split == "train" else (None, None)
        return Simulator(self._streams(split), *training, seed=self.seed, device=device)

    def _streams(self, split: str) -> list[Pipeline]:
        large = [self.large.pipeline] if self.large and split == "train" else []
        return [self.pipelines[split], *large]


class Simulator:
    """Turns numbered draws of a stream into a batch; picklable, so that a worker can be given one.

    On a GPU all clips go through the simulation at once, on a CPU one after the other, so that
    memory stays that of one clip.  The last simulation is kept: the same draws again are only
    augmented again.
    """

    def __init__(
        self,
        streams: Sequence[Pipeline],
        augment: Augment | None = None,
        teachers: Teachers | None = None,
        *,
        seed: int = 0,
        device: torch.device | str = "cpu",
    ):
        self.streams, self.augment, self.teachers = streams, augment, teachers
        self.seed, self.device = seed, torch.device(device)
        self.last: tuple[list, list[Sample]] = ([], [])

    def __call__(self, numbered: Sequence[tuple[Item, Draw]]) -> Sample:
        start = time.perf_counter()
        items, draws = zip(*numbered, strict=True)
        names = [(item.stream, draw.key, draw.crop) for item, draw in numbered]
        if self.last[0] != names:
            self.last = (names, self._made(self.streams[items[0].stream], draws, names))
        samples = self.last[1]
        if self.augment is None:
            sample = joined(samples)
        else:
            keys = [noise.key(self.seed, "augment", *item.counted) for item in items]
            sample = self.augment(samples, keys)
        return replace(sample, seconds=time.perf_counter() - start)

    def _made(self, pipeline: Pipeline, draws: Sequence[Draw], names: list) -> list[Sample]:
        if self.device.type != "cpu" and self.teachers is None:
            return [pipeline.simulate(draws, self.device)]
        samples = [pipeline.sample(draw, self.device) for draw in draws]
        if self.teachers is None:
            return samples
        pairs = zip(samples, names, strict=True)
        return [replace(sample, taught=self.teachers(sample, name)) for sample, name in pairs]


def _one_thread(worker: int) -> None:
    torch.set_num_threads(1)
