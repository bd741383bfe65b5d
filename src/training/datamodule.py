"""Batches for training, validation and test, simulated on the fly: number -> draw -> sample."""

from collections.abc import Hashable, Iterator, Sequence
from dataclasses import replace
from typing import Any, cast

import torch
from lightning import LightningDataModule, Trainer
from torch.utils.data import DataLoader

from src.sim import noise
from src.sim.pipeline import ClipParameters, Pipeline, Sample, concatenate_samples
from src.training.augment import Augment
from src.training.batch_sampler import DrawDataset, LargeCropStream, SampleId, StepSampler
from src.training.device_prefetch import DevicePrefetcher
from src.training.disk_cache import CacheFillerProcess
from src.training.sample_store import SampleStore, StoredSamples
from src.training.teachers import TeacherEnsemble
from src.training.worker_process import prepare_worker_process


class LightFieldData(LightningDataModule):
    """`pipelines` has one Pipeline for each of train, val and test.

    `batch_reuse`: steps in a row that train on one simulated batch, each augmented anew; saves
    simulation with at most one worker.  `epoch_clips`: training clips between two validations.
    Validation and test are of clips 0, 1, ..., one at a time.
    `workers`: processes that simulate beside the training; 0 simulates in the training process.
    `simulate_on`: `worker` (CPU) or `device` (the training device, for GPUs).
    `filler`: fills caches on a disk in the background of a training.
    `teachers`: their frames of the training clips are a part of these.
    `large`: a second stream of training batches, of larger crops, spread evenly among the first.
    `test_store`: keeps test clips for the next network, also of another data module where it has
    the same `test_conditions`, which name all that makes the clips; None: a store of its own.
    """

    trainer: Trainer  # set by Lightning before anything here is called

    def __init__(
        self,
        pipelines: dict[str, Pipeline],
        augment: Augment | None = None,
        *,
        batch_size: int = 8,
        batch_reuse: int = 1,
        epoch_clips: int = 216,
        val_clips: int = 27,
        test_clips: int = 27,
        workers: int = 0,
        simulate_on: str = "worker",
        seed: int = 0,
        filler: CacheFillerProcess | None = None,
        teachers: TeacherEnsemble | None = None,
        large: LargeCropStream | None = None,
        test_store: SampleStore | None = None,
        test_conditions: str = "",
    ):
        super().__init__()
        if simulate_on not in ("worker", "device"):
            raise ValueError(f"data.simulate_on must be worker or device, got {simulate_on}")
        least = {"batch_size": 1, "batch_reuse": 1, "epoch_clips": batch_size}
        for name, value in zip(least, (batch_size, batch_reuse, epoch_clips), strict=True):
            if value < least[name]:
                raise ValueError(f"data.{name} must be >= {least[name]}, got {value}")
        self.pipelines, self.augment, self.seed = pipelines, augment, seed
        self.filler, self.teachers, self.large = filler, teachers, large
        self.batch_size, self.batch_reuse, self.epoch_clips = batch_size, batch_reuse, epoch_clips
        self.val_clips, self.test_clips = val_clips, test_clips
        self.workers, self.simulate_on = workers, simulate_on
        self.test_store = SampleStore() if test_store is None else test_store
        self.test_conditions = test_conditions
        self.simulators: dict[str, BatchSimulator] = {}  # on the training device

    def setup(self, stage: str) -> None:
        """Start filling the caches, in one process of each machine."""
        if stage == "fit" and self.filler is not None and self.trainer.local_rank == 0:
            self.trainer.print("\n".join(cache.status() for cache in self.filler.caches))
            self.filler.start()

    def teardown(self, stage: str) -> None:
        """Stop filling the caches after a training (`fit`); nothing else is taken down."""
        if stage == "fit" and self.filler is not None:
            self.filler.stop()

    def train_dataloader(self) -> DataLoader | DevicePrefetcher:
        """Return endless clips, from the training's step on: a resumed training sees others."""
        trainer, module = self.trainer, self.trainer.lightning_module
        sampler = StepSampler(
            batch_size=self.batch_size,
            steps_per_epoch=max(1, self.epoch_clips // (self.batch_size * trainer.world_size)),
            current_step=lambda: cast(int, module.steps_so_far),
            batch_reuse=self.batch_reuse,
            rank=trainer.global_rank,
            world=trainer.world_size,
            large_share=self.large.share if self.large else 0.0,
            large_batch_size=self.large.batch_size if self.large else 1,
        )
        loader = self._loader("train", batch_sampler=sampler)
        if self.simulate_on == "worker":
            return loader
        return DevicePrefetcher(
            loader,
            lambda draws: self._simulate_on_device("train", draws),
            self.trainer.strategy.root_device,
        )

    def val_dataloader(self) -> DataLoader:
        return self._loader("val", sampler=[SampleId(k, k) for k in range(self.val_clips)])

    def test_dataloader(self) -> StoredSamples:
        ids = [SampleId(k, k) for k in range(self.test_clips)]
        return StoredSamples(
            ids, self.test_conditions, self.test_store,
            lambda missing: self._loader("test", sampler=missing),
        )  # fmt: skip

    def validation_samples(self) -> Iterator[Sample]:
        """Yield the validation clips on the training device, within a training too."""
        for batch in self.val_dataloader():
            sample = batch if isinstance(batch, Sample) else self._simulate_on_device("val", batch)
            yield sample.to(self.trainer.strategy.root_device)

    def on_after_batch_transfer(self, batch: Sample | list, dataloader_idx: int) -> Sample:
        """Simulate drawn clips of a validation or a test on the training device."""
        if isinstance(batch, Sample):
            return batch
        return self._simulate_on_device("test" if self.trainer.testing else "val", batch)

    def transfer_batch_to_device(
        self, batch: Sample | list, device: torch.device, dataloader_idx: int
    ) -> Sample | list:
        return batch.to(device) if isinstance(batch, Sample) else batch

    def _loader(self, split: str, **sampling: Any) -> DataLoader:
        on_worker = self.simulate_on == "worker"
        return DataLoader(
            DrawDataset(*self._streams(split)),
            num_workers=self.workers,
            collate_fn=self._simulator(split, "cpu") if on_worker else list,
            worker_init_fn=prepare_worker_process,
            persistent_workers=self.workers > 0,
            **sampling,
        )

    def _simulate_on_device(self, split: str, batch: list) -> Sample:
        if split not in self.simulators:  # stays, so that a batch can be used again
            self.simulators[split] = self._simulator(split, self.trainer.strategy.root_device)
        return self.simulators[split](batch)

    def _simulator(self, split: str, device: torch.device | str) -> "BatchSimulator":
        training = (self.augment, self.teachers) if split == "train" else (None, None)
        return BatchSimulator(self._streams(split), *training, seed=self.seed, device=device)

    def _streams(self, split: str) -> list[Pipeline]:
        large = [self.large.pipeline] if self.large and split == "train" else []
        return [self.pipelines[split], *large]


class BatchSimulator:
    """Turns numbered draws of a stream into a batch; picklable, so that a worker can be given one.

    Clips are simulated all at once on a GPU, else one after the other.  The last simulation is
    kept: the same draws again are only augmented again.
    """

    def __init__(
        self,
        streams: Sequence[Pipeline],
        augment: Augment | None = None,
        teachers: TeacherEnsemble | None = None,
        *,
        seed: int = 0,
        device: torch.device | str = "cpu",
    ):
        self.streams, self.augment, self.teachers = streams, augment, teachers
        self.seed, self.device = seed, torch.device(device)
        self.last: tuple[list, list[Sample]] = ([], [])

    def __call__(self, numbered: Sequence[tuple[SampleId, ClipParameters]]) -> Sample:
        ids, draws = zip(*numbered, strict=True)
        # Behind a key of a cache that renews its clips is another clip later.
        names = [(sample.crop_stream, d.key, d.crop, d.clip.name) for sample, d in numbered]
        if self.last[0] != names:
            stream = ids[0].crop_stream
            samples = self._simulate(self.streams[stream], draws, names)
            for drawn in (drawn for one in samples if stream for drawn in one.parameters):
                drawn["large"] = True
            self.last = (names, samples)
        samples = self.last[1]
        if self.augment is None:
            return concatenate_samples(samples)
        keys = [noise.key(self.seed, "augment", *sample.augmentation_key) for sample in ids]
        return self.augment(samples, keys)

    def _simulate(
        self, pipeline: Pipeline, draws: Sequence[ClipParameters], names: Sequence[Hashable]
    ) -> list[Sample]:
        if self.teachers is None and self.device.type != "cpu":
            return [pipeline.simulate(draws, self.device)]
        samples = [pipeline.simulate([draw], self.device) for draw in draws]
        if self.teachers is None:
            return samples
        keys = names if pipeline.repeats_samples else [None] * len(names)
        pairs = zip(samples, keys, strict=True)
        return [replace(one, teacher_frames=self.teachers(one, key)) for one, key in pairs]
