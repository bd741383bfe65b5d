"""A bad batch is named and does not move the weights; a leap moves them no more than usual."""

import pytest

from src.training.guard import Guard, NotFinite


def test_a_leap_counts_no_more_than_the_median():
    guard = Guard(10.0, least=4)
    assert [guard.share(loss) for loss in (1.0, 2.0, 500.0, 3.0)] == [1.0] * 4
    assert guard.share(100.0) == pytest.approx(2.5 / 100)
    assert list(guard.losses)[-1] == 2.5, "a leap must not become usual"
    assert guard.share(24.0) == 1.0
    off = Guard(None, least=1)
    assert [off.share(loss) for loss in (1.0, 1e9)] == [1.0, 1.0]


def test_a_factor_that_would_always_act_is_refused():
    with pytest.raises(ValueError, match="spike must be > 1"):
        Guard(1.0)


def test_the_error_names_the_clips():
    error = NotFinite("loss is nan", 7, [{"clip": 14, "threshold": 0.2}, {"clip": 15}])
    assert error.clips == [14, 15]
    assert "step 7" in str(error) and "'threshold': 0.2" in str(error)
