"""The run-time checks of annotations in tests: beartype's, with an int accepted as a float, and
those of shapes of arrays in a context of jaxtyping's, in which an axis has one size.
"""

import inspect
import typing
from collections.abc import Callable
from dataclasses import is_dataclass
from functools import partial, wraps
from typing import Any

from beartype import BeartypeConf, beartype
from jaxtyping import AbstractArray, config
from jaxtyping import jaxtyped as check_shapes

CONTEXT = check_shapes("context")
check = beartype(conf=BeartypeConf(is_pep484_tower=True))


def check_annotations(checked: Any = None, *, typechecker: Callable) -> Any:
    """Decorate as jaxtyping.jaxtyped does; of functions, once they are called for the first time,
    each annotation is checked once a call, by `check`: jaxtyping does so three times."""
    if checked is None:
        return partial(check_annotations, typechecker=typechecker)
    if is_dataclass(checked) and not hasattr(checked.__init__, "__wrapped__"):
        checked.__init__ = check_annotations(checked.__init__, typechecker=typechecker)
        return checked
    if inspect.isfunction(checked) and not _is_generator(checked):
        return _check_unless_disabled(checked, typechecker)
    return check_shapes(checked, typechecker=typechecker)


def _check_unless_disabled(function: Callable, typechecker: Callable) -> Callable:
    checked: Callable | None = None

    @wraps(function)
    def call(*args: Any, **options: Any) -> Any:
        nonlocal checked
        if config.jaxtyping_disable:
            return function(*args, **options)
        checked = checked or _check_in_context(function, typechecker)
        return checked(*args, **options)

    return call


def _check_in_context(function: Callable, typechecker: Callable) -> Callable:
    """Check by `check`; shapes in a context of the call, in which an axis has one size."""
    hints = _read_hints(function)
    if hints is None:
        return check_shapes(function, typechecker=typechecker)
    checked = check(function)
    if not any(map(_is_shape, hints.values())):
        return checked

    def call(*args: Any, **options: Any) -> Any:
        with CONTEXT:
            return checked(*args, **options)

    return call


def _is_generator(function: Callable) -> bool:
    return inspect.isgeneratorfunction(function) or inspect.isasyncgenfunction(function)


def _read_hints(function: Callable) -> dict[str, Any] | None:
    """Return the annotations, None where one cannot be read yet."""
    try:
        return typing.get_type_hints(function)
    except NameError:
        return None


def _is_shape(hint: Any) -> bool:
    if inspect.isclass(hint) and issubclass(hint, AbstractArray):
        return True
    return any(map(_is_shape, typing.get_args(hint)))
