"""Annotations are checked from the first call of each test on."""

import pytest
from jaxtyping import TypeCheckError

from src.sim.turbulence.zernike import noll_index
from tests import typecheck


def test_the_first_calls_of_a_test_are_checked():
    for _ in range(2):  # tests
        with pytest.raises(TypeCheckError):
            noll_index("4")
        for _ in range(typecheck.CALLS):
            noll_index(4)
        assert noll_index.__no_type_check__
        typecheck.check_all_again()
        assert not hasattr(noll_index, "__no_type_check__")
