"""Arrays of the topics ``channel``, ``link`` and ``action`` of a recording, and a class for each topic.

The second axis counts users (`User`). `caviar_protocol.recording.scene` has the topics with a row for each
object, device or sensor.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from pkgutil import resolve_name
from typing import Any, ClassVar, Generic, NamedTuple, Self, TypeVar

import msgspec
import numpy as np

from caviar_protocol.arrays import Float64Array, Payload
from caviar_protocol.errors import RecordingError
from caviar_protocol.recording.arrays import Column, Rows, TopicArrays, payload_column
from caviar_protocol.recording.scene import MotionArrays
from caviar_protocol.scenario.schema import DeviceSpec, is_made_by
from caviar_protocol.space.beams import beam_gains
from caviar_protocol.topics import TOPICS, Action, AntennaArray, BeamChoice, Carrier, Channel, Link

P = TypeVar("P", bound=Payload)


class User(NamedTuple):
    """A receiver that a transmitter serves on a carrier, all by name.

    Example:
        >>> from caviar_protocol.recording import Recording
        >>> recording = Recording("runs/smoke-20261122-101500")
        >>> recording["link"].users[0]
        User(tx='bs', rx='car/rx', carrier='mmwave')
    """

    tx: str
    rx: str
    carrier: str


class UserArrays(TopicArrays[P, User], Generic[P]):
    """A topic with a row for each user: carriers as the channel lists them, then TX, then RX by name."""

    axis: ClassVar[str] = "U"

    @property
    def users(self) -> tuple[User, ...]:
        """Users of axis U."""
        return self.keys

    @property
    def tx(self) -> tuple[str, ...]:
        """Transmitting device of each user."""
        return tuple(user.tx for user in self.keys)

    @property
    def rx(self) -> tuple[str, ...]:
        """Receiving device of each user."""
        return tuple(user.rx for user in self.keys)

    @property
    def carrier(self) -> tuple[str, ...]:
        """Carrier of each user."""
        return tuple(user.carrier for user in self.keys)

    def select(
        self,
        *,
        episode: int | None = None,
        frames: Iterable[int] | None = None,
        tx: str | Iterable[str] | None = None,
        rx: str | Iterable[str] | None = None,
        carrier: str | Iterable[str] | None = None,
    ) -> Self:
        """These frames and these users only; each argument that is left out allows all.

        Args:
            episode: Number of an episode.
            frames: Numbers of frames in their episodes.
            tx: Name of a transmitting device, or several.
            rx: Name of a receiving device, or several.
            carrier: Name of a carrier, or several.

        Raises:
            RecordingError: A frame, an episode or a name is not there; the text says what is.

        Example:
            >>> from caviar_protocol.recording import Recording
            >>> channel = Recording("runs/smoke-20261122-101500")["channel"]
            >>> channel.select(frames=range(10), rx="uav/rx-uav").h.shape
            (10, 1, 1, 32)
        """
        chosen = super().select(episode=episode, frames=frames)
        return chosen._narrowed([(0, "transmitter", tx), (1, "receiver", rx), (2, "carrier", carrier)])

    def sorted_keys(self, keys: Iterable[User]) -> Iterable[User]:
        found = list(keys)
        # Carriers in the order of the channel, which is that of the scenario; a sort by name would lose it.
        rank = {name: at for at, name in enumerate(dict.fromkeys(user.carrier for user in found))}
        return sorted(found, key=lambda user: (rank[user.carrier], user.tx, user.rx))


# --- channel and link -------------------------------------------------------------------------------


def _pairs(channel: Channel) -> Iterator[tuple[int, int, int]]:
    """Carrier, TX and RX of each user as indices; a device is no user of itself."""
    for c in range(len(channel.carriers)):
        for t, tx in enumerate(channel.tx):
            for r, rx in enumerate(channel.rx):
                if tx != rx and channel.uses(c, t, r):
                    yield c, t, r


def _each_pair(value: Callable[[Channel, int, int], Any]) -> Callable[[Any, Channel], Rows]:
    """Rows of what a channel has for each TX and RX, by their indices."""
    return lambda _, channel: [value(channel, t, r) for _, t, r in _pairs(channel)]


def _cuts(channel: Channel) -> Iterator[tuple[int, slice]]:
    """Carrier, and run on the path axis, of each user."""
    offsets = channel.offsets.tolist()
    for c, t, r in _pairs(channel):
        pair = t * len(channel.rx) + r
        yield c, slice(offsets[pair], offsets[pair + 1])


def _paths(field: str) -> Callable[[Any, Channel], Rows]:
    """Rows of a field with a path axis, before which ``a`` and ``doppler`` have one of carriers."""

    def rows(_: Any, channel: Channel) -> Rows:
        values = getattr(channel, field)
        if field in ("a", "doppler"):
            return [values[c, cut] for c, cut in _cuts(channel)]
        return [values[cut] for _, cut in _cuts(channel)]

    return rows


def _wideband(field: str, carrier_field: str) -> Callable[[Any, Channel], Rows]:
    """Rows of a part that only carriers with a numerology have; empty ones for the others."""

    def rows(view: TopicArrays[Any, Any], channel: Channel) -> Rows:
        stored = {(part.carrier, part.tx, part.rx): part.h for part in getattr(channel, field)}
        has_bins = [getattr(carrier, carrier_field) for carrier in channel.carriers]
        if not stored and not any(has_bins):
            raise RecordingError(
                f"{view.place} has no {field}: no carrier of the run has {carrier_field}; write "
                f"{carrier_field} = … into [[carriers]] of the scenario and channel.{field} into `record` "
                "below [run], and run again"
            )
        found = [stored.get(pair) if has_bins[pair[0]] else _NO_BINS for pair in _pairs(channel)]
        return view.recorded(f"channel.{field}", found if stored else [None for _ in found[:1]])

    return rows


# Of a carrier without subcarriers or taps.
_NO_BINS = np.zeros((0, 0, 0, 0), np.complex64)


class ChannelArrays(UserArrays[Channel]):
    """Topic ``channel``: H, and the paths that it is the sum of, by user.

    A user without a path has zeros in ``h``. Axes Nr and Nt are as long as the largest receive and transmit
    array, P as the most paths of a user, D as the most interactions of a path.

    Example:
        >>> from caviar_protocol.recording import Recording
        >>> recording = Recording("runs/smoke-20261122-101500")
        >>> channel = recording["channel"]
        >>> channel.h.shape, channel.tau.shape  # frames × users × Nr × Nt, frames × users × paths
        ((100, 2, 4, 32), (100, 2, 1))
    """

    def _matrices(self, channel: Channel) -> Rows:
        found = {(m.carrier, m.tx, m.rx): m.h for m in channel.h}
        return self.recorded("channel.h", [found.get(pair) for pair in _pairs(channel)])

    def _beam_gains(self, channel: Channel) -> Rows:
        pairs = [(self._array(channel.tx[t]), self._array(channel.rx[r])) for _, t, r in _pairs(channel)]
        return [beam_gains(h, *ends) for h, ends in zip(self._matrices(channel), pairs, strict=True)]

    def _array(self, name: str) -> AntennaArray:
        """The array of a device, by the scenario of the run."""
        specs = self._recording.metadata.scenario.get("devices", ())
        for spec in msgspec.convert(specs, tuple[DeviceSpec, ...]):
            if is_made_by(spec, name):
                return spec.array or AntennaArray()
        raise RecordingError(
            f"{self.place}: the array of {name!r} is not in the run's scenario; pass it to caviar.beam_gains"
        )

    def _first_taps(self, channel: Channel) -> Rows:
        if not channel.taps:
            return _wideband("taps", "taps")(self, channel)
        first = {(t.carrier, t.tx, t.rx): t.first for t in channel.taps}
        return [first.get(pair, 0) for pair in _pairs(channel)]

    h = Column(
        np.complex128, "Nr", "Nt", doc="narrowband gain from TX element n to RX element m", rows=_matrices
    )
    beam_gains = Column(
        np.float64,
        "Nt",
        "Nr",
        doc="|y| of each TX and RX beam, as caviar.beam_gains has it",
        rows=_beam_gains,
    )
    hf = Column(
        np.complex64,
        *("S", "K", "Nr", "Nt"),
        doc="gain on each subcarrier in each slot, from TX element n to RX element m",
        rows=_wideband("hf", "subcarriers"),
    )
    taps = Column(
        np.complex64,
        *("S", "L", "Nr", "Nt"),
        doc="gain in each tap and slot, from TX element n to RX element m",
        rows=_wideband("taps", "taps"),
    )
    first_tap = Column(np.int64, doc="sample of the first tap; 0 is the delay 0", rows=_first_taps)
    los = payload_column(
        np.bool_, Channel, "los", axes=2, rows=_each_pair(lambda channel, t, r: channel.los[t, r])
    )
    paths = Column(
        np.int64, doc="number of paths", rows=lambda _, channel: [c.stop - c.start for _, c in _cuts(channel)]
    )
    a = payload_column(np.complex128, Channel, "a", axes=1, rows=_paths("a"))
    tau = payload_column(np.float64, Channel, "tau", axes=0, rows=_paths("tau"))
    doppler = payload_column(np.float64, Channel, "doppler", axes=1, rows=_paths("doppler"))
    aod = Column(
        np.float64, "P", 2, unit="rad", doc="departure (zenith, azimuth) in world axes", rows=_paths("aod")
    )
    aoa = Column(
        np.float64, "P", 2, unit="rad", doc="direction the wave comes from, likewise", rows=_paths("aoa")
    )
    path_id = Column(np.uint64, "P", doc="stable id of each path in its pair", rows=_paths("id"))
    interactions = payload_column(np.uint8, Channel, "interactions", axes=0, rows=_paths("interactions"))
    points = payload_column(np.float64, Channel, "points", axes=0, rows=_paths("points"))
    error_bound_db = Column(
        np.float64,
        unit="dB",
        doc="stated NMSE of H that nine of ten users are within; NaN where none is",
        rows=_each_pair(
            lambda channel, t, r: np.nan if channel.error_bound_db is None else channel.error_bound_db[t, r]
        ),
    )

    @property
    def carriers(self) -> dict[str, Carrier]:
        """Frequency [Hz] and bandwidth [Hz] of each carrier, by name."""
        return {
            carrier.name: carrier for channel in self if channel is not None for carrier in channel.carriers
        }

    @property
    def rung(self) -> tuple[str, ...]:
        """Step of the fidelity ladder in each frame; empty where the channel is absent. Length F."""
        return tuple("" if channel is None else channel.rung for channel in self)

    @property
    def expected_error_db(self) -> Float64Array:
        """Stated bound on the NMSE of all H together [dB]; NaN where none is stated. Shape ``[F]``."""
        stated = (None if channel is None else channel.expected_error_db for channel in self)
        return np.array([np.nan if value is None else value for value in stated], dtype=np.float64)

    @property
    def error_reference(self) -> tuple[str, ...]:
        """Reference of the stated errors in each frame; empty where none is stated. Length F."""
        return tuple("" if channel is None else channel.error_reference for channel in self)

    def keys_of(self, payload: Channel) -> Sequence[User]:
        carriers, tx, rx = payload.carriers, payload.tx, payload.rx
        return [User(tx[t], rx[r], carriers[c].name) for c, t, r in _pairs(payload)]


def _packets(field: str, unit: str, doc: str) -> Any:
    """A column of a field that a link with packets has; NaN in frames of another."""

    def rows(_: Any, link: Link) -> Rows:
        values = getattr(link, field)
        return np.full(len(link.tx), np.nan) if values is None else values

    return Column(np.float64, unit=unit, doc=f"{doc}; NaN without packets", rows=rows)


class LinkArrays(UserArrays[Link]):
    """Topic ``link``: chosen and best beams, |y|, SNR, rates and reward, by user; packets, where it has some.

    |y| = |w* H f| is the equivalent channel of a beam pair; axis K counts the best pairs, best first. Of
    packets, what a frame added: sums over the frames of an episode are arrived = sent + dropped + the last
    buffered.

    Example:
        >>> from caviar_protocol.recording import Recording
        >>> recording = Recording("runs/smoke-20261122-101500")
        >>> link = recording["link"]
        >>> bool((link.abs_y <= link.top_abs_y[..., 0]).all())  # no pair is better than the best
        True
    """

    has_path = payload_column(np.bool_, Link, "has_path")
    los = payload_column(np.bool_, Link, "los")
    tx_beam = payload_column(np.int32, Link, "tx_beam")
    rx_beam = payload_column(np.int32, Link, "rx_beam")
    abs_y = payload_column(np.float64, Link, "abs_y")
    top_tx_beam = payload_column(np.int32, Link, "top_tx_beam")
    top_rx_beam = payload_column(np.int32, Link, "top_rx_beam")
    top_abs_y = payload_column(np.float64, Link, "top_abs_y")
    baseline_abs_y = payload_column(np.float64, Link, "baseline_abs_y")
    aod_azimuth = payload_column(np.float64, Link, "aod_azimuth")
    aoa_azimuth = payload_column(np.float64, Link, "aoa_azimuth")
    snr = payload_column(np.float64, Link, "snr")
    snr_best = payload_column(np.float64, Link, "snr_best")
    spectral_efficiency = payload_column(np.float64, Link, "spectral_efficiency")
    bit_rate = payload_column(np.float64, Link, "bit_rate")
    reward = payload_column(np.float64, Link, "reward")

    buffered = _packets("buffered", "bit", "waiting in the user's buffer")
    serving = _packets("serving", "1", "1 where this transmitter serves the receiver, else 0")
    arrived = _packets("arrived", "bit", "came for the user in the frame")
    sent = _packets("sent", "bit", "left the buffer and came through")
    dropped = _packets("dropped", "bit", "left the buffer unsent: too old, or it was full")
    delivered = _packets("delivered", "1", "packets of which the last bit came through")
    delay = _packets("delay", "s", "mean of the delivered packets, from arrival on")
    waiting = _packets("waiting", "s", "age of the oldest packet")
    sinr = _packets("sinr", "1", "linear SINR; with packets, mean over the slots that served the user")
    throughput = _packets("throughput", "bit/s", "`sent` over the length of the frame")
    blocks = _packets("blocks", "1", "transport blocks, one for each slot that served the user")
    block_errors = _packets("block_errors", "1", "of these, how many were not decoded")

    def keys_of(self, payload: Link) -> Sequence[User]:
        return [User(*user) for user in zip(payload.tx, payload.rx, payload.carrier, strict=True)]


# --- action -----------------------------------------------------------------------------------------


def _beam_choices(action: Action) -> list[BeamChoice]:
    return [command for command in action.commands if isinstance(command, BeamChoice)]


class ActionArrays(UserArrays[Action]):
    """Topic ``action``: the beams that an agent chose, by user; an empty carrier stands for all of them.

    Example:
        >>> from caviar_protocol.recording import Recording
        >>> recording = Recording("runs/smoke-20261122-101500")
        >>> recording["action"].tx_beam.shape  # frames × users
        (100, 2)
    """

    tx_beam = Column(
        np.int32,
        doc="chosen TX beam; −1: none chosen",
        rows=lambda _, action: [choice.tx_beam for choice in _beam_choices(action)],
    )
    rx_beam = Column(
        np.int32,
        doc="chosen RX beam; −1: none chosen",
        rows=lambda _, action: [choice.rx_beam for choice in _beam_choices(action)],
    )

    @property
    def motion(self) -> MotionArrays:
        """Commands of motion to objects, in the same frames."""
        return MotionArrays(self._recording, self.topic, self.sources, self._indices)

    def keys_of(self, payload: Action) -> Sequence[User]:
        return [User(choice.tx, choice.rx, choice.carrier) for choice in _beam_choices(payload)]


# --- all topics --------------------------------------------------------------------------------------------

TOPIC_ARRAYS: dict[str, type[TopicArrays[Any, Any]]] = {
    name: resolve_name(f"caviar_protocol.{topic.arrays}") for name, topic in TOPICS.items()
}
"""Class of the arrays of each topic."""
