"""The networks and baselines that a configuration names."""

from pathlib import Path
from typing import TypeVar

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from src.app.instantiate import build_part, read_user_packages
from src.models import files
from src.models.backward_warmup import BackwardWarmup
from src.models.network import VideoMethod

Method = TypeVar("Method", bound=VideoMethod)


def load_network_of_kind(
    kind: type[Method], cfg: DictConfig, weights: str, error_prefix: str
) -> Method:
    """Return the network of `weights`, a file or a name as of `ckpt`; ValueError where it is not
    there or no `kind`."""
    try:
        network = files.load(weights, read_user_packages(cfg))
    except ValueError as error:
        raise ValueError(f"{error_prefix}: {error}") from error
    if not isinstance(network, kind):
        raise ValueError(f"{error_prefix} for events, {weights} is none")
    return network


def load_ckpt_or_baseline(cfg: DictConfig) -> VideoMethod:
    """Return the network that `ckpt` or `baseline` names, in eval mode; ValueError for both."""
    if cfg.ckpt and cfg.get("baseline"):
        raise ValueError(f"ckpt must be null with baseline=..., got {cfg.ckpt}")
    if cfg.ckpt:
        net = files.load(cfg.ckpt, read_user_packages(cfg))
        if not isinstance(net, VideoMethod):
            use = f"baseline=frames postprocess=mambatm postprocess.postprocessor={cfg.ckpt}"
            how = f"; use {use}" if "postprocess" in cfg else " of frames"
            raise ValueError(f"ckpt must be a network for events, got a post-processor{how}")
        return net
    if cfg.get("baseline"):
        return build_part(cfg, "baseline").eval()
    raise ValueError("ckpt or baseline must name a network, got neither")


def load_method_with_postprocess(cfg: DictConfig) -> VideoMethod:
    """Return the network of `ckpt` or `baseline`, with the backward warm-up and the frame
    post-processor that the config asks for.
    """
    net = load_ckpt_or_baseline(cfg)
    if cfg.get("backward_warmup_s"):
        net = BackwardWarmup(net, cfg.backward_warmup_s)
    return build_part(cfg, "postprocess", source=net) if cfg.get("postprocess") else net


def method_name(cfg: DictConfig) -> str:
    """Return what a table calls the method of a test: the `name` that was given, else the network
    or the baseline.
    """
    if cfg.name != cfg.task:
        return cfg.name
    if cfg.ckpt:
        path = Path(cfg.ckpt)
        return path.stem if path.suffix else str(cfg.ckpt).rstrip("/")
    choices = HydraConfig.get().runtime.choices if HydraConfig.initialized() else {}
    return choices.get("baseline") or str(cfg.baseline._target_).rpartition(".")[2]
