"""Which encoder makes an export's pictures; it is part of the job, since it decides the bytes."""

from __future__ import annotations

import cv2

from weather_aug import _png

ENCODER = f"opencv {cv2.__version__}, PNG level {_png.LEVEL}"
"""Another encoder gives equal pixels in other bytes."""
