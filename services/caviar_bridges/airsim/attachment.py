"""Attachment of the agent ``airsim``, in place of those that fly a scenario's objects: ``--airsim``."""

from __future__ import annotations

from collections.abc import Iterator

from msgspec.structs import replace

from caviar_protocol.errors import ScenarioError
from caviar_protocol.scenario.schema import Scenario, ServiceSpec

MOTION = "motion:"
"""Prefix of the actuators that move objects; the object's name follows."""
NAME = "airsim"
BUDGET_MS = 3_600_000.0
"""[ms] for which a script may hold the world before that counts as a miss."""


def attach(scenario: Scenario, address: str) -> Scenario:
    """HOST:PORT, as 127.0.0.1:41451: scripts for AirSim connect there and fly.

    The agent takes the place of the first one that owns the motion of an object, and the users of all that
    do; these are left out. Where there is none it is one more service.

    Args:
        scenario: The scenario.
        address: ``HOST:PORT`` at which AirSim's RPC is served.

    Raises:
        ScenarioError: No object is flown by commands.

    Example:
        >>> from caviar_protocol.scenario import load_scenario
        >>> pair = attach(load_scenario("uav-pair"), "127.0.0.1:41451")
        >>> list(pair.services)
        ['world', 'channel', 'link', 'pilot', 'beams', 'recorder']
        >>> pair.services["pilot"].use, pair.services["pilot"].settings["vehicles"]
        ('airsim', {'uav': 'uav'})
    """
    served = {n: spec for n, spec in scenario.services.items() if (spec.role, spec.use) == ("agent", NAME)}
    if served:
        changed = {n: replace(s, settings={**s.settings, "listen": address}) for n, s in served.items()}
        return replace(scenario, services={**scenario.services, **changed})
    pilots = {n: spec for n, spec in scenario.services.items() if spec.role == "agent" and [*_flown_by(spec)]}
    objects = [thing for spec in pilots.values() for thing in _flown_by(spec)]
    objects += [thing for spec in scenario.services.values() for thing in _flown_in(spec)]
    if not objects:
        raise ScenarioError(
            "no object of the scenario is flown by commands, so that --airsim has nothing to fly; use a "
            "world that flies objects, such as 'flight'"
        )
    vehicles = {thing: thing for thing in objects}
    users = tuple(user for spec in pilots.values() for user in spec.users)
    # A pilot without users is a default agent: it serves the receivers that no other agent owns.
    if not pilots:
        users = tuple(MOTION + thing for thing in vehicles)
    elif not all(spec.users for spec in pilots.values()):
        users = ()
    agent = ServiceSpec(
        role="agent",
        use=NAME,
        budget_ms=BUDGET_MS,
        users=users,
        settings={"vehicles": vehicles, "listen": address},
    )
    place = next(iter(pilots), NAME)
    kept = {
        name: agent if name == place else spec
        for name, spec in scenario.services.items()
        if name == place or name not in pilots
    }
    return replace(scenario, services={**kept, place: agent})


def _flown_by(spec: ServiceSpec) -> Iterator[str]:
    """Objects whose motion an agent owns."""
    for user in spec.users:
        if user.startswith(MOTION):
            yield user.removeprefix(MOTION)
    if not spec.users and isinstance(thing := spec.settings.get("object"), str):
        yield thing  # an agent such as `waypoints` without users of its own


def _flown_in(spec: ServiceSpec) -> Iterator[str]:
    """Objects that a world moves by command."""
    flown = spec.settings.get("flown", ()) if spec.role == "world" else ()
    prefix = str(spec.settings.get("prefix") or "")
    for thing in flown if isinstance(flown, list | tuple) else ():
        if isinstance(thing, dict) and isinstance(thing.get("name"), str):
            yield prefix + thing["name"]
