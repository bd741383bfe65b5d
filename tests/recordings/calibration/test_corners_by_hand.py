"""Corners given by hand are checked, and give a field of the model's aspect."""

import pytest

from src.recordings.calibration.view_alignment import read_corners, views_from_corners

CENTRE = "- {position: [0, 0], corners: [[100, 100], [200, 100], [200, 200], [100, 200]]}"
MIRRORED = "- {position: [0, 1], corners: [[340, 100], [240, 100], [240, 200], [340, 200]]}"
PLAIN = "- {position: [0, 1], corners: [[240, 100], [340, 100], [340, 200], [240, 200]]}"


def write(path, *lines):
    (path / "corners.yaml").write_text("\n".join(lines))
    return path / "corners.yaml"


@pytest.mark.parametrize(
    "line, message",
    [
        (CENTRE, r"view \(0, 0\) must be there once, got it twice"),
        (MIRRORED.replace("[0, 1]", '[0.9, "1"]'), r"two whole numbers.*, got \[0\.9, '1'\]"),
        (MIRRORED.replace("[0, 1]", "[0, true]"), r"two whole numbers.*, got \[0, True\]"),
        (MIRRORED.replace("[0, 1]", "[0, 1, 2]"), r"two whole numbers.*, got \[0, 1, 2\]"),
        (MIRRORED.replace("[240, 100], [240, 200]", "[240, 200], [240, 100]"), "convex"),
        (MIRRORED.replace("[240, 200]", "[320, 120]"), r"view \(0, 1\) must have .* convex"),
        (MIRRORED.replace("[240, 200]", "[240, .nan]"), r"view \(0, 1\) must have .* got .*nan"),
        (MIRRORED.replace(", [240, 200]", ""), r"view \(0, 1\) must have four corners"),
        (PLAIN, r"view \(0, 1\) must be mirrored in one axis with mirrors=true"),
        (
            MIRRORED.replace("[0, 1]", "[1, 1]"),
            r"\(1, 1\) must be mirrored in both axes or in none",
        ),
    ],
)
def test_what_is_wrong_with_a_view_is_said_in_one_line(tmp_path, line, message):
    path = write(tmp_path, CENTRE, line)
    with pytest.raises(ValueError, match=rf"^corners={path}: .*{message}"):
        read_corners(path)


def test_views_of_a_lens_array_are_not_mirrored(tmp_path):
    path = write(tmp_path, CENTRE, PLAIN)
    assert sorted(read_corners(path, are_mirrored=False)) == [(0, 0), (0, 1)]


@pytest.mark.parametrize(
    "model, field",
    [
        ((50, 200), (100, 137.5, 200, 162.5)),
        ((200, 100), (125, 100, 175, 200)),
        ((60, 60), (100, 100, 200, 200)),
    ],
)
def test_the_field_is_cut_to_the_aspect_of_the_model(tmp_path, model, field):
    corners = read_corners(write(tmp_path, CENTRE, MIRRORED))
    views = views_from_corners(corners, sensor=(300, 400), model=model)
    assert views.field == pytest.approx(field)
