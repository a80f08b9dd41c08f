"""Users of a dataset for PyTorch: by position, or as a stream of batches in a stated order.

Arrays become tensors; columns of texts stay lists. Imports PyTorch, which is part of the extra `learning`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from caviar_clients.datasets.user_rows import Columns, check_batches

try:
    from torch.utils.data import IterableDataset
except ImportError:  # `Users.torch_batches` says what is missing, before this module is needed
    IterableDataset = object

if TYPE_CHECKING:
    from caviar_clients.datasets.user_rows import Users


class UserSamples:
    """Users by position, for a ``DataLoader`` that draws its own order.

    A user's arrays are read when it is asked for: users of one scene are read together only where they follow
    each other. `UserBatches` is many times as quick where the order may be its own.

    Args:
        users: Which.
        names: Columns and recorded arrays of a sample, as of ``users[name]``.
    """

    def __init__(self, users: Users, names: Sequence[str]) -> None:
        self._users, self._names = users, tuple(names)

    def __len__(self) -> int:
        return len(self._users)

    def __getitem__(self, at: int) -> dict[str, Any]:
        if not isinstance(at, int | np.integer):
            raise TypeError(f"samples[{at!r}]: a position is a whole number; users are 0 to {len(self) - 1}")
        if not -len(self) <= at < len(self):
            raise IndexError(f"user {at} of {len(self)}")
        row = self._users[np.array([at])].read(self._names)
        return {name: value[0] for name, value in _tensors(row).items()}


class UserBatches(IterableDataset):  # type: ignore[misc]  # it has no types
    """Batches of users in an order that the seed gives, the same for any number of loading processes.

    Give it to ``DataLoader(batches, batch_size=None, num_workers=N)``: the processes take the batches in
    turns, and the loader delivers them in their order.

    Args:
        users: Which.
        names: Columns and recorded arrays, as of ``users[name]``.
        size: Users of a batch; the last one may have fewer.
        shuffle: Seed of the order; None: as they are (`Users.batches`).

    Raises:
        ValueError: A batch would have no user, or ``shuffle`` is no number.
    """

    def __init__(self, users: Users, names: Sequence[str], size: int, shuffle: int | None = None) -> None:
        check_batches(size, shuffle)
        self._users, self._names, self._size, self._seed = users, tuple(names), size, shuffle
        self.epoch = 0
        """Set it before each pass over the data: every epoch has an order of its own."""

    def __len__(self) -> int:
        """Number of batches."""
        return -(-len(self._users) // self._size)

    def __iter__(self) -> Iterator[dict[str, Any]]:
        from torch.utils.data import get_worker_info

        info = get_worker_info()
        first, step = (info.id, info.num_workers) if info is not None else (0, 1)
        # Not the sum: seeds 1 and 2 would share the orders of all epochs but one.
        seed = self._seed
        if seed is not None and self.epoch:
            seed = int(np.random.SeedSequence([seed, self.epoch]).generate_state(1, np.uint64)[0])
        for part in self._users.parts(self._size, shuffle=seed)[first::step]:
            yield _tensors(part.read(self._names))


def _tensors(columns: Columns) -> dict[str, Any]:
    import torch

    return {
        name: values.tolist() if values.dtype.kind == "U" else torch.from_numpy(_writable(values))
        for name, values in columns.items()
    }


def _writable(values: Any) -> Any:
    # PyTorch knows no unsigned integers of 64 bits, and warns of arrays that cannot be written.
    if values.dtype == np.uint64:
        return values.view(np.int64)
    return values if values.flags.writeable else values.copy()
