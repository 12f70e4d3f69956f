"""WeatherSampler: the order of an epoch, on one machine or several, and its middle."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch.utils.data import DataLoader, Sampler

from weather_aug._keys import check_seed
from weather_aug.errors import ArgumentError
from weather_aug.transforms.dataset import WeatherDataset
from weather_aug.transforms.permutation import permutation
from weather_aug.transforms.resume import STATE_VERSION, checked_state, fingerprint_of


class WeatherSampler(Sampler[int]):
    """Items of a WeatherDataset in an order that (seed, epoch) alone decides.

    Convention:
        The epoch is the data set's: `set_epoch` sets both. Of several ranks each gets every
        `ranks`-th item, and equally many; where the items do not suffice, the first ones of the
        order are repeated (`padding`).

        A training stops anywhere and goes on with the next sample: save `state_dict()` with the
        network, and load it into a sampler that is made in the same way. Workers run ahead of the
        training, so only the training loop knows which samples it has used: loop over
        `follow(loader)`, which counts batches as it hands them out, or say the number yourself.
        After `load_state_dict` the rest of that epoch is drawn, however often, until another epoch
        is set; setting the same epoch again keeps its start.

    Args:
        dataset: Whose items.
        shuffle: Whether in a random order.
        seed: Of the order; the data set's if None.
        rank: Of this process, in 0..ranks - 1.
        ranks: How many processes share an epoch.

    Raises:
        ArgumentError: If an argument is none of its kind.

    Example:
        >>> sampler = WeatherSampler(dataset)  # doctest: +SKIP
        >>> loader = DataLoader(dataset, batch_size=4, sampler=sampler)  # doctest: +SKIP
        >>> for epoch in range(sampler.epoch, 10):  # doctest: +SKIP
        ...     sampler.set_epoch(epoch)
        ...     for batch in sampler.follow(loader):
        ...         step(batch)
        ...         torch.save({"sampler": sampler.state_dict(), ...}, path)
    """

    def __init__(
        self,
        dataset: WeatherDataset,
        *,
        shuffle: bool = True,
        seed: int | None = None,
        rank: int = 0,
        ranks: int = 1,
    ) -> None:
        if not isinstance(dataset, WeatherDataset):
            raise ArgumentError(f"dataset must be a WeatherDataset, got {type(dataset).__name__}")
        self.dataset = dataset
        self.shuffle = bool(shuffle)
        self.seed = dataset.seed if seed is None else check_seed("seed", seed)
        self.ranks = check_seed("ranks", ranks)
        self.rank = check_seed("rank", rank)
        if not 0 <= self.rank < self.ranks:
            raise ArgumentError(f"rank must be in 0..ranks - 1, got {rank} of {ranks}")
        self._start = 0
        self._start_epoch = dataset.epoch
        self._followed = (-1, 0)
        self._iterated_epoch = -1

    @property
    def epoch(self) -> int:
        """The data set's epoch."""
        return self.dataset.epoch

    def set_epoch(self, epoch: int) -> None:
        """Go to an epoch, of the data set as well; from its beginning, if it is another one.

        Raises:
            ArgumentError: If `epoch` is not an integer in [0, 2**63).
        """
        self.dataset.set_epoch(epoch)

    @property
    def start(self) -> int:
        """How many items of this epoch all ranks together had used when it was taken up."""
        return self._start if self._start_epoch == self.epoch else 0

    @property
    def padding(self) -> tuple[int, ...]:
        """Items that this epoch repeats, so that all ranks have equally many."""
        return tuple(self._padded()[len(self.dataset) - self.start :].tolist())

    def __len__(self) -> int:
        """Samples of this rank that are left of this epoch."""
        return -(-(len(self.dataset) - self.start) // self.ranks)

    def __iter__(self) -> Iterator[int]:
        self._iterated_epoch = self.epoch
        yield from map(int, self._padded()[self.rank :: self.ranks])

    def follow(self, loader: DataLoader[Any]) -> Iterator[Any]:
        """The loader's batches; a batch counts as used as soon as it is handed out.

        Args:
            loader: With this sampler, and a batch size (or None: single samples).

        Raises:
            ArgumentError: If the loader has another sampler, or one of batches.
        """
        if loader.sampler is not self:
            raise ArgumentError("loader must have this sampler: DataLoader(..., sampler=sampler)")
        size = 1
        if loader.batch_sampler is not None:
            if loader.batch_size is None:
                raise ArgumentError(
                    "loader has a batch_sampler, whose batches cannot be counted; give state_dict "
                    "the number of samples used"
                )
            size = loader.batch_size
        return self._counted(loader, size)

    def _counted(self, loader: DataLoader[Any], size: int) -> Iterator[Any]:
        epoch, left, used = self.epoch, len(self), 0
        self._followed = (epoch, used)
        for batch in loader:
            used = min(used + size, left)
            self._followed = (epoch, used)
            yield batch

    def _counted_now(self) -> int:
        epoch, used = self._followed
        if epoch == self.epoch:
            return used
        if self._iterated_epoch == self.epoch:
            raise ArgumentError(
                "nobody counted the samples of this epoch: loop over sampler.follow(loader), or "
                "give done="
            )
        return 0

    def state_dict(self, done: int | None = None) -> dict[str, Any]:
        """Where the training stands, as JSON values of less than 4 KiB; the same on all ranks.

        Args:
            done: Samples that this rank has used since the loop over the loader began, at most
                `len(sampler)`: `min(steps * batch_size, len(sampler))`, of the steps of this loop.
                None takes what `follow` counted, 0 before the epoch's loop.

        Raises:
            ArgumentError: If there are not so many, or nobody counted.
        """
        number = self._counted_now() if done is None else check_seed("done", done)
        if not 0 <= number <= len(self):
            raise ArgumentError(
                f"done must be in 0..{len(self)}, the samples that this rank had left of the epoch "
                f"when its loop began, got {number}; the last batch may be smaller than others: "
                "min(steps * batch_size, len(sampler))"
            )
        used = min(self.start + number * self.ranks, len(self.dataset))
        return {
            "version": STATE_VERSION,
            "epoch": self.epoch,
            "used": used,
            "fingerprint": self._fingerprint(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on where a state was saved; the number of ranks may be another one.

        The items are dealt to the ranks anew, so that with another number none is left out or
        comes twice; with the same number each rank goes on with its own.

        Raises:
            ArgumentError: If it is no state of `state_dict`.
            ConflictError: If it is of another data set, policy or order; what differs is named.
        """
        state = checked_state(state, "sampler", self._fingerprint())
        used = check_seed("used of the state", state.get("used"))  # type: ignore[arg-type]
        if not 0 <= used <= len(self.dataset):
            raise ArgumentError(f"used of the state must be in 0..{len(self.dataset)}, got {used}")
        self.set_epoch(state["epoch"])
        self._start, self._start_epoch = used, self.epoch
        self._followed, self._iterated_epoch = (-1, 0), -1

    def _fingerprint(self) -> dict[str, str]:
        own = fingerprint_of({"order seed": self.seed, "shuffle": self.shuffle})
        return self.dataset.fingerprint() | own

    def _padded(self) -> NDArray[np.int64]:
        """What is left of the epoch for all ranks, in turn."""
        count = len(self.dataset)
        order = np.arange(count)
        if self.shuffle:
            order = permutation("epoch order", self.seed, self.epoch, count)
        missing = len(self) * self.ranks - (count - self.start)
        return np.concatenate([order[self.start :], np.resize(order, missing)])
