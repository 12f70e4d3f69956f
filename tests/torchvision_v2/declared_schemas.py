"""Lets PyPI's torchvision import beside a CPU build of torch, for the tests alone.

Its compiled library is of CUDA and does not load there, so that nobody declares the two operators
whose shape functions it registers. Where the library does load, a second declaration ends the
process: the import is tried in another process first. A plugin of pytest (`-p`), or imported.
"""

import subprocess
import sys

import torch


def loads() -> bool:
    """Whether torchvision imports by itself, tried in another process."""
    tried = subprocess.run(
        [sys.executable, "-c", "import torchvision"], capture_output=True, timeout=120, check=False
    )
    return tried.returncode == 0


declared = None
if torch.version.cuda is None and not loads():
    # Kept by this name: the declaration ends with the object.
    declared = torch.library.Library("torchvision", "DEF")
    declared.define("nms(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
    declared.define("qnms(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
