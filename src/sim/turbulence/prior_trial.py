"""Whether cameras show what a prior is asked for, tried before the first clip is drawn."""

from collections.abc import Iterable, Mapping
from functools import lru_cache
from typing import Any

import numpy as np

from src.sim import noise
from src.sim.turbulence.contract import check_option
from src.sim.turbulence.prior import (
    SEVERITY_SHARES,
    TILT_AND_BLUR_PX,
    NoCameraError,
    draw_atmosphere_once,
)

TRIALS, LEAST_SHARE = 64, 0.2  # of clips that are not of global tilt
HALF_LENGTHS_PX = np.geomspace(0.1, 1000, 25)  # that are tried to say which can be met
TRIALS_PER_LENGTH = 5
HALF_LENGTH, SPREADS = "tilt_correlation_half_length_px", "tilt_and_blur_px"


def check_reachable_ranges(settings: Mapping[str, Any]) -> None:
    """Raise ValueError where cameras show less than LEAST_SHARE of what `draw_atmosphere_once`
    draws with `settings` for clips without global tilt: other clips, of global tilt, would stand in
    for them.

    `settings`: as of `sample_atmosphere`.  The draws are always the same ones.
    """
    severity, least = str(settings.get("severity")), LEAST_SHARE * TRIALS
    drawn = tuple(SEVERITY_SHARES) if severity == "mixed" else (severity,)
    if not set(drawn) <= set(TILT_AND_BLUR_PX) or settings.get("global_tilt_probability") == 1:
        return  # no turbulence or a wrong word, or none but global tilt
    for one in drawn:
        local = {**settings, "severity": one, "global_tilt_probability": 0.0}
        if (met := _count_reachable(local, TRIALS, least)) >= least:
            continue
        spreads = (TILT_AND_BLUR_PX | dict(settings.get(SPREADS) or {}))[one]
        shown = [
            length
            for length in HALF_LENGTHS_PX.tolist()
            if _count_reachable({**local, HALF_LENGTH: (length, length)}, TRIALS_PER_LENGTH, 1)
        ]
        asked = f"tilt_and_blur_px.{one}={list(spreads)}"
        allowed = f"ranges within which cameras show {asked}"
        check_option(bool(shown), "atmosphere", allowed, "ranges within which none does")
        given = f"{settings.get(HALF_LENGTH, 'its default')}, of which they show {met} of {TRIALS}"
        allowed = f"within {min(shown):.2g} to {max(shown):.4g} for {asked} and these cameras"
        check_option(False, f"atmosphere.{HALF_LENGTH}", allowed, given)


def _count_reachable(settings: Mapping[str, Any], trials: int, enough: float) -> int:
    """Return how many of `trials` draws a camera shows, or that `enough` are."""
    return _count_reachable_once(_freeze(settings), trials, enough)


@lru_cache(maxsize=1024)  # training, validation and test of a run ask the same
def _count_reachable_once(settings: tuple, trials: int, enough: float) -> int:
    generator, met = noise.generator(noise.key("trial of a prior")), 0
    given = {name: value for name, value in settings if name != SPREADS}
    spreads = dict(dict(settings).get(SPREADS) or {})
    for _ in range(trials):
        try:
            draw_atmosphere_once(generator=generator, tilt_and_blur_px=spreads, **given)
            met += 1
        except NoCameraError:
            continue
        if met >= enough:
            break
    return met


def _freeze(value: Any) -> Any:
    """Return a value that can be hashed: mappings as pairs, what else has parts as a tuple."""
    if isinstance(value, Mapping):
        return tuple((name, _freeze(part)) for name, part in value.items())
    if isinstance(value, Iterable) and not isinstance(value, str):
        return tuple(map(_freeze, value))
    return value
