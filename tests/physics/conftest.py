import numpy as np
import pytest

from weather_aug.render.light import Ambience


@pytest.fixture
def ambience():
    return Ambience(
        np.eye(3),
        sky=np.array([0.6, 0.65, 0.7]),
        middle=np.full(3, 0.2),
        ground=np.full(3, 0.12),
        airlight=np.array([0.55, 0.56, 0.57]),
    )
