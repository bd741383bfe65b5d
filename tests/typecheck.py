"""The run-time checker of annotations in tests: beartype, with an int accepted as a float.

Of each function the first CALLS calls in a test are checked: inner loops of solvers call theirs
some 10,000 times, and the checks would take twice as long as the work.
"""

import sys
from collections import Counter
from collections.abc import Callable
from functools import wraps
from inspect import getattr_static
from types import FunctionType

from beartype import BeartypeConf, beartype

CALLS = 200
_beartype = beartype(conf=BeartypeConf(is_pep484_tower=True))
_calls: Counter[Callable] = Counter()
_left_alone: list[FunctionType] = []


def check(annotated: Callable) -> Callable:
    """Return what jaxtyping calls before and after each call of a function, to check it."""
    checked = _beartype(annotated)
    if not isinstance(annotated, FunctionType):
        return checked

    @wraps(checked)
    def counted(*args, **kwargs):
        _calls[counted] += 1
        if _calls[counted] == CALLS:
            _leave_alone(annotated)
        return checked(*args, **kwargs)

    return counted


def check_all_again() -> None:
    """Count anew: a test begins."""
    _calls.clear()
    while _left_alone:
        del _left_alone.pop().__no_type_check__


def _leave_alone(annotated: FunctionType) -> None:
    """Mark the function that `annotated` stands for, if its module or class has it by name."""
    found = sys.modules.get(annotated.__module__)
    for name in annotated.__qualname__.split("."):
        found = getattr_static(found, name, None)
    found = getattr(found, "fget", None) or getattr(found, "__func__", found)
    if isinstance(found, FunctionType) and found not in _left_alone:
        found.__no_type_check__ = True  # jaxtyping then calls it as it is
        _left_alone.append(found)
