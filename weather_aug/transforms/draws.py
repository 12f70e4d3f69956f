"""Keys of a transform's draws: by what the sample is, or where nobody says, by worker and call.

Host libraries keep a generator in each worker process, so that workers repeat each other, or one
number of workers gives other pictures than another. A key here has neither fault where the caller
names its samples: it is then a function of (seed, epoch, sample) alone. Without a name it is one of
(seed, epoch, worker's seed, number of the call, picture), which no two calls of a training share.
"""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import get_worker_info

from weather_aug._keys import check_seed, key_of
from weather_aug.errors import ArgumentError

_STRIDE = 8


class SharedEpoch:
    """A number that persistent workers see change: they hold a copy of everything else.

    Convention:
        In [0, 2**63). Pickled to a worker it stays shared; pickled to a file or deep-copied it is a
        copy with a life of its own.
    """

    def __init__(self, epoch: int = 0) -> None:
        self._cell = torch.zeros(1, dtype=torch.int64).share_memory_()
        self.value = epoch

    @property
    def value(self) -> int:
        """The epoch."""
        return int(self._cell)

    @value.setter
    def value(self, epoch: int) -> None:
        number = check_seed("epoch", epoch)
        if not 0 <= number < 2**63:
            raise ArgumentError(f"epoch must be in [0, 2**63), got {number}")
        self._cell[0] = number

    def __deepcopy__(self, memo: dict[int, Any]) -> SharedEpoch:
        return SharedEpoch(self.value)

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        # Already shared if a process of ours sent it, private if it was read from a file.
        self._cell = self._cell.share_memory_()


class Draws:
    """What a transform's next draw hangs on; no generator is read or moved.

    Args:
        domain: At most 16 bytes, so that two transforms of one seed differ.
        seed: In [-2**63, 2**64).
    """

    def __init__(self, domain: str, seed: int) -> None:
        self.domain = domain
        self.seed = check_seed("seed", seed)
        self._epoch = SharedEpoch()
        self._calls = 0

    @property
    def epoch(self) -> int:
        """The epoch whose weather is drawn."""
        return self._epoch.value

    def set_epoch(self, epoch: int) -> None:
        """Draw the weather of another epoch, in this process and in all workers."""
        self._epoch.value = epoch

    def key(self, picture: NDArray[Any], sample: Any = None) -> int:
        """The 128-bit key of one draw.

        Args:
            picture: What is weathered; it tells unnamed samples of processes apart that are no
                DataLoader workers.
            sample: What the caller calls the sample: an integer, a string, or a tuple of these;
                None if nothing.
        """
        if sample is not None:
            return key_of(self.domain, self.seed, self.epoch, 1, *sample_fields(sample))
        self._calls += 1
        fields = (worker_seed(), self._calls, picture_field(picture))
        return key_of(self.domain, self.seed, self.epoch, 0, *fields)


def sample_fields(sample: Any) -> tuple[int, ...]:
    """The name of a sample as integers for `key_of`; different names, different integers.

    Raises:
        ArgumentError: If it is no integer, string or tuple of these.
    """
    parts = sample if isinstance(sample, tuple | list) else (sample,)
    fields: list[int] = []
    for part in parts:
        if isinstance(part, str):
            digest = hashlib.blake2b(part.encode("utf-8", "surrogatepass"), digest_size=8).digest()
            fields += (1, int.from_bytes(digest, "little"))
        else:
            fields += (0, check_seed("sample_key", part))
    return tuple(fields)


def picture_field(picture: NDArray[Any]) -> int:
    """64 bits of a coarse grid of a picture's pixels.

    Raises:
        ArgumentError: If it is no array of (..., H, W, channels).
    """
    if not isinstance(picture, np.ndarray):
        raise ArgumentError(f"image must be a numpy array, got {type(picture).__name__}")
    if picture.ndim < 3:
        raise ArgumentError(f"image must have shape (H, W, 3), got {picture.shape}")
    coarse = np.ascontiguousarray(picture[..., ::_STRIDE, ::_STRIDE, :])
    return int.from_bytes(hashlib.blake2b(coarse.tobytes(), digest_size=8).digest(), "little")


def worker_seed() -> int:
    """Seed of this DataLoader worker, 0 outside one; it differs by worker and by iterator."""
    info = get_worker_info()
    return 0 if info is None else int(info.seed)
