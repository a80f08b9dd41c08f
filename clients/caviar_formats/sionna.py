"""Format ``sionna``: impulse responses for the ``CIRDataset`` of Sionna PHY, as NumPy archives."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from caviar_clients.datasets.user_rows import Users
from caviar_formats.base import Format


class Sionna(Format):
    """Archives ``cir-NNNNN.npz`` with ``a`` and ``tau`` of the users with a path."""

    loses = "Users without a path, sensors, positions, links and objects; instants between scenes."

    def begin(self, users: Users) -> None:
        self._shape = users[users["valid"]].cir().shape

    def write(self, users: Users, folder: Path, number: int) -> None:
        valid = users[users["valid"]]
        a, tau = valid.cir(paths=self._shape["num_paths"]).block(valid)
        columns = valid.read(["episode", "scene", "carrier", "tx", "rx"])
        a = a[:, None, :, None].astype(np.complex64)
        np.savez(folder / f"cir-{number:05d}.npz", a=a, tau=tau[:, None, None], **columns)

    def readme(self, users: Users) -> str:
        sizes = "\n".join(f"    {name}={size}," for name, size in self._shape.items())
        return f"""# {users.dataset.name} as impulse responses for Sionna PHY

`cir-NNNNN.npz` hold a row for each user with a path: a receiver in a scene, on a carrier, for a transmitter.

- `a`, complex64, shape `[users, num_rx, num_rx_ant, num_tx, num_tx_ant, num_paths, num_time_steps]`: gain of
  each path from element to element, with the phase of the carrier.
- `tau`, float64, shape `[users, num_rx, num_tx, num_paths]`: delay of each path [s], not normalised.
- `episode`, `scene`, `carrier`, `tx`, `rx`: the user.

Paths that a user lacks have `a` = 0 and `tau` = 0. Elements of an array are numbered column by column from
−y to +y, in a column from +z to −z, as in Sionna RT.

```python
from pathlib import Path

import numpy as np
from sionna.phy.channel import CIRDataset


def responses():
    for file in sorted(Path().glob("cir-*.npz")):
        with np.load(file) as users:
            yield from zip(users["a"], users["tau"].astype(np.float32))


channel = CIRDataset(
    responses,
    batch_size=64,
{sizes}
)
```
"""
