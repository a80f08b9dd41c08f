"""The graph of a run, built from what its services declared (contract, clauses 3 and 5)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from caviar_protocol.errors import DeclarationError
from caviar_protocol.fields import PARTS_SINCE, parse_version
from caviar_protocol.messages import Demand, Hello
from caviar_protocol.scenario.rules import patterns_overlap

WILDCARD = "*"
"""Topic of an input that takes every topic (recorders)."""


@dataclass(frozen=True)
class Edge:
    """One input of a consumer, resolved to a source."""

    topic: str
    source: str
    lag: int
    required: bool


@dataclass(frozen=True)
class Graph:
    """Graph of the products that the services of a run get of each other."""

    order: tuple[str, ...]
    """Active services, producers before the consumers of their frame."""
    inputs: Mapping[str, tuple[Edge, ...]]
    """Edges into each active service, sorted by (topic, source)."""
    latest: Mapping[str, tuple[Edge, ...]]
    """The same edges, those first that are decided last in a frame."""
    consumers: Mapping[str, tuple[str, ...]]
    """Active services that take something from a service, at any lag."""
    outputs: Mapping[str, tuple[str, ...]]
    """Topics in demand of each active service, sorted."""
    demand: Mapping[str, tuple[Demand, ...]]
    """What PREPARE tells each service, active or not."""
    producers: Mapping[str, tuple[str, ...]]
    """Sources of each topic, sorted."""
    retained: frozenset[str]
    """Active services whose products are taken with lag 1."""
    idle: tuple[str, ...]
    """Services whose outputs no service takes: not run."""


def build_graph(hellos: Mapping[str, Hello], record: Iterable[str] = ()) -> Graph:
    """Build the graph of a run from what its services declared.

    Args:
        hellos: HELLO of each service, by name.
        record: ``topic`` or ``topic.part`` entries that are in demand for the recording.

    Raises:
        DeclarationError: An input has no source, inputs of one frame form a cycle, or the recording asks for
            a topic that no service produces; it names the service and the remedy.
    """
    producers = _producers(hellos)
    edges = {name: _edges(hello, producers) for name, hello in hellos.items()}
    # Before anything is left out: a cycle is a mistake also among services that would not be run.
    order = _topological_order(hellos, edges)
    wanted = _recorded_parts(record, producers)
    active = _active(hellos, edges, producers, wanted)
    recorders = {name for name, hello in hellos.items() if hello.role == "recorder"}
    inputs = {
        name: tuple(sorted((e for e in edges[name] if e.source in active), key=_edge_key)) for name in active
    }
    # A recorder takes what there is, and makes no demand: a run has the same products with and without one.
    consumed = {(e.topic, e.source) for name in active - recorders for e in inputs[name]}
    outputs = {
        name: tuple(sorted(t for t in hellos[name].outputs if (t, name) in consumed or t in wanted))
        for name in active
    }
    # What no service but the recorder takes is not produced, so there is no edge to the recorder either.
    inputs = {
        name: tuple(edge for edge in found if edge.topic in outputs[edge.source])
        for name, found in inputs.items()
    }
    demand = {
        name: tuple(
            Demand(topic=topic, parts=_parts(topic, hellos, active - recorders, wanted))
            for topic in outputs.get(name, ())
        )
        for name in hellos
    }
    _check_parts(hellos, active - recorders, wanted, demand)
    rank = {name: place for place, name in enumerate(order)}
    return Graph(
        order=tuple(name for name in order if name in active),
        inputs=inputs,
        latest={
            # Lag 1 was decided a frame ago; of the others the source deepest in the graph comes last.
            name: tuple(sorted(found, key=lambda edge: (edge.lag, -rank[edge.source])))
            for name, found in inputs.items()
        },
        consumers={
            name: tuple(sorted(c for c in active if any(e.source == name for e in inputs[c])))
            for name in active
        },
        outputs=outputs,
        demand=demand,
        producers=producers,
        retained=frozenset(e.source for found in inputs.values() for e in found if e.lag == 1),
        idle=tuple(sorted(hellos.keys() - active)),
    )


def check_prefixes(prefixes: Mapping[str, Iterable[str]]) -> None:
    """Raise `DeclarationError` where two worlds could give an object the same name (clause 3)."""
    claimed = [(prefix, world) for world, found in prefixes.items() for prefix in found]
    for index, (prefix, world) in enumerate(claimed):
        for other_prefix, other in claimed[:index]:
            # Prefixes of one another clash too: `car` owns `car-1`, and so would `car-`.
            if other != world and (prefix.startswith(other_prefix) or other_prefix.startswith(prefix)):
                raise DeclarationError(
                    f"worlds {other!r} and {world!r} clash: object names may begin with "
                    f"{other_prefix!r} in the one and {prefix!r} in the other; give one of them "
                    "another `prefix` in its settings"
                )


def check_actuators(actuators: Mapping[str, Iterable[str]]) -> None:
    """Raise `DeclarationError` where two agents own the same actuator (clauses 3 and 17)."""
    claimed = [(pattern, agent) for agent, found in actuators.items() for pattern in found]
    for index, (pattern, agent) in enumerate(claimed):
        for other_pattern, other in claimed[:index]:
            if other != agent and patterns_overlap(pattern, other_pattern):
                raise DeclarationError(
                    f"agents {other!r} and {agent!r} clash: an actuator may match {other_pattern!r} of the "
                    f"one and {pattern!r} of the other; give each its own `users`"
                )


def _edge_key(edge: Edge) -> tuple[str, str, int]:
    return edge.topic, edge.source, edge.lag


def _producers(hellos: Mapping[str, Hello]) -> dict[str, tuple[str, ...]]:
    found: dict[str, list[str]] = {}
    for name in sorted(hellos):
        for topic in hellos[name].outputs:
            found.setdefault(topic, []).append(name)
    return {topic: tuple(names) for topic, names in found.items()}


def _edges(hello: Hello, producers: Mapping[str, tuple[str, ...]]) -> list[Edge]:
    found: dict[tuple[str, str, int], Edge] = {}
    for entry in hello.inputs:
        if entry.topic == WILDCARD and hello.role != "recorder":
            raise DeclarationError(
                f"{hello.role} {hello.name!r} takes every topic ({WILDCARD!r}), which only a recorder may; "
                "name the topics it needs"
            )
        for topic in producers if entry.topic == WILDCARD else (entry.topic,):
            sources = producers.get(topic, ())
            if entry.required and not sources:
                raise DeclarationError(
                    f"{hello.role} {hello.name!r} needs topic {topic!r}, which no service of the run "
                    f"produces; add one that does (topics there are: {', '.join(sorted(producers))})"
                )
            # All sources of a topic: a consumer gets the scenes of all worlds.
            for source in sources:
                key = (topic, source, entry.lag)
                # A topic may be declared twice, by name and by the wildcard: what one of them needs is
                # needed.
                required = entry.required or (key in found and found[key].required)
                found[key] = Edge(topic, source, entry.lag, required)
    return list(found.values())


def _topological_order(hellos: Mapping[str, Hello], edges: Mapping[str, list[Edge]]) -> list[str]:
    # Depth first, by name, so that a consumer stands right after its sources; graphlib orders by levels.
    order: list[str] = []
    trail: list[Edge] = []

    def visit(name: str) -> None:
        if name in order:
            return
        for edge in edges[name]:
            if edge.lag == 0:
                trail.append(edge)
                sources = [e.source for e in trail[:-1]]
                if edge.source == name or edge.source in sources:
                    start = sources.index(edge.source) + 1 if edge.source in sources else len(trail) - 1
                    raise DeclarationError(_cycle(edge.source, trail[start:]))
                visit(edge.source)
                trail.pop()
        order.append(name)

    for name in sorted(hellos):
        visit(name)
    return order


def _cycle(first: str, edges: Iterable[Edge]) -> str:
    steps = f"{first!r}" + "".join(f" needs {e.topic!r} of {e.source!r}, which" for e in edges)
    return f"a cycle within one frame: {steps.removesuffix(', which')}; let one of these inputs have lag 1"


def _recorded_parts(record: Iterable[str], producers: Mapping[str, tuple[str, ...]]) -> dict[str, set[str]]:
    wanted: dict[str, set[str]] = {}
    for entry in record:
        topic, _, part = entry.partition(".")
        if topic not in producers:
            raise DeclarationError(
                f"run.record names {entry!r}, and no service of the run produces {topic!r}"
            )
        wanted.setdefault(topic, set()).update({part} - {""})
    return wanted


def _active(
    hellos: Mapping[str, Hello],
    edges: Mapping[str, list[Edge]],
    producers: Mapping[str, tuple[str, ...]],
    wanted: Mapping[str, set[str]],
) -> set[str]:
    active: set[str] = set()
    recorders = {name for name, hello in hellos.items() if hello.role == "recorder"}
    todo = [
        name for name, h in hellos.items() if h.role == "agent" or (not h.outputs and name not in recorders)
    ]
    # From what is there for its own sake back to all that it takes, at any lag.
    todo += [name for topic in wanted for name in producers[topic]]
    while todo:
        name = todo.pop()
        if name not in active:
            active.add(name)
            todo += [edge.source for edge in edges[name]]
    return active | recorders


def _parts(
    topic: str, hellos: Mapping[str, Hello], consumers: set[str], wanted: Mapping[str, set[str]]
) -> tuple[str, ...]:
    parts = set(wanted.get(topic, ()))
    for name in consumers:
        parts.update(part for entry in hellos[name].inputs if entry.topic == topic for part in entry.parts)
    return tuple(sorted(parts))


def _check_parts(
    hellos: Mapping[str, Hello],
    consumers: Iterable[str],
    wanted: Mapping[str, set[str]],
    demand: Mapping[str, tuple[Demand, ...]],
) -> None:
    """Raise `DeclarationError` where a service is asked for a part that its version does not have."""
    for name, entries in demand.items():
        for topic, part in [(entry.topic, part) for entry in entries for part in entry.parts]:
            # A part that has no entry came with its topic, in the first version.
            since = PARTS_SINCE.get(f"{topic}.{part}", "1.0")
            if hellos[name].version >= parse_version(since):
                continue
            askers = [
                f"{hellos[consumer].role} {consumer!r}"
                for consumer in sorted(consumers)
                if any(i.topic == topic and part in i.parts for i in hellos[consumer].inputs)
            ]
            askers += ["run.record"] * (part in wanted.get(topic, ()))
            spoken = ".".join(map(str, hellos[name].version))
            raise DeclarationError(
                f"{hellos[name].role} {name!r} speaks protocol {spoken}, which has no part {part!r} of topic "
                f"{topic!r}: protocol {since} brought it; update the service, or have {' and '.join(askers)} "
                "do without"
            )
