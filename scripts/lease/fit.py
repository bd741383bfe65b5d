"""Whether a plan fits its minutes, megabytes and files, counted before anything runs."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
from hydra.errors import HydraException
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from scripts.lease.export import KEPT_FREE, TABLES, TABLES_BYTES, parts_of
from scripts.lease.plan import MIB, Network, Plan
from src.app import build
from src.models import files
from src.training.bank_samples import Banked
from src.training.datamodule import LightFieldData
from src.training.device_cache import DeviceCache

TRAINED_BYTES = 16  # of a checkpoint, per parameter: weights, their mean and Adam's two moments


@dataclass(frozen=True)
class Sized:
    """A network of the plan with its config, the bytes of its exported weights in `parts` files,
    those of a checkpoint, and its pre-simulated caches: that of its crops, that of larger ones, or
    none."""

    network: Network
    cfg: DictConfig
    params: int
    weights: int
    parts: int
    checkpoint: int
    caches: list[DeviceCache]

    @property
    def name(self) -> str:
        """The network's name."""
        return self.network.name


@dataclass(frozen=True)
class Fit:
    """The `networks` that are trained, in turn; why others are `left_out`; of which the last whole
    export stays until the next one is (`doubled`) and of which checkpoints are exported too.
    """

    networks: list[Sized]
    left_out: dict[str, str]
    doubled: set[str]
    checkpoints: set[str]


def sized(plan: Plan, network: Network) -> Sized:
    """Return what `network` takes; it is built without memory.

    Raises ValueError naming the network for a config that nothing can be trained with and for a
    tensor that no file may hold.
    """
    try:
        cfg = plan.config(network)
        with torch.device("meta"):
            net, spec = build.network(cfg)
        build.reconstructor(cfg, net, spec)
        caches = _caches(build.data(cfg, ("train", "val")))
    except (HydraException, OmegaConfBaseException, ValueError) as error:
        reason = " ".join(str(error).split())
        raise ValueError(f"networks: {network.name} cannot be trained: {reason}") from error
    sizes = {name: 2 * value.numel() for name, value in files.folded(net).items()}
    limit = int(plan.file_mib * MIB) - KEPT_FREE
    if (largest := max(sizes.values())) > limit:
        raise ValueError(
            f"file_mib must be >= {(largest + KEPT_FREE) / MIB:.2f} for {network.name}, one tensor "
            f"of which has {largest / MIB:.2f} MiB, got {plan.file_mib:g}"
        )
    params = sum(parameter.numel() for parameter in net.parameters())
    parts = len(parts_of(sizes, limit))
    return Sized(
        network, cfg, params, sum(sizes.values()) + parts * KEPT_FREE, parts,
        TRAINED_BYTES * params + KEPT_FREE, caches,
    )  # fmt: skip


def fit(plan: Plan, minutes: float) -> Fit:
    """Return what of `plan` is done in `minutes`; raises ValueError as `sized` and `choose` do."""
    return choose(plan, [sized(plan, network) for network in plan.networks], minutes)


def choose(plan: Plan, every: Sequence[Sized], minutes: float) -> Fit:
    """Return what of `every` network is trained in `minutes`: all that are not optional, and of the
    rest, in turn, what fits beside them.

    Raises ValueError with the numbers where the first do not fit.
    """
    chosen = [one for one in every if not one.network.optional]
    if reason := excess(plan, chosen, minutes):
        raise ValueError(reason)
    left_out = {}
    for one in (one for one in every if one.network.optional):
        more = [other for other in every if other in chosen or other is one]
        if reason := excess(plan, more, minutes):
            left_out[one.name] = reason
        else:
            chosen = more
    if not chosen:
        raise ValueError(f"networks: none fits: {'; '.join(left_out.values())}")
    return Fit(chosen, left_out, *_room(plan, chosen))


def excess(plan: Plan, networks: Sequence[Sized], minutes: float) -> str:
    """Return why `networks` do not fit, with the numbers; nothing where they do."""
    asked = sum(one.network.minutes for one in networks)
    fixed = overhead(plan, networks) / 60
    if asked + fixed > minutes:
        return (
            f"minutes must be >= {asked + fixed:.2f}: {asked:.2f} of training "
            f"({', '.join(f'{one.name} {one.network.minutes:g}' for one in networks)}) and "
            f"{fixed:.2f} beside it (check {plan.check_s:g} s, cache {fills(networks)} x "
            f"{60 * plan.fill.minutes:g} s, validation {len(networks)} x "
            f"{plan.validate.seconds:g} s, margin {plan.margin_s:g} s), got {minutes:g}"
        )
    size = sum(one.weights for one in networks) + TABLES_BYTES
    each = ", ".join(f"{one.name} {one.weights / MIB:.2f}" for one in networks)
    if size > plan.budget_mib * MIB:
        return f"budget_mib must be >= {size / MIB:.2f} ({each}), got {plan.budget_mib:g}"
    count = sum(one.parts for one in networks) + len(TABLES)
    if count > plan.files:
        each = ", ".join(f"{one.name} {one.parts}" for one in networks)
        return f"files must be >= {count} ({each}, {', '.join(TABLES)}), got {plan.files}"
    return ""


def fills(networks: Sequence[Sized]) -> int:
    """Return how often caches are filled for `networks` in turn."""
    wanted = [one.caches for one in networks if one.caches]
    return sum(now != before for before, now in pairwise([[], *wanted]))


def overhead(plan: Plan, networks: Sequence[Sized]) -> float:
    """Return the seconds of a lease in which nothing is trained."""
    filling = 60 * plan.fill.minutes * fills(networks)
    return plan.check_s + filling + plan.validate.seconds * len(networks) + plan.margin_s


def allotted(networks: Sequence[Network], seconds: float) -> list[float]:
    """Return the seconds of training of each of `networks` of so many `seconds` for all: its
    minutes and its share of what is left over; too few seconds shorten all alike.
    """
    asked = [60 * network.minutes for network in networks]
    shares, left = [network.share for network in networks], seconds - sum(asked)
    if left < 0:
        return [max(seconds, 0.0) * own / (sum(asked) or 1) for own in asked]
    return [
        own + (left * share / sum(shares) if share else 0.0)
        for own, share in zip(asked, shares, strict=True)
    ]


def _caches(data: LightFieldData) -> list[DeviceCache]:
    """Return what the training clips come from; ValueError for a cache on a disk."""
    streams = [data.pipelines["train"], *([data.large.pipeline] if data.large else [])]
    found = [stream.bank for stream in streams if isinstance(stream, Banked)]
    if any(not isinstance(cache, DeviceCache) for cache in found):
        raise ValueError("data.bank_on must be device in a lease, got disk")
    return found


def _room(plan: Plan, networks: Sequence[Sized]) -> tuple[set[str], set[str]]:
    """Return the networks that two generations of fit for a moment, and those whose checkpoints fit
    beside all of these."""
    free = plan.budget_mib * MIB - TABLES_BYTES - sum(one.weights for one in networks)
    count = plan.files - len(TABLES) - sum(one.parts for one in networks)
    doubled = [one for one in networks if one.weights <= free and one.parts <= count]
    free -= max((one.weights for one in doubled), default=0)
    count -= max((one.parts for one in doubled), default=0)
    checkpoints = set()
    for one in networks:
        needed = -(-one.checkpoint // (int(plan.file_mib * MIB) - KEPT_FREE))
        if one.checkpoint <= free and needed <= count:
            checkpoints.add(one.name)
            free, count = free - one.checkpoint, count - needed
    return {one.name for one in doubled}, checkpoints
