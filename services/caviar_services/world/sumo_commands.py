"""Commands of agents carried out in SUMO: vehicles are driven, traffic lights switched.

What SUMO would take and then ignore, or answer with a sentence about its own names, is refused before.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

import msgspec

from caviar_protocol.errors import PayloadError, suggestion
from caviar_protocol.topics import Action, DriveCommand, SignalCommand
from caviar_protocol.topics.link import Command, MotionCommand, TrafficCommand

_WorldCommand = MotionCommand | TrafficCommand

# How long SUMO looks for room on a lane that it is to change to [s]; the command again prolongs it.
_LANE_S = 5.0


class Commanded(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Commands that were carried out, and when: what a simulation needs to go the same way again."""

    step: int
    """Steps after frame 0 that had been made before."""
    commands: tuple[TrafficCommand, ...]


def traffic_commands(
    actions: Mapping[str, Action], world: str, prefix: str, *, alone: bool
) -> tuple[TrafficCommand, ...]:
    """Find the commands for a world among those of all agents.

    Args:
        actions: By agent.
        world: Name of the world, for errors.
        prefix: Before the names of its vehicles and traffic lights.
        alone: Whether no other world is in the run that a command could be meant for.

    Returns:
        In the order of agents and of their commands.

    Raises:
        PayloadError: Two are for one actuator, or one is for a vehicle as if it could fly, or for a name that
            no world of the run can have.
    """
    found: list[TrafficCommand] = []
    owners: dict[str, str] = {}
    for agent, action in actions.items():
        for command in action.commands:
            if not isinstance(command, _WorldCommand):
                continue
            name = command.signal if isinstance(command, SignalCommand) else command.object
            if not name.startswith(prefix):
                if alone:
                    raise PayloadError(
                        f"agent {agent!r} commands {name!r}, and the names of world {world!r} begin with "
                        f"{prefix!r}"
                    )
                continue
            if not isinstance(command, TrafficCommand):
                raise PayloadError(
                    f"agent {agent!r} sends {type(command).__name__} to {name!r}, which world {world!r} "
                    "drives on roads; send DriveCommand"
                )
            actuator = _actuator(command)
            if actuator in owners:
                raise PayloadError(
                    f"agents {owners[actuator]!r} and {agent!r} both command {name!r}; let one of them own "
                    f"{actuator!r}, and send one command a frame"
                )
            owners[actuator] = agent
            found.append(command)
    return tuple(found)


def _actuator(command: TrafficCommand) -> str:
    if isinstance(command, SignalCommand):
        return f"signal:{command.signal}"
    return f"motion:{command.object}"


def carry_out(api: Any, commands: Iterable[Command], prefix: str) -> None:
    """Carry commands out, so that the next step of SUMO follows them.

    Args:
        api: libsumo, with a simulation.
        commands: Of `traffic_commands`.
        prefix: Before the names of vehicles and traffic lights.

    Raises:
        PayloadError: A vehicle, road, lane, traffic light or phase does not exist, or SUMO refuses; names
            command and value.
    """
    for command in commands:
        try:
            if isinstance(command, SignalCommand):
                _switch(api, command, command.signal.removeprefix(prefix))
            elif isinstance(command, DriveCommand):
                _drive(api, command, command.object.removeprefix(prefix))
        except api.TraCIException as error:
            text = " ".join(str(error).split())
            raise PayloadError(f"SUMO refuses {command}: {text}") from error


def _switch(api: Any, command: SignalCommand, name: str) -> None:
    lights = api.trafficlight
    known = lights.getIDList()
    if name not in known:
        raise PayloadError(f"there are no traffic lights {command.signal!r}; {suggestion(name, known)}")
    program = lights.getProgram(name)
    logic = next(logic for logic in lights.getAllProgramLogics(name) if logic.programID == program)
    phases = len(logic.phases)
    if command.phase >= phases:
        raise PayloadError(
            f"traffic lights {command.signal!r} have phases 0 to {phases - 1}, and phase {command.phase} is "
            "commanded"
        )
    if command.duration is not None:
        _check_finite(command, command.duration)
    lights.setPhase(name, command.phase)
    if command.duration is not None:
        lights.setPhaseDuration(name, command.duration)


def _drive(api: Any, command: DriveCommand, name: str) -> None:
    vehicle = api.vehicle
    if name not in vehicle.getIDList():
        is_person = name in api.person.getIDList()
        why = "is a person, who walks by itself" if is_person else "is no vehicle that is there"
        raise PayloadError(
            f"{command.object!r} is commanded to drive and {why}; command vehicles of the scene"
        )
    _check(api, command, vehicle.getRoadID(name))
    # −1 gives the vehicle back to SUMO's driver.
    vehicle.setSpeed(name, -1.0 if command.speed is None else command.speed)
    if command.route:
        vehicle.setRoute(name, list(command.route))
    if command.lane is not None:
        vehicle.changeLane(name, command.lane, _LANE_S)
    if command.stop is not None:
        stop = command.stop
        vehicle.setStop(name, stop.road, stop.position, stop.lane, stop.duration)


def _check(api: Any, command: DriveCommand, road: str) -> None:
    """Refuse values that do not exist, before any of the command is carried out.

    Args:
        api: libsumo.
        command: What is commanded.
        road: On which the vehicle is.
    """
    _check_finite(command, *(() if command.speed is None else (command.speed,)))
    if command.route or command.stop is not None:
        roads = api.edge.getIDList()
        for name in (*command.route, *(() if command.stop is None else (command.stop.road,))):
            if name not in roads:
                raise PayloadError(
                    f"{command.object!r}: there is no road {name!r}; {suggestion(name, roads)}"
                )
    if command.lane is not None and command.lane >= api.edge.getLaneNumber(road):
        raise PayloadError(
            f"{command.object!r} is on road {road!r} with lanes 0 to {api.edge.getLaneNumber(road) - 1}, and "
            f"lane {command.lane} is commanded"
        )
    if command.stop is not None:
        _check_finite(command, command.stop.position, command.stop.duration)
        lanes = api.edge.getLaneNumber(command.stop.road)
        if command.stop.lane >= lanes:
            raise PayloadError(
                f"{command.object!r}: road {command.stop.road!r} has lanes 0 to {lanes - 1}, and a stop on "
                f"lane {command.stop.lane} is commanded"
            )
        length = api.lane.getLength(f"{command.stop.road}_{command.stop.lane}")
        if command.stop.position > length:
            raise PayloadError(
                f"{command.object!r}: road {command.stop.road!r} is {length:g} m long, and a stop at "
                f"{command.stop.position:g} m is commanded"
            )


def _check_finite(command: TrafficCommand, *values: float) -> None:
    if not all(map(math.isfinite, values)):
        raise PayloadError(f"{command} is not finite; command numbers")
