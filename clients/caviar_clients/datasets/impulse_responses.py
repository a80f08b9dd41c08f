"""Impulse responses between antenna elements: the paths of each user, with the phases of both arrays."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import DTypeLike, NDArray

from caviar_protocol.arrays import Complex128Array, Float64Array
from caviar_protocol.errors import RecordingError
from caviar_protocol.space.antenna_arrays import steering_vector
from caviar_protocol.space.coordinates import rotation_matrix, unit_vectors
from caviar_protocol.space.scene import device_pose
from caviar_protocol.topics.channel import PLANE_WAVES
from caviar_protocol.topics.scene import AntennaArray, AntennaDevice

if TYPE_CHECKING:
    from caviar_clients.datasets.reader import Dataset
    from caviar_clients.datasets.user_rows import Users


class ImpulseResponses:
    """Impulse responses of users, as the ``cir_generator`` of Sionna's ``CIRDataset`` gives them.

    Calling it yields for each user, in their order, ``(a, tau)``:

    - ``a``, complex, Shape ``[1, Nr, 1, Nt, P, S]``: gain of each path between elements, with the phase of
      the carrier, in each time step: H(Δf, Δt) = Σ a·exp(−j2πΔf·τ) is ``channel.hf`` but for the Doppler
      shift of Δf, ν·Δf/f;
    - ``tau``, float, Shape ``[1, 1, P]``: delay [s].

    Paths that a user lacks are zeros: P is the same for all users, as that of the one that has most.

    Args:
        users: Of one shape of arrays, with ``channel`` and ``scene`` recorded.
        time_steps: S.
        sampling_frequency: [Hz] of the time steps, the first of which is the scene's instant.
        paths: P; None: as many as the user with most has.

    Raises:
        RecordingError: Arrays differ between users, see spherical waves, or have several polarizations or
            panels, whose paths have amplitudes of their own that are not recorded.

    Example:
        >>> import caviar
        >>> cir = caviar.dataset("data/s008").cir()  # doctest: +SKIP
        >>> cir.shape  # doctest: +SKIP
        {'num_rx': 1, 'num_rx_ant': 8, 'num_tx': 1, 'num_tx_ant': 64, 'num_paths': 43, 'num_time_steps': 1}
    """

    def __init__(
        self, users: Users, time_steps: int = 1, sampling_frequency: float = 1.0, paths: int | None = None
    ) -> None:
        if time_steps < 1 or sampling_frequency <= 0.0:
            raise ValueError(
                f"time_steps {time_steps}, sampling_frequency {sampling_frequency}: both above 0"
            )
        scenes = users.dataset.table("scenes")
        for episode, scene, rung in zip(scenes["episode"], scenes["scene"], scenes["rung"], strict=True):
            if rung and rung not in PLANE_WAVES:
                raise RecordingError(
                    f"{users.dataset.location}, episode {episode}, scene {scene}: the channel is {rung}, in "
                    "which each pair of elements has paths of its own; use channel.hf or channel.h"
                )
        self._users = users
        self._times = np.arange(time_steps) / sampling_frequency
        transmit, receive = (only_array(users, end) for end in ("tx", "rx"))
        self.shape: Mapping[str, int] = {
            "num_rx": 1,
            "num_rx_ant": receive.size,
            "num_tx": 1,
            "num_tx_ant": transmit.size,
            "num_paths": int(users["paths"].max(initial=0)) if paths is None else paths,
            "num_time_steps": time_steps,
        }
        """Sizes of ``a``, by the names of the arguments of ``CIRDataset``."""

    def __len__(self) -> int:
        """Number of users."""
        return len(self._users)

    def __call__(self) -> Iterator[tuple[Complex128Array, Float64Array]]:
        for part in self._users.parts(256):
            a, tau = self.block(part)
            yield from zip(a[:, None, :, None], tau[:, None, None], strict=True)

    def block(self, users: Users, dtype: DTypeLike = np.complex128) -> tuple[NDArray[Any], Float64Array]:
        """Compute the responses of some of the users.

        Args:
            users: Of those that this was made of.
            dtype: Of ``a``; ``complex64`` takes a third of the time.

        Returns:
            ``a``, Shape ``[N, Nr, Nt, P, S]``, and ``tau`` [s], Shape ``[N, P]``.

        Raises:
            RecordingError: The channel was not recorded.
        """
        names = [f"channel.{name}" for name in ("a", "tau", "aod", "aoa", "doppler")]
        read = users.read(names, beside=antennas_of)

        def column(name: str) -> NDArray[Any]:
            values = np.nan_to_num(read[f"channel.{name}"])
            missing = self.shape["num_paths"] - values.shape[1]
            return np.pad(values, [(0, 0), (0, missing)] + [(0, 0)] * (values.ndim - 2))

        # Paths last in memory, along which the product is vectorised: a third of the time of an einsum.
        receive, transmit = (
            np.ascontiguousarray(np.swapaxes(phases, 1, 2), dtype)
            for phases in (
                column("a")[..., None] * self._responses(users, "rx", column("aoa")),
                self._responses(users, "tx", column("aod")),
            )
        )
        a = (receive[:, :, None] * transmit[:, None])[..., None]
        if self._times.any():
            shifts = np.exp(2j * np.pi * column("doppler")[..., None] * self._times)
            a = a * shifts.astype(dtype)[:, None, None]
        return a, column("tau")

    def _responses(self, users: Users, end: str, angles: Float64Array) -> Complex128Array:
        """Phases of the elements of one end, Shape ``[N, P, elements]``, by angles in world axes."""
        placed = [*placed_antennas(users, end)]
        turns = np.stack([rotation_matrix(antenna.orientation.tolist()) for antenna in placed])
        local = np.einsum("uji,upj->upi", turns, unit_vectors(angles))
        return steering_vector(placed[0].array, local)


class PlacedAntenna(NamedTuple):
    """Antenna of a user where it is in its scene."""

    array: AntennaArray
    position: Float64Array
    """In world axes [m], Shape ``[3]``."""
    orientation: Float64Array
    """(w, x, y, z), device into world, Shape ``[4]``."""
    power_dbm: float


def placed_antennas(users: Users, end: str) -> Iterator[PlacedAntenna]:
    """Find the antenna of each user at one end, in the order of the users.

    Args:
        users: With topic ``scene`` recorded.
        end: ``tx`` or ``rx``.

    Raises:
        RecordingError: There is no scene.
    """
    columns = (users["episode"].tolist(), users["scene"].tolist(), users[end].tolist())
    for episode, scene, name in zip(*columns, strict=True):
        yield antennas_of(users.dataset, episode, scene)[name]


# Both ends of a user are asked for in turn, by parts of fewer scenes.
@lru_cache(maxsize=256)
def antennas_of(dataset: Dataset, episode: int, scene: int) -> dict[str, PlacedAntenna]:
    """Antennas of a scene by name; beside `Users.read` it costs neither an opened file nor a decompression.

    Args:
        dataset: Of the scene.
        episode: Its episode.
        scene: Number in it.

    Raises:
        RecordingError: There is no scene.
    """
    recording = dataset.episode(episode)
    payload = recording["scene"][recording.place(episode, scene)]
    if payload is None:
        raise RecordingError(f"{recording.path}, scene {scene}: scene is absent")
    found = {}
    for device in payload.devices:
        if isinstance(device, AntennaDevice):
            pose = device_pose(payload, device)
            place = np.array(pose.position), np.array(pose.orientation)
            found[device.name] = PlacedAntenna(device.array, *place, device.power_dbm)
    return found


def only_array(users: Users, end: str) -> AntennaArray:
    """Find the array that all users have at one end, whose elements differ by their places alone.

    One user of each kind is looked at.

    Args:
        users: With topic ``scene`` recorded.
        end: ``tx`` or ``rx``.

    Raises:
        RecordingError: Arrays differ, or have several polarizations or panels, for which paths are not
            recorded.
    """
    place, arrays = users.dataset.location, {a.array for a in placed_antennas(users.one_of_each_kind(), end)}
    if not arrays:
        raise RecordingError(f"{place} has no such users with a path")
    if len(arrays) > 1:
        raise RecordingError(
            f"{place}: {len(arrays)} different arrays at {end}; take users of one, as "
            f"users[users[{end!r}] == NAME], or with {'--tx' if end == 'tx' else '--object-class'}"
        )
    (array,) = arrays
    if not array.is_uniform:
        raise RecordingError(
            f"{place}: the arrays at {end} have several polarizations or panels, for which paths are not "
            "recorded; use channel.hf or channel.h"
        )
    return array
