"""Which networks of a plan fit its minutes, megabytes and files, counted before anything runs."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from scripts.lease.export import HEADER_BYTES, TABLES, TABLES_BYTES, split_into_parts
from scripts.lease.plan import MIB, Network, Plan
from src.app import build
from src.models.folding import inference_copy
from src.training.clip_cache import CachedPipeline, DeviceClipCache
from src.training.datamodule import LightFieldData


@dataclass(frozen=True)
class SizedNetwork:
    """A network of the plan with its config, the bytes of its exported weights in `parts` files,
    and its pre-simulated caches: that of its crops, then of larger ones.
    """

    network: Network
    cfg: DictConfig
    params: int
    weights_bytes: int
    parts: int
    caches: list[DeviceClipCache]

    @property
    def name(self) -> str:
        """The network's name."""
        return self.network.name


@dataclass(frozen=True)
class Selection:
    """The `networks` that are trained, in turn, and why others are `left_out`."""

    networks: list[SizedNetwork]
    left_out: dict[str, str]


def size_network(plan: Plan, network: Network) -> SizedNetwork:
    """Return what `network` takes; it is built without memory.

    Raises ValueError naming the network for a config that nothing can be trained with and for a
    tensor that no file may hold.
    """
    try:
        cfg = plan.config(network)
        with torch.device("meta"):
            net, spec = build.build_untrained_network(cfg)
        build.build_reconstructor(cfg, net, spec)
        caches = _device_caches(build.build_data_module(cfg, ("train", "val")))
    except (OmegaConfBaseException, ValueError) as error:
        reason = " ".join(str(error).split())
        raise ValueError(f"networks: {network.name} cannot be trained: {reason}") from error
    sizes = {name: 2 * value.numel() for name, value in inference_copy(net).state_dict().items()}
    limit = int(plan.max_export_file_mib * MIB) - HEADER_BYTES
    if (largest := max(sizes.values())) > limit:
        raise ValueError(
            f"max_export_file_mib must be >= {(largest + HEADER_BYTES) / MIB:.2f} for "
            f"{network.name}, one tensor of which has {largest / MIB:.2f} MiB, "
            f"got {plan.max_export_file_mib:g}"
        )
    params = sum(parameter.numel() for parameter in net.parameters())
    parts = len(split_into_parts(sizes, limit))
    weights_bytes = sum(sizes.values()) + parts * HEADER_BYTES
    return SizedNetwork(network, cfg, params, weights_bytes, parts, caches)


def select_networks(plan: Plan, every: Sequence[SizedNetwork], minutes: float) -> Selection:
    """Return what of `every` network is trained in `minutes`: all that are not optional, and of the
    rest, in turn, what fits beside them.

    Raises ValueError with the numbers where the first do not fit.
    """
    selected = [one for one in every if not one.network.optional]
    if reason := find_excess(plan, selected, minutes):
        raise ValueError(reason)
    left_out = {}
    for one in (one for one in every if one.network.optional):
        more = [other for other in every if other in selected or other is one]
        if reason := find_excess(plan, more, minutes):
            left_out[one.name] = reason
        else:
            selected = more
    if not selected:
        raise ValueError(f"networks: none fits: {'; '.join(left_out.values())}")
    return Selection(selected, left_out)


def find_excess(plan: Plan, networks: Sequence[SizedNetwork], minutes: float) -> str:
    """Return why `networks` do not fit, with the numbers; nothing where they do."""

    def each(values: Sequence[str]) -> str:
        return ", ".join(f"{one.name} {v}" for one, v in zip(networks, values, strict=True))

    training = sum(one.network.minutes for one in networks)
    fixed = overhead_s(plan, networks) / 60
    if training + fixed > minutes:
        asked = each([f"{one.network.minutes:g}" for one in networks])
        return (
            f"minutes must be >= {training + fixed:.2f}: {training:.2f} of training ({asked}) and "
            f"{fixed:.2f} beside it (check {plan.check_s:g} s, cache {count_fills(networks)} x "
            f"{60 * plan.fill.minutes:g} s, validation {len(networks)} x "
            f"{plan.validate.total_s:g} s, margin {plan.margin_s:g} s), got {minutes:g}"
        )
    size = sum(one.weights_bytes for one in networks) + TABLES_BYTES
    if size > plan.max_export_total_mib * MIB:
        asked = each([f"{one.weights_bytes / MIB:.2f}" for one in networks])
        got = f"got {plan.max_export_total_mib:g}"
        return f"max_export_total_mib must be >= {size / MIB:.2f} ({asked}), {got}"
    count = sum(one.parts for one in networks) + len(TABLES)
    if count > plan.max_export_files:
        asked = each([str(one.parts) for one in networks])
        needed = f"{count} ({asked}, {', '.join(TABLES)})"
        return f"max_export_files must be >= {needed}, got {plan.max_export_files}"
    return ""


def count_fills(networks: Sequence[SizedNetwork]) -> int:
    """Return how often caches are filled for `networks` in turn."""
    caches = [one.caches for one in networks if one.caches]
    return sum(now != before for before, now in pairwise([[], *caches]))


def overhead_s(plan: Plan, networks: Sequence[SizedNetwork]) -> float:
    """Return the seconds of a lease in which nothing is trained."""
    filling = 60 * plan.fill.minutes * count_fills(networks)
    return plan.check_s + filling + plan.validate.total_s * len(networks) + plan.margin_s


def allot_seconds(networks: Sequence[Network], seconds: float) -> list[float]:
    """Return the seconds of training of each of `networks` of so many `seconds` for all: its
    minutes and its share of what is left over; too few seconds shorten all alike.
    """
    asked = [60 * network.minutes for network in networks]
    shares, left = sum(network.share for network in networks), seconds - sum(asked)
    if left < 0:
        return [max(seconds, 0.0) * own / (sum(asked) or 1) for own in asked]
    return [
        own + (left * network.share / shares if network.share else 0.0)
        for own, network in zip(asked, networks, strict=True)
    ]


def _device_caches(data: LightFieldData) -> list[DeviceClipCache]:
    """Return what the training clips come from; ValueError for a cache on a disk."""
    pipelines = [data.pipelines["train"], *([data.large.pipeline] if data.large else [])]
    caches = [pipeline.cache for pipeline in pipelines if isinstance(pipeline, CachedPipeline)]
    on_device = [cache for cache in caches if isinstance(cache, DeviceClipCache)]
    if len(on_device) < len(caches):
        raise ValueError("data.cache_device must be device in a lease, got disk")
    return on_device
