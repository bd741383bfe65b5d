"""The run-time checks of annotations in tests: beartype's, with an int accepted as a float, and
around them jaxtyping's where there are shapes of arrays, which cost several times as much.
"""

import inspect
import typing
from collections.abc import Callable
from functools import partial, wraps
from typing import Any

from beartype import BeartypeConf, beartype
from jaxtyping import AbstractArray, config
from jaxtyping import jaxtyped as check_shapes

check = beartype(conf=BeartypeConf(is_pep484_tower=True))


def check_annotations(checked: Any = None, *, typechecker: Callable) -> Any:
    """Decorate as jaxtyping.jaxtyped does, but functions without shapes by `check` alone."""
    if checked is None:
        return partial(check_annotations, typechecker=typechecker)
    if inspect.isfunction(checked) and not _has_shapes(checked):
        return _check_unless_disabled(checked)
    return check_shapes(checked, typechecker=typechecker)


def _check_unless_disabled(function: Callable) -> Callable:
    checked = check(function)

    @wraps(function)
    def call(*args: Any, **options: Any) -> Any:
        return (function if config.jaxtyping_disable else checked)(*args, **options)

    return call


def _has_shapes(function: Callable) -> bool:
    """Return whether an annotation holds the shape of an array, or cannot be read yet."""
    try:
        hints = typing.get_type_hints(function)
    except NameError:
        return True
    return any(map(_is_shape, hints.values()))


def _is_shape(hint: Any) -> bool:
    if inspect.isclass(hint) and issubclass(hint, AbstractArray):
        return True
    return any(map(_is_shape, typing.get_args(hint)))
