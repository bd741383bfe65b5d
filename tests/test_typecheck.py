"""Annotations are checked in tests, with shapes and without."""

from collections.abc import Sequence

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
    with pytest.raises(TypeCheckError, match="parameters"):
        add([square[0]])
    with pytest.raises(TypeCheckError, match="return value"):
        add([square])


def test_the_packages_are_checked():
    from src.recordings.event_windows import WindowRule
    from src.sim.optics import layout
    from src.sim.voxel import voxel_grid

    with pytest.raises(TypeCheckError):
        WindowRule(fps="120")
    with pytest.raises(BeartypeCallHintViolation):
        layout("9")
    with pytest.raises(TypeCheckError):
        voxel_grid([0], [0], [0], [1], t0="0", t1=1, bins=5, height=8, width=8)
