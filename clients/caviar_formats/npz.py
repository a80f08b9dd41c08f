"""Format ``npz``: columns of the users and their recorded arrays, as NumPy archives."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from caviar_clients.datasets.rows import USER_COLUMNS
from caviar_clients.datasets.user_rows import Users
from caviar_formats.base import Format, markdown_table


class Npz(Format):
    """Archives ``users-NNNNN.npz`` of some episodes each, with a row a user."""

    loses = (
        "Products without a row for each user (scenes, actions) and objects; the scenery stands in the "
        "`assets` folder of the dataset."
    )

    def write(self, users: Users, folder: Path, number: int) -> None:
        columns = users.read([*USER_COLUMNS, *users.recorded()])
        np.savez(folder / f"users-{number:05d}.npz", **columns)

    def readme(self, users: Users) -> str:
        about = USER_COLUMNS | users.recorded()
        rows = markdown_table(("array", "what it is [unit], type, shape of a row"), about.items())
        return f"""# {users.dataset.name} as NumPy archives

`users-NNNNN.npz` hold a row for each user: a receiver in a scene, on a carrier, for a transmitter.

```python
import numpy as np

with np.load("users-00000.npz") as users:
    h = users["channel.h"]  # Shape [users, Nr, Nt]
```

Where a row has fewer values than the longest of its file, NaN follows, or −1 for integers, 0 for unsigned
ones, false for booleans. Angles are (zenith from +z, azimuth from +x) in world axes, x to the east, y to the
north, z upwards. `channel.a` has the phase of the carrier.

{rows}
"""
