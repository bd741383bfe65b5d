"""Which of several networks are worth having: the front of cost and error, and its knee."""

import math
import statistics
from collections.abc import Hashable, Mapping, Sequence


def front(points: Mapping[Hashable, tuple[float, float]]) -> list:
    """Return the names, cheapest first, of the (cost, error) that none beats in both."""
    names, least = [], math.inf
    for name, (_, error) in sorted(points.items(), key=lambda item: item[1]):
        if error < least:
            names.append(name)
            least = error
    return names


def knee(costs: Mapping[str, float], errors: Mapping[str, Sequence[float]]) -> str:
    """Return the cheapest network whose mean error over clips is within one standard error, that of
    the best network, of the best (the rule of Breiman et al. 1984).
    """
    means = {name: statistics.fmean(values) for name, values in errors.items()}
    best = min(means, key=means.get)
    within = means[best] + standard_error(errors[best])
    return min((name for name in means if means[name] <= within), key=costs.get)


def standard_error(values: Sequence[float]) -> float:
    """Return the standard error of the mean; 0 for a single value."""
    return statistics.stdev(values) / math.sqrt(len(values)) if len(values) > 1 else 0.0
