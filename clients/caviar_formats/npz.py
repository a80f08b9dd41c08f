"""Formats of NumPy archives: ``npz``, all of each user, and ``sionna``, impulse responses for Sionna PHY."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from caviar_clients.datasets.rows import USER_COLUMNS
from caviar_clients.datasets.user_rows import Users
from caviar_formats.base import Format, Part, markdown_table

LOSES = """Objects, scenes and actions, which have no row for each user; the scenery stands in the `assets`
folder of the dataset. Sensors of which a user has none or several, as three cameras beside the road."""


class Npz(Format):
    """Archives ``users-NNNNN.npz`` of some scenes each, with a row a user."""

    loses = LOSES

    def begin(self, users: Users) -> None:
        self._names = users.readable()

    def write(self, part: Part, folder: Path) -> None:
        if not len(part.users):  # which --tx and the like narrow
            return
        columns = part.users.read([*USER_COLUMNS, *self._names])
        np.savez(folder / f"users-{part.number:05d}.npz", allow_pickle=False, **columns)

    def readme(self, users: Users) -> str:
        about = USER_COLUMNS | self._names
        rows = markdown_table(("array", "what it is [unit], type, shape of a row"), about.items())
        return f"""# {users.dataset.name} as NumPy archives

`users-NNNNN.npz` hold a row for each user: a receiver in a scene, on a carrier, for a transmitter.

```python
import numpy as np

with np.load("users-00000.npz") as users:
    a = users["channel.a"]  # Shape [users, paths]
```

Where a row has fewer values than the longest of its file, NaN follows, or −1 for integers, 0 for unsigned
ones, false for booleans. Angles are (zenith from +z, azimuth from +x) in world axes, x to the east, y to the
north, z upwards. `channel.a` has the phase of the carrier.

{rows}
"""


class Sionna(Format):
    """Archives ``cir-NNNNN.npz`` with ``a`` and ``tau`` of the users with a path."""

    needs = ("channel.a", "channel.tau", "channel.aod", "channel.aoa", "channel.doppler")
    loses = "Users without a path, sensors, positions, links and objects; instants between scenes."

    def begin(self, users: Users) -> None:
        self._cir = users[users["valid"]].cir()

    def write(self, part: Part, folder: Path) -> None:
        valid = part.users[part.users["valid"]]
        if not len(valid):
            return
        a, tau = self._cir.block(valid, np.complex64)
        columns = valid.read(["episode", "scene", "carrier", "tx", "rx"])
        np.savez(
            folder / f"cir-{part.number:05d}.npz",
            allow_pickle=False,
            a=a[:, None, :, None],
            tau=tau[:, None, None],
            **columns,
        )

    def readme(self, users: Users) -> str:
        sizes = "\n".join(f"    {name}={size}," for name, size in self._cir.shape.items())
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
