"""The users that a policy decides for: a place for each pair of devices that a scenario can have."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from caviar_protocol.errors import ScenarioError
from caviar_protocol.scenario import DeviceSpec
from caviar_protocol.scenario.rules import patterns_overlap
from caviar_protocol.scenario.schema import ServiceSpec, owned_by
from caviar_protocol.space.codebooks import beam_count
from caviar_protocol.space.scene import Pair, pairs_of, share_carrier
from caviar_protocol.topics import AntennaArray, Scene


class KnownScenario(Protocol):
    """Facts of a scenario: a `Scenario`, or what a run says to its agents about it."""

    @property
    def devices(self) -> Sequence[DeviceSpec]:
        """All devices."""

    @property
    def services(self) -> Mapping[str, ServiceSpec]:
        """Services with their settings; empty where they are not known."""


@dataclass(frozen=True)
class KnownDevices:
    """Devices of a scenario as a run tells them to its agents."""

    devices: Sequence[DeviceSpec]
    services: Mapping[str, ServiceSpec] = field(default_factory=dict)


@dataclass(frozen=True)
class Place:
    """Place of the observation and of the action, with the user that it stands for."""

    tx: AntennaArray
    rx: AntennaArray

    @property
    def beams(self) -> tuple[int, int]:
        """Sizes of the two codebooks, TX and RX."""
        return beam_count(self.tx), beam_count(self.rx)

    @property
    def beam_pairs(self) -> int:
        """Number of pairs of the two codebooks."""
        tx, rx = self.beams
        return tx * rx


class Users:
    """Places for all pairs that a scenario can have, by transmitter, then receiver.

    A device on a pattern (``on = "car.*"``, ``count = 10``) has ``count`` places; the pairs that are there
    fill them in the order of their names, and what is left stays empty. So spaces keep their size while
    users come and go.

    Args:
        scenario: Names the devices.
        patterns: Receivers that are served, as names with ``*`` and ``?``.
        without: Receivers among them that are not, in the same form; their places stay empty.
        transmitters: Transmitters whose pairs have places, in the same form.

    Raises:
        ScenarioError: The patterns match no receiver; the text has those there are.

    Example:
        >>> from caviar_protocol.scenario import load_scenario
        >>> users = Users(load_scenario("geometric"), ("*",))
        >>> len(users), users.places[0].beam_pairs
        (1, 64)
    """

    def __init__(
        self,
        scenario: KnownScenario,
        patterns: Sequence[str],
        without: Sequence[str] = (),
        transmitters: Sequence[str] = ("*",),
    ) -> None:
        self._patterns, self._without = tuple(patterns), tuple(without)
        antennas = [d for d in scenario.devices if d.kind == "antenna"]
        self._groups: list[tuple[DeviceSpec, DeviceSpec]] = [
            (tx, rx)
            for tx in sorted((d for d in antennas if d.role in ("tx", "both")), key=_name)
            if any(patterns_overlap(_full_name(tx), pattern) for pattern in transmitters)
            for rx in sorted((d for d in antennas if d.role in ("rx", "both")), key=_name)
            if rx is not tx and self._may_serve(rx) and share_carrier(tx.carriers, rx.carriers)
        ]
        if not self._groups:
            receivers, senders = (
                ", ".join(_full_name(d) for d in antennas if d.role in (role, "both")) or "none"
                for role in ("rx", "tx")
            )
            of_tx = "" if "*" in transmitters else f" with transmitter {' or '.join(transmitters)}"
            there = f"{receivers}" + (f"; transmitters: {senders}" if of_tx else "")
            raise ScenarioError(
                f"no receiver of the scenario is {' or '.join(patterns)}{of_tx}; there are: {there}"
            )
        self._first: dict[tuple[str, str], int] = {}
        self.places: list[Place] = []
        """One for each pair there may be."""
        for tx, rx in self._groups:
            self._first[tx.name, rx.name] = len(self.places)
            # One object for all of a group: places of a pattern have the same arrays.
            self.places += [Place(_array(tx), _array(rx))] * (tx.count * rx.count)
        self._devices: object = None
        self._found: tuple[tuple[int, Pair], ...] = ()

    def __len__(self) -> int:
        return len(self.places)

    @property
    def transmitters(self) -> tuple[str, ...]:
        """Names of the transmitters that have places, with ``*`` and ``?`` where the scenario has them so."""
        return tuple(dict.fromkeys(_full_name(tx) for tx, _ in self._groups))

    def on_objects_of(self, sensor: DeviceSpec) -> bool:
        """Return whether a receiver that is served may be on an object that carries a device.

        Args:
            sensor: The device, on a pattern of objects.
        """
        return any(rx.on and patterns_overlap(rx.on, sensor.on) for _, rx in self._groups)

    @property
    def receivers(self) -> tuple[str, ...]:
        """Names of the receivers that are served, with ``*`` where the scene has those of objects."""
        return tuple(dict.fromkeys(_full_name(rx) for _, rx in self._groups))

    @property
    def keeps_heading(self) -> bool | None:
        """Whether the served receivers on objects keep their heading, or turn; None: none is on one, or some
        do."""
        found = {rx.keeps_heading for _, rx in self._groups if rx.on}
        return found.pop() if len(found) == 1 else None

    def present(self, scene: Scene) -> tuple[tuple[int, Pair], ...]:
        """Find the pairs of a scene that are served.

        Returns:
            Place and pair, in the order of the scene's pairs.
        """
        # A world makes a new tuple of devices where one comes or goes, and passes on the same one else.
        if scene.devices is not self._devices:
            self._devices, self._found = scene.devices, tuple(self._seated(scene))
        return self._found

    def _seated(self, scene: Scene) -> Iterator[tuple[int, Pair]]:
        taken: dict[tuple[str, str], int] = {}
        for pair in pairs_of(scene):
            group = spec_name(pair.tx.name), spec_name(pair.rx.name)
            if group in self._first and self._serves(pair.rx.name):
                place = self._first[group] + taken.get(group, 0)
                taken[group] = taken.get(group, 0) + 1
                yield place, pair

    def _serves(self, rx: str) -> bool:
        return owned_by(self._patterns, rx) and not (self._without and owned_by(self._without, rx))

    def _may_serve(self, rx: DeviceSpec) -> bool:
        # Names of objects are known at run time: two patterns are compared with each other here.
        return any(patterns_overlap(_full_name(rx), pattern) for pattern in self._patterns)


def _name(device: DeviceSpec) -> str:
    return device.name


def _full_name(device: DeviceSpec) -> str:
    """Name of a device in the run; a pattern where it is on one."""
    return f"{device.on}/{device.name}" if device.on else device.name


def spec_name(device: str) -> str:
    """Name in the scenario of a device that may be mounted on an object."""
    return device.rpartition("/")[2]


def _array(device: DeviceSpec) -> AntennaArray:
    return device.array or AntennaArray()
