"""What a stress test returns: a value with its limit; results of all tests, table and summary."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from src.bench.candidates import Candidate
from src.bench.stress_tests.event_clips import Curve, StressBench
from src.records.results import format_csv


@dataclass(frozen=True)
class StressResult:
    """A `value` in `unit` that must not exceed `limit` (`higher_is_better`: not fall below it).

    `curve`: how it went with the `varied` setting, from easy to hard; `unjudged`: values of other
    settings, such as a reference, that are not held to the limit.
    """

    value: float
    unit: str
    limit: float
    curve: Curve = field(default_factory=list)
    varied: str = ""
    higher_is_better: bool = False
    unjudged: Curve = field(default_factory=list)

    def violates_limit(self, value: float) -> bool:
        """Return whether `value` is beyond the limit; NaN is."""
        return not (value >= self.limit if self.higher_is_better else value <= self.limit)

    @property
    def failed(self) -> bool:
        return self.violates_limit(self.value)

    @property
    def failing_settings(self) -> list[Any]:
        """The settings of the curve whose values are beyond the limit."""
        return [name for name, value in self.curve if self.violates_limit(value)]


StressTest = Callable[[Candidate, StressBench], StressResult]


def build_worst_psnr_loss_result(curve: Curve, *, limit_db: float, varied: str) -> StressResult:
    """Return the result whose value is the largest of the curve, in dB."""
    return StressResult(largest_value(curve), "dB", limit_db, curve, varied)


def largest_value(curve: Curve) -> float:
    """Return the largest value of a curve; NaN where one is."""
    return float(np.max([value for _, value in curve]))


Outcome = StressResult | str  # or why there is none
Outcomes = dict[str, dict[str, Outcome]]  # test -> network -> outcome
CSV_COLUMNS = (
    "network", "test", "title", "varied", "setting", "value", "unit", "limit", "failed", "reason",
)  # fmt: skip


def run_stress_tests(
    candidate: Candidate, tests: Mapping[str, StressTest], bench: StressBench
) -> tuple[dict[str, Outcome], float | None]:
    """Return the outcome of every test, the reason where one cannot run, and the aligned PSNR in dB
    on the standard clips (None: the network does not run).
    """
    if candidate.network is None or not candidate.trained:
        reason = candidate.missing_reason
        reason = reason if candidate.network is None else f"it has no weights: {reason}"
        return dict.fromkeys(tests, reason), None
    outcomes: dict[str, Outcome] = {}
    for name, test in tests.items():
        try:
            if candidate.postprocessor is not None:
                raise ValueError("a post-processor needs the whole video")
            outcomes[name] = test(candidate, bench)
        except ValueError as error:
            outcomes[name] = str(error)
    return outcomes, bench.mean_aligned_psnr(candidate)


def format_outcomes_csv(outcomes: Outcomes, titles: Mapping[str, str]) -> str:
    """Return CSV: one line for the value of each outcome, each point of its curve and each value
    that is not judged, of which `failed` is empty."""
    lines: list[list[object]] = []
    for test, row in outcomes.items():
        for network, outcome in row.items():
            head: list[object] = [network, test, titles[test]]
            if isinstance(outcome, str):
                lines.append([*head, "", "", "", "", "", "", outcome])
                continue
            points = [("", "", outcome.value)]
            points += [(outcome.varied, setting, value) for setting, value in outcome.curve]
            for varied, setting, value in points:
                judged = [outcome.limit, outcome.violates_limit(value)]
                lines.append([*head, varied, setting, f"{value:.6g}", outcome.unit, *judged, ""])
            for setting, value in outcome.unjudged:
                unit = outcome.unit
                lines.append([*head, outcome.varied, setting, f"{value:.6g}", unit, "", "", ""])
    return format_csv(CSV_COLUMNS, lines)


def format_summary_per_network(
    outcomes: Outcomes, titles: Mapping[str, str], standard_psnr: Mapping[str, float]
) -> str:
    """Return Markdown: for each network the tests it fails and passes."""
    parts = ["# Stress tests\n"]
    for network in next(iter(outcomes.values()), {}):
        own = {titles[test]: row[network] for test, row in outcomes.items()}
        psnr = standard_psnr.get(network)
        standard = "" if psnr is None else f"On the standard clips: aligned PSNR {psnr:.2f} dB. "
        parts.append(f"## {network}\n\n{standard}{_summarize_network(own)}\n")
    return "\n".join(parts)


def _summarize_network(outcomes: Mapping[str, Outcome]) -> str:
    failed, passed, reasons = [], [], dict[str, list[str]]()
    for title, outcome in outcomes.items():
        if isinstance(outcome, str):
            reasons.setdefault(outcome, []).append(title)
        elif outcome.failed:
            failed.append(f"- {title}: {_describe_failure(outcome)}")
        else:
            passed.append(f"{title} ({_format_with_unit(outcome)})")
    ran = len(failed) + len(passed)
    lines = [f"Fails {len(failed)} of the {ran} tests that ran.", *failed] if ran else []
    lines += ["", "Passes: " + "; ".join(passed) + "."] if passed else []
    lines += [f"\nNot run, because {why}: {'; '.join(t)}." for why, t in reasons.items()]
    return "\n".join(lines)


def _describe_failure(result: StressResult) -> str:
    side = "at least" if result.higher_is_better else "at most"
    text = f"{_format_with_unit(result)}, limit {side} {result.limit:g}"
    where = ", ".join(map(str, result.failing_settings))
    return f"{text}; fails at {result.varied} = {where}" if where else text


def _format_with_unit(result: StressResult) -> str:
    return f"{format_value(result.value, result.limit)} {result.unit}".rstrip()


def format_value(value: float, limit: float) -> str:
    """Return `value` to two digits or so, and more where it would read as the `limit`, beside which
    it stands, or as on the other side of it."""
    if not math.isfinite(value):
        return "∞" if value > 0 else "–"
    if value in (0, limit):
        return _format_digits(value, 0)
    texts = (_format_digits(value, more) for more in range(20))
    side = np.sign(value - limit)
    return next((text for text in texts if np.sign(float(text) - limit) == side), f"{value:g}")


def _format_digits(value: float, more: int) -> str:
    """Return a finite `value` to two digits or so, and so many more."""
    if value == 0:
        return "0"
    if abs(value) < 0.0095:
        return f"{value:.{more}e}".replace("e-0", "e-")
    digits = 0 if abs(value) >= 20 else 1 if abs(value) >= 1 else 2
    return f"{value:.{digits + more}f}"
