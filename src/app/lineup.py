"""Which networks are compared: from the config's `ckpt`, `baseline` or `networks` to candidates."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from omegaconf import DictConfig, ListConfig, OmegaConf

import src.models
from baselines.postprocess import load as load_restorer
from src.app import build
from src.bench.candidates import Candidate
from src.models.adaptive import Adaptive, Level
from src.sim.pipeline import Pipeline

KEYS = {"ckpt", "baseline", "model", "views", "restorer"}


def gather(cfg: DictConfig) -> list[Candidate]:
    """Return the candidates: those of `ckpt` (one or a list) and `baseline`, else of `networks`.

    An entry of `networks` whose weights are not there is a candidate without weights where it says
    what its `model` is, else one with nothing but the reason.  Raises ValueError for a `ckpt` or a
    `baseline` given by hand that cannot be had, and for entries that are no such thing.
    """
    if cfg.ckpt or cfg.get("baseline"):
        return _by_hand(cfg)
    entries = OmegaConf.to_container(cfg.networks, resolve=True)
    candidates = [_entry(name, entry, build.rooms(cfg)) for name, entry in entries.items() if entry]
    if not candidates:
        raise ValueError("networks must name at least one network, got none")
    return candidates


def _by_hand(cfg: DictConfig) -> list[Candidate]:
    names = cfg.ckpt if isinstance(cfg.ckpt, ListConfig) else [cfg.ckpt] if cfg.ckpt else []
    labels = [Path(name).stem if Path(name).suffix else name for name in names]
    networks = [src.models.load(name, build.rooms(cfg)) for name in names]
    if cfg.get("baseline"):
        labels.append(str(cfg.baseline.get("name", "baseline")))
        networks.append(build.part(cfg, "baseline").eval())
    pairs = zip(labels, networks, strict=True)
    return [Candidate(label, net, net.views or cfg.optics.views) for label, net in pairs]


def _entry(name: str, entry: Mapping, own: Sequence[str]) -> Candidate:
    if not isinstance(entry, Mapping) or set(entry) - KEYS or "views" not in entry:
        allowed = ", ".join(sorted(KEYS))
        raise ValueError(f"networks.{name} must have views and of {allowed}, got {entry}")
    views, reason = entry["views"], "it names no weights"
    try:
        restorer = load_restorer(entry["restorer"], own) if "restorer" in entry else None
        if "ckpt" in entry:
            return Candidate(name, src.models.load(entry["ckpt"], own), views, restorer=restorer)
        if "baseline" in entry:
            network = build.make(entry["baseline"], own).eval()
            return Candidate(name, network, views, restorer=restorer)
    except ValueError as error:
        reason = str(error)
    timed_only = "model" in entry and "restorer" not in entry
    network = build.make(entry["model"], own).eval() if timed_only else None
    return Candidate(name, network, views, trained=False, missing=reason)


def under(cfg: DictConfig, severity: str, **data) -> Pipeline:
    """Return the simulation of test clips under `severity`, with other values of `data`."""
    chosen = {"severity": severity}
    simulated = "atmosphere" in cfg.turbulence
    changes = {"turbulence": {"atmosphere": chosen} if simulated else chosen, "data": data}
    return build.pipeline(OmegaConf.merge(cfg, changes), "test")


def adaptive(cfg: DictConfig) -> tuple[Adaptive, Pipeline] | str:
    """Return the adaptive network of `adapt` and the clips to show it on, or why there is none.

    Raises ValueError, naming the key, for values of `adapt` outside their ranges.
    """
    if cfg.adapt.clips < 1:
        raise ValueError(f"adapt.clips must be >= 1, got {cfg.adapt.clips}")
    try:
        loaded = {ckpt: src.models.load(ckpt, build.rooms(cfg)) for ckpt, _ in cfg.adapt.levels}
    except ValueError as error:
        return str(error)
    levels = [Level(loaded[ckpt], views, Path(ckpt).stem) for ckpt, views in cfg.adapt.levels]
    options = {name: cfg.adapt[name] for name in ("tolerance", "patience", "handover")}
    return Adaptive(levels, **options), under(cfg, "strong", test_windows=cfg.adapt.windows)
