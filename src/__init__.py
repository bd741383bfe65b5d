"""Packages and entry points of the project."""

import os

# The largest picture that is read: OpenCV looks at this when it is imported, so before all else.
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(2**27))

# Before the names src.* and baselines.* of configs and weights: "lightfield_events." where this is
# installed in that package (setup.py), else nothing.
HOME = __name__.removesuffix("src")


def importable_name(name: str) -> str:
    """Return the name by which is imported what configs and weights call src.* or baselines.*."""
    return HOME + name if name.split(".")[0] in ("src", "baselines") else name
