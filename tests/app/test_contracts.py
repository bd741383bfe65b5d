"""Scene, turbulence, sensor and network satisfy their contracts; so must a class of one's own."""

import pytest

from baselines.highpass import HighPass
from src.app.instantiate import CONTRACTS, check_contract
from src.models.setnet import SetNet
from src.sim.sensor import EventSensor


@pytest.mark.parametrize(
    ("key", "built"),
    [
        ("sensor", EventSensor()),
        ("model", SetNet()),
        ("baseline", HighPass()),
        ("optics", object()),
    ],
)
def test_shipped_classes_satisfy_their_contract(key, built):
    assert check_contract(key, built) is built


@pytest.mark.parametrize("key", CONTRACTS)
def test_missing_members_are_named(key):
    members = {"scene": "clip", "turbulence": "draw", "sensor": "draw"}
    match = rf"{key}._target_ must be a .*builtins\.object.*{members.get(key, '')}"
    with pytest.raises(ValueError, match=match):
        check_contract(key, object())
