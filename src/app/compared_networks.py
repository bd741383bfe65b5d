"""Which networks are compared: from the config's `ckpt`, `baseline` or `networks` to candidates."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import cast

from omegaconf import DictConfig, ListConfig, OmegaConf
from torch import nn

from baselines.postprocess import load_postprocessor
from src.app.instantiate import as_dict, build_part, instantiate_node, read_user_packages
from src.app.simulation import build_pipeline
from src.bench.candidates import Candidate
from src.models.files import load
from src.models.network import EventToVideoNetwork
from src.sim.pipeline import Pipeline

KEYS = {"ckpt", "baseline", "model", "views", "postprocessor"}


def load_candidates(cfg: DictConfig) -> list[Candidate]:
    """Return the candidates: those of `ckpt` (one or a list) and `baseline`, else of `networks`.

    An entry of `networks` whose weights are missing is a candidate without weights where it says
    what its `model` is, else one with nothing but the reason.  Raises ValueError for a `ckpt` or a
    `baseline` that cannot be loaded, for other `bins` than a network has, and for entries that are
    none.
    """
    packages = read_user_packages(cfg)
    given = cfg.ckpt if isinstance(cfg.ckpt, ListConfig) else [cfg.ckpt] if cfg.ckpt else []
    files = list(dict.fromkeys(map(str, given)))
    shown = zip(_name_networks(files), files, strict=True)
    loaded = {name: load(file, packages) for name, file in shown}
    if cfg.get("baseline"):
        name = str(cfg.baseline.get("architecture", "baseline"))
        name = f"baseline {name}" if name in loaded else name
        loaded[name] = build_part(cfg, "baseline").eval()
    if loaded:
        networks = {n: _require_event_network(n, net, cfg.bins) for n, net in loaded.items()}
        return [Candidate(n, net, net.views or cfg.optics.views) for n, net in networks.items()]
    entries = as_dict(cfg.networks).items()
    candidates = [_load_entry(n, entry, packages, cfg.bins) for n, entry in entries if entry]
    if not candidates:
        raise ValueError("networks must name at least one network, got none")
    return candidates


def _name_networks(files: Sequence[str]) -> list[str]:
    """Return the names of the files without their ends; paths where several have one name."""
    stems = [Path(file).stem if Path(file).suffix else file for file in files]
    return stems if len(set(stems)) == len(stems) else list(files)


def _load_entry(name: str, entry: Mapping, packages: Sequence[str], bins: int) -> Candidate:
    if not isinstance(entry, Mapping) or set(entry) - KEYS or "views" not in entry:
        allowed = ", ".join(sorted(KEYS))
        raise ValueError(f"networks.{name} must have views and of {allowed}, got {entry}")
    views, post, network, missing = entry["views"], None, None, "it names no weights"
    try:
        if "postprocessor" in entry:
            post = load_postprocessor(entry["postprocessor"], packages)
        if "ckpt" in entry:
            network = load(entry["ckpt"], packages)
        elif "baseline" in entry:
            network = instantiate_node(entry["baseline"], packages).eval()
    except ValueError as error:
        missing = str(error)
    if network is not None:
        events = _require_event_network(f"networks.{name}", network, bins)
        return Candidate(name, events, views, postprocessor=post)
    if "model" in entry and "postprocessor" not in entry:
        network = instantiate_node(entry["model"], packages).eval()
    return Candidate(name, network, views, trained=False, missing_reason=missing)


def _require_event_network(name: str, network: nn.Module, bins: int) -> EventToVideoNetwork:
    """Return `network`; raises ValueError for one that takes no events, or another number of
    `bins` where it has one."""
    if not isinstance(network, EventToVideoNetwork):
        raise ValueError(f"{name} must be a network for events, got {type(network).__name__}")
    wanted = getattr(network, "bins", bins)
    if wanted != bins:
        raise ValueError(f"bins must be {wanted} for {name}, got {bins}")
    return network


def pipeline_at_severity(cfg: DictConfig, severity: str) -> Pipeline:
    """Return the simulation of test clips with turbulence of `severity`."""
    chosen: dict = {"severity": severity}
    if "atmosphere" in cfg.turbulence:
        chosen = {"atmosphere": chosen}
    changed = OmegaConf.merge(cfg, {"turbulence": chosen})
    return build_pipeline(cast(DictConfig, changed), "test")
