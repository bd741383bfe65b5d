"""The rooms and doors of the project."""

import os

# of a picture; OpenCV looks when it is imported, so before all else
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(2**27))
