"""Base of the agents that select beams: the users they serve, what they consume, the check of their choices.

To add an agent, subclass `Agent`, implement `Agent.choose`, and name the class in a scenario as
``use = "module:Class"``, or in the registry. Some command more than beams, the motion of an object for
instance (`Agent.other_actuators`).
"""

from __future__ import annotations

import operator
from abc import abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from fnmatch import fnmatchcase
from typing import ClassVar, TypeVar

import msgspec

from caviar_protocol.errors import PayloadError, ScenarioError
from caviar_protocol.messages import Input, Role
from caviar_protocol.scenario.rules import BEAM
from caviar_protocol.space.codebooks import beam_count
from caviar_protocol.space.scene import Pair, pairs_of
from caviar_protocol.topics import Action, AntennaDevice, BeamChoice, Carrier, Scene, UserSchedule
from caviar_protocol.topics.link import Command, SignalCommand
from caviar_services.service import Frame, Preparation, Prepared, RunInfo, Service, StepResult

# What actuators other than beams begin with; a name without any of these is that of a receiver.
_OTHER_ACTUATORS = ("motion:", "schedule:", "signal:")

_FORM = "BeamChoice(tx=pair.tx.name, rx=pair.rx.name, tx_beam=…, rx_beam=…)"

WITHOUT_USERS = "frames-without-users"
"""Count of the frames in which an agent had no user to serve."""


class AgentSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Users that an agent serves. A default agent serves all users that no other agent owns."""

    users: tuple[str, ...] = ("*",)
    """Receivers this agent owns, as names with ``*`` for any text and ``?`` for any character
    (``car.*``); ``beam:`` may stand before each."""
    except_users: tuple[str, ...] = ()
    """Receivers among them that other agents own, in the same form. Other actuators of those
    agents (``motion:uav``) may stand among them and take no receiver away."""


S = TypeVar("S", bound=AgentSettings)


class Agent(Service[S]):
    """Base of agents that choose a beam pair for each of their users, every frame.

    Subclasses implement `choose`, and `other_actuators` with `other_commands` where they command more than
    beams. The final grant of an episode takes no action (contract, clause 16).

    Args:
        settings: Users that the agent serves.
        run: What the agent knows about the run.

    Raises:
        ScenarioError: ``users`` names an actuator that this agent does not steer.

    Example:
        >>> from caviar_protocol.topics import BeamChoice
        >>> class FirstBeams(Agent[AgentSettings]):
        ...     def choose(self, frame, scene, pairs):
        ...         return [
        ...             BeamChoice(tx=pair.tx.name, rx=pair.rx.name, tx_beam=0, rx_beam=0) for pair in pairs
        ...         ]
        >>> agent = FirstBeams(AgentSettings(users=("car.*",)), RunInfo(name="agent"))
        >>> agent.serves("car.1/rx"), agent.serves("bus.1/rx")
        (True, False)
    """

    role: ClassVar[Role] = "agent"
    inputs: ClassVar[tuple[Input, ...]] = (
        Input(topic="scene"),
        Input(topic="link", lag=1, required=False),
    )
    outputs: ClassVar[tuple[str, ...]] = ("action",)
    Settings: ClassVar[type[msgspec.Struct]] = AgentSettings

    def __init__(self, settings: S, run: RunInfo) -> None:
        super().__init__(settings, run)
        # Here, where the key is known: in the link, a user that no agent serves is nothing wrong.
        for text in settings.users:
            if text.startswith(_OTHER_ACTUATORS) and text not in self.other_actuators():
                known = " and ".join(("beams", *map(repr, self.other_actuators())))
                raise ScenarioError(
                    f"{text!r} is no beam, and this agent steers {known} only; write 'beam:<receiver>'",
                    key=f"services.{run.name}.users",
                )
        # Patterns, not names: who is there changes from frame to frame.
        self._owned = _receivers(settings.users)
        self._others = _receivers(settings.except_users)

    def prepare(self, preparation: Preparation) -> Prepared:
        """Declare the actuators. One that leaves users to others owns no beam by name."""
        others = self.other_actuators()
        # Patterns cannot say «all but these»: the broker looks for two owners of a name among those declared.
        if self.settings.except_users:
            return Prepared(actuators=others, notes=("serves the users that no other agent owns",))
        return Prepared(actuators=(*(BEAM + text for text in self._owned), *others))

    def other_actuators(self) -> tuple[str, ...]:
        """Actuators that this agent owns beside its beams, by their whole names, sorted."""
        return ()

    def other_commands(self, frame: Frame, scene: Scene) -> Iterable[Command]:
        """Choose commands for `other_actuators`.

        Args:
            frame: The frame.
            scene: The scenes of all worlds as one.

        Returns:
            Commands in the order of `other_actuators`; an actuator without one keeps its state.
        """
        return ()

    def step(self, frame: Frame) -> StepResult:
        """One choice per user, sorted by actuator, then TX, then carrier, and the other commands."""
        if frame.final:  # it brings the last link, for what an agent learns from; nothing follows it
            return StepResult()
        scene = frame.scene()
        pairs = [pair for pair in pairs_of(scene) if self.serves(pair.rx.name)]
        author = f"{type(self).__name__}.choose"
        choices = checked_choices(author, self.choose(frame, scene, pairs), pairs, self.run.carriers)
        commands = (*choices, *self._declared(self.other_commands(frame, scene)))
        # One that flies alone has no beams to miss users for.
        counts = {WITHOUT_USERS: 1} if self._owned and not pairs else {}
        return StepResult(products={"action": Action(commands=commands)}, counts=counts)

    def _declared(self, commands: Iterable[Command]) -> Iterator[Command]:
        """Refuse commands for actuators that are not declared: the broker would not see a second owner."""
        own = self.other_actuators()
        for command in commands:
            actuator = actuator_of(command)
            if actuator not in own:
                raise PayloadError(
                    f"{type(self).__name__}.other_commands returned {type(command).__name__} for "
                    f"{actuator!r}, which {type(self).__name__}.other_actuators does not name: it returned "
                    f"{', '.join(map(repr, own)) or 'nothing'}"
                )
            yield command

    def serves(self, rx: str) -> bool:
        """Whether this agent serves a receiver.

        Args:
            rx: Name of the receiver.
        """
        return _matches(rx, self._owned) and not _matches(rx, self._others)

    @abstractmethod
    def choose(self, frame: Frame, scene: Scene, pairs: Sequence[Pair]) -> Iterable[BeamChoice]:
        """Choose beams for the users of this agent.

        Args:
            frame: The frame, with the link of the frame before among its inputs.
            scene: The scenes of all worlds as one.
            pairs: Transmitter and receiver of each user.

        Returns:
            Choices in any order, one for each pair and carrier at most, of beams from 0 to the size of the
            device's array − 1. A pair without one is not served; a choice without a carrier holds for all
            carriers. `checked_choices` refuses anything else.
        """


def actuator_of(command: Command) -> str:
    """Name the actuator of a command.

    Args:
        command: Of an agent.

    Example:
        >>> from caviar_protocol.topics import VelocityCommand
        >>> actuator_of(VelocityCommand(object="uav", velocity=(1.0, 0.0, 0.0)))
        'motion:uav'
    """
    match command:
        case BeamChoice():
            return f"{BEAM}{command.rx}"
        case UserSchedule():
            return f"schedule:{command.tx}"
        case SignalCommand():
            return f"signal:{command.signal}"
    return f"motion:{command.object}"


def _receivers(patterns: Iterable[str]) -> tuple[str, ...]:
    """The patterns of receiver names among patterns of receivers and actuators."""
    return tuple(text.removeprefix(BEAM) for text in patterns if not text.startswith(_OTHER_ACTUATORS))


def _matches(name: str, patterns: Iterable[str]) -> bool:
    return any(fnmatchcase(name, pattern) for pattern in patterns)


# --- what an agent chose, checked where its author can still be named --------------------------------------


def checked_choices(
    author: str, chosen: object, pairs: Sequence[Pair], carriers: Sequence[Carrier] = ()
) -> list[BeamChoice]:
    """Check what an agent's `choose` returned.

    Args:
        author: What the agent's method is called in errors: ``Mine.choose``.
        chosen: What it returned.
        pairs: Transmitter and receiver of each user that the agent serves in the frame.
        carriers: Of the run; empty: the names of carriers are not looked at.

    Returns:
        The choices, sorted by receiver, transmitter and carrier.

    Raises:
        PayloadError: It is no series of `BeamChoice`, or one of them is for a user that the agent does not
            serve, for one that has a choice already, or of a beam that its device does not have. The text
            has author, value, user, range and remedy.

    Example:
        >>> from caviar_protocol.space.scene import pairs_of
        >>> from caviar_services.testing.samples import scene
        >>> pairs = pairs_of(scene(0))
        >>> chosen = (BeamChoice(tx="bs", rx=pair.rx.name, tx_beam=7) for pair in reversed(pairs))
        >>> [choice.rx for choice in checked_choices("Mine.choose", chosen, pairs)]
        ['car.1/rx', 'truck.2/rx']
    """
    if not isinstance(chosen, Iterable):
        raise PayloadError(
            f"{author} returned {_shown(chosen)}; return a list of BeamChoice, one for each pair to be "
            "served, or yield them"
        )
    served = {(pair.tx.name, pair.rx.name): pair for pair in pairs}
    names = {"", *(carrier.name for carrier in carriers)}
    found: dict[tuple[str, str, str], BeamChoice] = {}
    for choice in chosen:
        if type(choice) is not BeamChoice:
            raise PayloadError(f"{author} chose {_shown(choice)}, which is no BeamChoice; write {_FORM}")
        tx, rx, carrier = choice.tx, choice.rx, choice.carrier
        if not (isinstance(tx, str) and isinstance(rx, str) and isinstance(carrier, str)):
            values = (("tx", choice.tx), ("rx", choice.rx), ("carrier", choice.carrier))
            name, value = next(entry for entry in values if not isinstance(entry[1], str))
            form = "the carrier's name, a text" if name == "carrier" else f"{name}=pair.{name}.name"
            raise PayloadError(f"{author}: {name}={_shown(value)} is no name; write {form}")
        pair = served.get((tx, rx))
        if pair is None:
            known = ", ".join(f"{one} → {other}" for one, other in served) or "none"
            raise PayloadError(
                f"{author} chose beams for {_user(choice)}, which it does not serve in this frame; choose "
                f"for the pairs that it is given: {known}"
            )
        twice = found.setdefault((rx, tx, carrier), choice)
        if twice is not choice:
            raise PayloadError(
                f"{author} chose beams for {_user(choice)} twice, {_beams(twice)} and {_beams(choice)}; "
                "write one BeamChoice for each pair and carrier"
            )
        if carriers and carrier not in names:
            known = ", ".join(sorted(names - {""}))
            raise PayloadError(
                f"{author}: carrier={carrier!r} for {tx} → {rx}; the run has: {known}; without a carrier a "
                "choice holds for all"
            )
        _check_beam(author, "tx_beam", choice, pair.tx)
        _check_beam(author, "rx_beam", choice, pair.rx)
    # Sorted, so that equal decisions are equal bytes whatever order an agent makes them in.
    return [found[key] for key in sorted(found)]


def _check_beam(author: str, name: str, choice: BeamChoice, device: AntennaDevice) -> None:
    beam, size = getattr(choice, name), beam_count(device.array)
    try:
        if 0 <= operator.index(beam) < size:  # NumPy's whole numbers are right, too
            return
    except TypeError:
        pass
    allowed = f"an int from 0 to {size - 1}, the beams" if size > 1 else "0, the only beam"
    raise PayloadError(
        f"{author}: {name}={_shown(beam)} for {_user(choice)}; write {allowed} of {device.name!r}"
    )


def _user(choice: BeamChoice) -> str:
    return f"{choice.tx} → {choice.rx}" + (f" on carrier {choice.carrier!r}" if choice.carrier else "")


def _beams(choice: BeamChoice) -> str:
    return f"({_shown(choice.tx_beam)}, {_shown(choice.rx_beam)})"


def _shown(value: object) -> str:
    """A value as Python writes it, shortened: an array has thousands of numbers."""
    text = " ".join(repr(value).split())
    return text if len(text) <= 80 else f"{text[:79]}…"
