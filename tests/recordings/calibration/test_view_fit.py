"""Views are fitted to places that another view shows."""

import numpy as np
import pytest

from src.recordings import corner_fold
from src.recordings.calibration import view_fit
from src.recordings.calibration.scene_matches import ViewMatches
from src.recordings.corner_fold import CornerFold
from src.recordings.views import View


@pytest.mark.parametrize(("angle", "fitted"), [(0.08, 0.08), (0.2, 0.1)])
def test_halves_that_are_turned_beyond_the_limit_are_fitted_at_the_limit(
    angle, fitted, monkeypatch
):
    corner, towards, tile = (0.0, 0.0), (50.0, 50.0), (0.0, 0.0, 120.0, 120.0)
    at = np.stack(np.meshgrid(*[np.linspace(10, 110, 9)] * 2), -1).reshape(-1, 2)
    places = View((1, 1), np.eye(3), fold=CornerFold(corner, towards, angle)).to_centre(at)
    match = ViewMatches(places, at, np.zeros_like(at), 5.0)
    for module in (corner_fold, view_fit):
        monkeypatch.setattr(module, "MAX_ANGLE_RAD", 0.1)
    view, _ = view_fit._fit((1, 1), match, tile, CornerFold(corner, towards))
    assert view.fold.angle_rad == pytest.approx(fitted, abs=0.01)
