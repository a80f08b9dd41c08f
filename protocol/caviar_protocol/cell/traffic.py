"""Traffic models: how many packets arrive for a user in each slot.

A model is the number of packets that were offered up to an instant, as a function of time, which `Offered`
has piece by piece. ``constant`` traffic and ``trace`` send a packet whenever that passes a whole number;
``poisson`` and ``alternating`` draw the packets of each slot from a Poisson distribution of that mean.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, NamedTuple

import msgspec
import numpy as np

from caviar_protocol.arrays import Float64Array, Int64Array, quantity
from caviar_protocol.errors import ScenarioError, suggestion
from caviar_protocol.plugins import load_plugin, plugins
from caviar_protocol.scenario.conversion import FILE, Place, csv_rows

COLUMNS = ("t_s", "rate_bit_s")
"""Header of a trace: an instant, and the rate that holds from it on."""

MAX_RATE_BIT_S = 1e15
"""A rate beyond this is a mistake of units, and would overflow the packets of a run."""

_Rate = Annotated[float, quantity("bit/s", "mean rate of the traffic", ge=0, le=MAX_RATE_BIT_S)]


class Traffic(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Traffic of some users.

    Example:
        >>> voice = Traffic(users=("car.*",), model="constant", rate_bit_s=24_000.0, packet_bits=240)
        >>> Offered.for_traffic(voice).packets(np.array([0.0, 0.5])).tolist()
        [0.0, 50.0]
    """

    users: tuple[str, ...] = ("*",)
    """Receivers, as names with ``*`` for any text and ``?`` for any character; of several entries that fit a
    receiver, the first counts."""
    model: str = "full"
    """``full``: there is always something to send; ``constant``: packets at equal intervals; ``poisson``;
    ``alternating``: Poisson, dense and light by turns; ``trace``: rates over time from a file; or the name of
    a plug-in."""
    rate_bit_s: _Rate | None = None
    """Of ``constant`` and ``poisson``; of ``alternating`` while it is dense."""
    light_rate_bit_s: _Rate | None = None
    """Of ``alternating`` while it is light."""
    period_s: Annotated[float, quantity("s", "that dense and light last each", gt=0, le=1e9)] | None = None
    """Of ``alternating``, which begins dense."""
    file: str = ""
    """Of ``trace``: ``file:PATH.csv`` with the header ``t_s,rate_bit_s``. A rate holds until the next row,
    the last one to the end; before the first nothing arrives."""
    packet_bits: Annotated[int, quantity("bit", "size of a packet", ge=1, le=10**9)] = 12_000
    max_age_s: Annotated[float, quantity("s", "after which packets are dropped", gt=0, le=1e9)] | None = None
    """Absent: packets wait for as long as it takes."""
    max_packets: Annotated[int, quantity("1", "that the buffer holds", ge=1, le=10**12)] | None = None
    """Packets that find the buffer full are dropped; absent: it has no bound."""


_KEYS = ("rate_bit_s", "light_rate_bit_s", "period_s", "file")
_LIMITS = ("max_age_s", "max_packets")


def check_traffic(traffic: Traffic, place: Place) -> None:
    """Check that traffic has what its model needs, and nothing else; a trace is read.

    Args:
        traffic: The entry of the settings.
        place: Where it stands.

    Raises:
        ScenarioError: A key is missing or has no effect, or the trace is wrong; names key, or file and line.

    Example:
        >>> check_traffic(Traffic(model="constant"), Place("traffic[0]"))
        Traceback (most recent call last):
            ...
        caviar_protocol.errors.ScenarioError: traffic[0].rate_bit_s: is missing; 'constant' needs rate_bit_s
    """
    model = traffic_model(traffic.model, place)
    for key in _KEYS:
        given = getattr(traffic, key) not in (None, "")
        if key in model.needs and not given:
            raise place.at(key).error(f"is missing; {traffic.model!r} needs {', '.join(model.needs)}")
        if given and key not in model.needs:
            models = ", ".join(repr(name) for name, row in TRAFFIC_MODELS.items() if key in row.needs)
            raise place.at(key).error(
                f"has no effect with model {traffic.model!r}; leave it out, or choose {models}"
            )
    if traffic.model == "full":
        # Packets of a full buffer are as old as the wait for the next slot: none is ever late.
        for key in _LIMITS:
            if getattr(traffic, key) is not None:
                raise place.at(key).error("has no effect with model 'full', of which nothing is dropped")
    else:
        model.offered(traffic, place)


class Offered(msgspec.Struct, frozen=True):
    """Packets that were offered up to any instant: piecewise linear, and periodic after the last piece.

    Example:
        >>> traffic = Traffic(model="poisson", rate_bit_s=1e6, packet_bits=1000)
        >>> Offered.for_traffic(traffic).packets(np.array([2.0]))
        array([2000.])
    """

    begins: Float64Array
    """Begin of each piece [s], the first at 0, Shape ``[K]``."""
    rates: Float64Array
    """Packets a second in each piece, Shape ``[K]``."""
    period: float = math.inf
    """After which the pieces begin again [s]."""

    @staticmethod
    def for_traffic(traffic: Traffic, place: Place | None = None) -> Offered:
        """Packets that traffic offers over time.

        Args:
            traffic: Not of model ``full``, which offers what can be sent.
            place: Where it stands, for errors about its trace.

        Raises:
            ScenarioError: The trace is wrong; names file and line.
        """
        place = place or Place("traffic")
        return traffic_model(traffic.model, place).offered(traffic, place)

    def packets(self, t: Float64Array) -> Float64Array:
        """Packets that were offered from 0 to each instant.

        Args:
            t: Instants [s], none below 0.
        """
        if math.isinf(self.period):
            return self._within(t)
        rounds, within = np.divmod(t, self.period)
        found: Float64Array = rounds * self._within(np.array([self.period])) + self._within(within)
        return found

    def _within(self, t: Float64Array) -> Float64Array:
        """Packets from the begin of the first piece to instants of the last at most [s]."""
        before = np.concatenate([[0.0], np.cumsum(self.rates[:-1] * np.diff(self.begins))])
        piece = np.searchsorted(self.begins, t, side="right") - 1
        found: Float64Array = before[piece] + self.rates[piece] * (t - self.begins[piece])
        return found


def _steady(traffic: Traffic, _: Place) -> Offered:
    return Offered(np.zeros(1), np.array([(traffic.rate_bit_s or 0.0) / traffic.packet_bits]))


def _alternating(traffic: Traffic, _: Place) -> Offered:
    half, rates = traffic.period_s or 1.0, (traffic.rate_bit_s or 0.0, traffic.light_rate_bit_s or 0.0)
    return Offered(np.array([0.0, half]), np.array(rates) / traffic.packet_bits, 2 * half)


def _traced(traffic: Traffic, place: Place) -> Offered:
    begins, rates = read_trace(traffic.file, place.at("file"))
    if begins[0] > 0:
        begins, rates = np.insert(begins, 0, 0.0), np.insert(rates, 0, 0.0)
    return Offered(begins, rates / traffic.packet_bits)


class TrafficModel(NamedTuple):
    """A traffic model: what it offers over time, and how packets come of that."""

    offered: Callable[[Traffic, Place], Offered]
    """Called with an entry of the settings and its place, which errors name."""
    needs: tuple[str, ...] = ()
    """Keys of `Traffic` that it reads, of the rates, ``period_s`` and ``file``; the others are refused."""
    random: bool = False
    """Whether the packets of each slot are drawn from a Poisson distribution of the mean that is offered."""


TRAFFIC_MODELS: Mapping[str, TrafficModel] = {
    "full": TrafficModel(_steady),
    "constant": TrafficModel(_steady, ("rate_bit_s",)),
    "poisson": TrafficModel(_steady, ("rate_bit_s",), random=True),
    "alternating": TrafficModel(_alternating, ("rate_bit_s", "light_rate_bit_s", "period_s"), random=True),
    "trace": TrafficModel(_traced, ("file",)),
}
"""Traffic models by name; those of plug-ins are registered in `TRAFFIC_PLUGINS`."""
TRAFFIC_PLUGINS = "caviar.traffic"
"""Group of entry points, each a `TrafficModel`."""


def traffic_model(name: str, place: Place) -> TrafficModel:
    """The traffic model of a name.

    Args:
        name: Of the model, built in or of a plug-in.
        place: Of the entry that names it, for errors.

    Raises:
        ScenarioError: There is none of this name; names the key, and the models there are.
        DeclarationError: The plug-in cannot be loaded, or is no `TrafficModel`.
    """
    if name in TRAFFIC_MODELS:
        return TRAFFIC_MODELS[name]
    added = plugins(TRAFFIC_PLUGINS)
    if name not in added:
        raise place.at("model").error(
            f"{name!r} is no traffic model; {suggestion(name, [*TRAFFIC_MODELS, *added])}"
        )
    return load_plugin(added[name], TrafficModel)


def arrivals(
    offered: Offered, first_slot: int, slots: int, slot_s: float, random: np.random.Generator | None
) -> Int64Array:
    """Packets that arrive in consecutive slots.

    Args:
        offered: What the traffic offers.
        first_slot: Number of the first slot, from 0.
        slots: How many.
        slot_s: Length of a slot [s].
        random: Draws the packets of each slot, from a Poisson distribution; None: packets come whenever a
            whole one was offered.

    Returns:
        Shape ``[slots]``.

    Example:
        >>> steady = Offered.for_traffic(Traffic(model="constant", rate_bit_s=3000.0, packet_bits=1000))
        >>> arrivals(steady, 0, 4, 0.5, None).tolist()  # 1.5 packets a slot
        [1, 2, 1, 2]
    """
    until = offered.packets(np.arange(first_slot, first_slot + slots + 1, dtype=np.float64) * slot_s)
    if random is not None:
        return random.poisson(np.maximum(until[1:] - until[:-1], 0.0)).astype(np.int64)
    # A billionth more: 3 packets that sum up to 2.9999999 have come.
    whole = np.floor(until + 1e-9).astype(np.int64)
    return whole[1:] - whole[:-1]


def read_trace(file: str, place: Place) -> tuple[Float64Array, Float64Array]:
    """Read a trace: CSV with the header ``t_s,rate_bit_s``; lines that begin with ``#`` are skipped.

    Args:
        file: ``file:`` and its absolute path; the loader of scenarios makes paths absolute.
        place: The key that names it, for errors.

    Returns:
        Begin of each piece [s] and the rate from it on [bit/s], Shape ``[K]`` each.

    Raises:
        ScenarioError: It cannot be read, a row is no pair of numbers, a rate is negative, or instants do not
            increase; names file and line.

    Example:
        >>> from tempfile import TemporaryDirectory
        >>> with TemporaryDirectory() as folder:
        ...     path = Path(folder, "video.csv")
        ...     _ = path.write_text("t_s,rate_bit_s\\n0,2e6\\n5,8e6\\n")
        ...     read_trace(f"file:{path}", Place("file"))
        (array([0., 5.]), array([2000000., 8000000.]))
    """
    path = Path(file.removeprefix(FILE))
    name = str(path)
    if not path.is_absolute():
        raise place.error(f'{name!r} is relative to nothing; write "{FILE}{name}"')
    rows: list[tuple[float, float]] = []
    for row in csv_rows(path, place, [COLUMNS], "the trace ")[1:]:
        rows.append(_row(row.cells, row.text, rows, name, row.number))
    if not rows:
        raise ScenarioError(f"holds no rate; write {','.join(COLUMNS)}, then one a line", name, place.key)
    begins, rates = np.array(rows, np.float64).T
    return begins.copy(), rates.copy()


def _row(
    cells: Sequence[str], line: str, rows: Sequence[tuple[float, float]], name: str, number: int
) -> tuple[float, float]:
    try:
        t, rate = map(float, cells)
    except ValueError as error:
        text = f"{line!r} is no pair of numbers, {','.join(COLUMNS)}"
        raise ScenarioError(text, name, line=number) from error
    if not 0 <= t <= 1e9:
        raise ScenarioError(f"t_s = {t:g}; write seconds from 0 to 1e9", name, line=number)
    if rows and t <= rows[-1][0]:
        text = f"t_s = {t:g} does not come after {rows[-1][0]:g}; order the rows by time"
        raise ScenarioError(text, name, line=number)
    if not 0 <= rate <= MAX_RATE_BIT_S:
        raise ScenarioError(
            f"rate_bit_s = {rate:g}; write a rate from 0 to {MAX_RATE_BIT_S:g}", name, line=number
        )
    return t, rate
