"""Annotations are checked in tests, with shapes and without."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import pytest
from beartype.roar import BeartypeCallHintViolation
from jaxtyping import Float, TypeCheckError, config

from tests.typecheck import check, check_annotations


@check_annotations(typechecker=check)
def scale(number: float, times: int = 2) -> float:
    return number * times if times else "nothing"


@check_annotations(typechecker=check)
def add(images: Sequence[Float[np.ndarray, "h w"]]) -> Float[np.ndarray, "h w"] | None:
    return sum(images) if len(images) > 1 else images[0][:1]


@check_annotations(typechecker=check)
def join(
    one: Float[np.ndarray, "h w"], other: Float[np.ndarray, "h w"], turned: bool = False
) -> Float[np.ndarray, "h w"]:  # fmt: skip
    return join(one.T, other.T) if turned else one + other


@check_annotations(typechecker=check)
def rows(image: Float[np.ndarray, "h w"]) -> Iterator[Float[np.ndarray, " w"]]:
    yield from image


@check_annotations(typechecker=check)
@dataclass
class Pair:
    high: Float[np.ndarray, "h w"]
    wide: Float[np.ndarray, "h w"]


def test_arguments_and_results_without_shapes_are_checked():
    assert scale(3) == 6  # an int is a float
    with pytest.raises(BeartypeCallHintViolation, match="number"):
        scale("3")
    with pytest.raises(BeartypeCallHintViolation, match="return"):
        scale(3.0, 0)


def test_checks_can_be_switched_off(monkeypatch):
    monkeypatch.setattr(config, "jaxtyping_disable", True)
    assert scale("3") == "33"


def test_shapes_within_other_annotations_are_checked():
    square = np.zeros((2, 2))
    assert add([square, square]).shape == (2, 2)
    with pytest.raises(BeartypeCallHintViolation, match="parameter images"):
        add([square[0]])
    with pytest.raises(BeartypeCallHintViolation, match="return"):
        add([square])


def test_an_axis_has_one_size_in_a_call_and_its_own_in_each():
    wide, high = np.zeros((2, 3)), np.zeros((3, 2))
    with pytest.raises(BeartypeCallHintViolation, match="parameter other"):
        join(wide, high)
    with pytest.raises(BeartypeCallHintViolation, match="return"):
        join(wide, wide, turned=True)  # the turned ones have sizes of their own
    assert join(wide, wide).shape == (2, 3)
    with pytest.raises(BeartypeCallHintViolation, match="parameter wide"):
        Pair(wide, high)
    assert Pair(wide, wide).wide is wide


def test_a_generator_is_checked():
    with pytest.raises(TypeCheckError, match="parameters"):
        rows(np.zeros(2))
    assert len(list(rows(np.zeros((2, 3))))) == 2


def test_the_packages_are_checked():
    from src.recordings.event_windows import WindowRule
    from src.sim.optics import layout
    from src.sim.voxel import voxel_grid

    with pytest.raises(BeartypeCallHintViolation):
        WindowRule(fps="120")
    with pytest.raises(BeartypeCallHintViolation):
        layout("9")
    with pytest.raises(BeartypeCallHintViolation):
        voxel_grid([0], [0], [0], [1], t0="0", t1=1, bins=5, height=8, width=8)
