"""Membership of a run: how services get in, and who is there, silent or gone.

`Registration` takes a service from HELLO through the graph and PREPARE to READY, also one that comes back.
`Liveness` watches progress, loss and deadlines (contract, clauses 14 and 15).
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable

from caviar_broker.core import events as ev
from caviar_broker.core.episodes import Episodes
from caviar_broker.core.geometry import GEOMETRY, GEOMETRY_SINCE, has_capability
from caviar_broker.core.graph import build_graph, check_actuators, check_prefixes
from caviar_broker.core.run import Member, Run
from caviar_broker.core.transitions import RunEvent, RunState, ServiceEvent, ServiceState
from caviar_protocol.codec import check_version
from caviar_protocol.digest import geometry_digest
from caviar_protocol.errors import DeclarationError, VersionError, suggestion
from caviar_protocol.messages import (
    CAPABILITIES,
    PROTOCOL_VERSION,
    WARNING,
    Hello,
    Prepare,
    Ready,
    Refuse,
    Welcome,
)
from caviar_protocol.scenario.conversion import located
from caviar_protocol.topics import PARTS, PAYLOADS


class Registration:
    """Clauses 1 and 3 to 5: who takes part, with which declaration and which scenery.

    Args:
        run: The run.
        episodes: Begins once all services are ready, and takes back those that rejoin.
    """

    def __init__(self, run: Run, episodes: Episodes) -> None:
        self._run = run
        self._episodes = episodes

    # --- HELLO -------------------------------------------------------------------------------------

    def handle_hello(self, event: ev.Joined, now: int) -> None:
        """HELLO: welcome it, or turn it away."""
        run, hello = self._run, event.hello
        refusal = self._refusal(hello)
        if refusal is not None:
            run.actions.append(ev.TurnAway(hello.name, refusal))
            if refusal.code in ("version", "declaration"):  # waiting would not mend it
                run.fail(f"{hello.role} {hello.name!r} was refused: {refusal.message}", hello.name, now)
            return
        member = run.members[hello.name]
        if member.state is ServiceState.LOST:
            run.notice("back", member.name, f"{member} came back after {(now - member.since) / 1e9:.3g} s")
        # Before WELCOME is made, which carries the attempt that this counts.
        member.join(hello, now)
        run.send(
            member,
            Welcome(
                version=PROTOCOL_VERSION,
                run=run.plan.run,
                epoch=run.plan.epoch,
                attempt=member.attempt,
                capabilities=tuple(c for c in hello.capabilities if c in CAPABILITIES),
                heartbeat_ns=run.plan.timeouts.heartbeat,
                liveness_ns=run.plan.timeouts.liveness,
                seed=run.plan.seed,
                settings=run.swaps.settings(member.name, member.plan.settings),
                scenario=dict(member.plan.scenario),
                rejoin_ns=self._held_open(member, event.local),
            ),
        )
        # The graph needs every declaration; one that comes back later is prepared by the graph that there is.
        if run.state is RunState.JOINING:
            if all(p.state is ServiceState.JOINED for p in run.members.values()):
                self._all_joined(now)
        else:
            self._prepare_whoever_can(now)

    def _held_open(self, member: Member, local: bool) -> int:
        """Time in which a service may come back by itself once its connections are lost [ns].

        A connection within one machine is lost with the broker alone. What started the broker starts the
        local services again too, and one that tried to come back would take the place of its successor.
        """
        return member.rejoin(self._run.plan.timeouts) if member.plan.remote or not local else 0

    def _refusal(self, hello: Hello) -> Refuse | None:
        member = self._run.members.get(hello.name)
        if member is None:
            near = difflib.get_close_matches(hello.name, self._run.members, n=1)
            hint = f"did you mean {near[0]!r}? " if near else ""
            expected = ", ".join(sorted(self._run.members))
            return Refuse(
                code="unknown-name",
                message=f"the run has no service {hello.name!r}; {hint}it expects: {expected}",
            )
        # Not fatal: it may have been started while the last frames were run.
        if self._run.over:
            return Refuse(code="late", message="the run is over")
        if member.state not in (ServiceState.EXPECTED, ServiceState.LOST):
            return Refuse(
                code="name-taken",
                message=f"a service named {hello.name!r} takes part already; end it or use another name",
            )
        try:
            check_version(hello.version)
        except VersionError as error:
            return Refuse(code="version", message=str(error))
        for feature in member.plan.features:
            if hello.version < feature.since:
                text = (
                    f"{feature.key}: {member} speaks protocol {_dotted(hello.version)}, which does not know "
                    f"{feature.text}: protocol {_dotted(feature.since)} brought it; update the service, or "
                    "do without the key"
                )
                return Refuse(code="version", message=located(text, member.name, self._run.plan.source))
        contradiction = _contradiction(member, hello)
        return Refuse(code="declaration", message=contradiction) if contradiction else None

    def _all_joined(self, now: int) -> None:
        run = self._run
        hellos = {name: member.hello for name, member in run.members.items() if member.hello}
        try:
            run.graph = build_graph(hellos, run.plan.record)
        except DeclarationError as error:
            run.fail(str(error), "", now)
            return
        run.enter(RunEvent.ALL_JOINED, now)
        for name in run.graph.idle:
            outputs = hellos[name].outputs
            add = " or ".join(f'"{topic}"' for topic in outputs)
            text = f"no service takes its {', '.join(outputs)}, so it is not run; add {add} to run.record"
            run.notice("idle", name, text)
        self._prepare_whoever_can(now)

    # --- PREPARE and READY ---------------------------------------------------------------------------

    def _prepare_whoever_can(self, now: int) -> None:
        """Worlds load first; their scenery is known once they are ready, and all others load with it."""
        run = self._run
        assert run.graph is not None
        # Worlds first, since all others load the scenery that worlds offer between PREPARE and READY.
        worlds = [p for p in run.members.values() if p.role == "world" and run.takes_part(p)]
        scenery_is_known = all(p.ready for p in worlds)
        if scenery_is_known and (missing := self._missing_pattern()):
            run.fail(*missing, now)
            return
        for member in run.members.values():
            if member.state is ServiceState.JOINED and (member.role == "world" or scenery_is_known):
                member.move(ServiceEvent.PREPARE, now)
                prepare = Prepare(
                    epoch=run.plan.epoch,
                    attempt=member.attempt,
                    demand=run.graph.demand[member.name],
                    assets=() if member.role == "world" else run.scenery(),
                    producers=dict(run.graph.producers),
                    prefixes={} if member.role == "world" else _prefixes(worlds),
                    max_faces=self._most_faces(member),
                )
                run.send(member, prepare)

    def _most_faces(self, member: Member) -> int:
        """Triangles that a mesh may have which a world announces while the run goes on; 0: it may not."""
        run = self._run
        if member.role != "world" or not has_capability(member, GEOMETRY):
            return 0
        # A scene may then name a mesh that was not in PREPARE, which a reader of an earlier version refuses.
        for other in run.members.values():
            takes = other.hello is not None and any(i.topic in ("scene", "*") for i in other.hello.inputs)
            if takes and other.hello is not None and other.hello.version < GEOMETRY_SINCE:
                text = (
                    f"{member} may announce no meshes while the run goes on: {other} speaks protocol "
                    f"{_dotted(other.hello.version)}, which does not know them: protocol "
                    f"{_dotted(GEOMETRY_SINCE)} brought them; update the service. Its objects are boxes"
                )
                run.notice("warning", member.name, text)
                return 0
        return run.plan.max_faces

    def _missing_pattern(self) -> tuple[str, str] | None:
        """Message about the first pattern file that neither a world nor the broker has, and its world."""
        known = {asset.name for asset in self._run.scenery()}
        for pattern in self._run.plan.patterns:
            if pattern.name not in known:
                text = (
                    f"{pattern.key}: world {pattern.world!r} offers no {pattern.name!r}, and the broker has "
                    f"no file {pattern.path}; put it there, or have the world offer it"
                )
                return located(text, pattern.world, self._run.plan.source), pattern.world
        return None

    def handle_asset_offer(self, event: ev.AssetsOffered, now: int) -> None:
        """A world's scenery: one name stands for one file in the run (clause 4)."""
        run, member = self._run, self._run.members[event.service]
        if member.state is not ServiceState.PREPARING or member.role != "world":
            run.unexpected(member, "ASSET_OFFER", "only of a world, between PREPARE and READY")
            return
        digests = {asset.name: asset.digest for asset in event.assets}
        # Others have loaded what it offered first: the run would continue with two geometries.
        if member.ready and digests != {asset.name: asset.digest for asset in member.assets}:
            self._refuse(member, "geometry", f"{member} came back with other scenery than it had before", now)
            return
        for other in run.members.values():
            clashing = [a.name for a in other.assets if digests.get(a.name, a.digest) != a.digest]
            if other is not member and clashing:
                text = f"{other} and {member} bring different files named {clashing[0]!r}; rename one of them"
                self._refuse(member, "clash", text, now)
                return
        for pattern in run.plan.patterns:
            offered = digests.get(pattern.name)
            if offered and pattern.asset and offered != pattern.asset.digest:
                text = (
                    f"{pattern.key}: {member} offers another file as {pattern.name!r} than the scenario's "
                    f"{pattern.path}: have it offer that one, or none, and the broker does"
                )
                self._refuse(member, "geometry", located(text, member.name, run.plan.source), now)
                return
        # An offer is progress: a world that reads a large scene sends no READY for a while.
        member.assets, member.advanced_at = event.assets, now

    def handle_ready(self, event: ev.ReadyReceived, now: int) -> None:
        """READY: check what it claims, and go on when all services are ready."""
        run, member, message = self._run, self._run.members[event.service], event.message
        if not run.current(member, message.epoch, message.attempt, "READY"):
            return
        if member.state is ServiceState.RESTORING:
            self._episodes.checkpoints.handle_ready(member, now)
            return
        if member.state is not ServiceState.PREPARING:
            run.unexpected(member, "READY", "once, after PREPARE")
            return
        member.move(ServiceEvent.READY, now)
        for note in message.notes:
            kind = "warning" if note.startswith(WARNING) else "note"
            run.notice(kind, member.name, note.removeprefix(WARNING))
        if not self._accepted(member, message, now):
            return
        member.ready = message
        # After the first episode an agent chooses seeds with DONE; a run that goes on has its seed.
        if message.seed >= 0 and run.state is RunState.PREPARING and run.resumption is None:
            run.wish(message.seed, member, now)
        self._prepare_whoever_can(now)
        if run.state is not RunState.PREPARING:
            self._episodes.reset(member, now)
        elif all(p.state is ServiceState.READY for p in run.members.values() if run.takes_part(p)):
            run.enter(RunEvent.ALL_READY, now)
            self._episodes.begin(now)

    def _accepted(self, member: Member, message: Ready, now: int) -> bool:
        """Whether a READY agrees with what others hold and own; else the run ends (clauses 3 and 4)."""
        # A service without geometry says none, and an empty digest is no contradiction.
        expected = geometry_digest(self._run.scenery())
        if member.role != "world" and message.geometry and message.geometry != expected:
            text = (
                f"{member} holds scenery {message.geometry[:12]}…, the worlds announced "
                f"{expected[:12] or 'none'}…; clear its asset cache and start it again"
            )
            self._refuse(member, "geometry", text, now)
            return False
        # Of all that are ready by now: the one that is last to say so finds each clash.
        claims = {p.name: p.ready for p in self._run.members.values() if p.ready} | {member.name: message}
        try:
            worlds = {n: r.prefixes for n, r in claims.items() if self._run.members[n].role == "world"}
            check_prefixes(worlds)
            check_actuators({n: r.actuators for n, r in claims.items()})
        except DeclarationError as error:
            self._refuse(member, "clash", str(error), now)
            return False
        return True

    def _refuse(self, member: Member, code: str, text: str, now: int) -> None:
        self._run.send(member, Refuse(code=code, message=text))
        self._run.fail(text, member.name, now)


def _prefixes(worlds: Iterable[Member]) -> dict[str, tuple[str, ...]]:
    """Prefixes of the names of objects, by world that is ready."""
    return {world.name: world.ready.prefixes for world in worlds if world.ready}


def _dotted(version: tuple[int, int]) -> str:
    return ".".join(map(str, version))


def _contradiction(member: Member, hello: Hello) -> str:
    """Contradiction of a HELLO to the scenario, or to what the service said before; empty: there is none."""
    if hello.role != member.role:
        return f"{hello.name!r} is the run's {member.role}, this one says that its role is {hello.role}"
    if member.plan.use and hello.implementation and hello.implementation != member.plan.use:
        return (
            f"{hello.name!r} is {hello.implementation!r}, the scenario says use = {member.plan.use!r}; "
            "start that one, or change the scenario, which is recorded with the run"
        )
    if unknown := _unknown_part(hello):
        return unknown
    # The graph was built from the declaration before, and products were granted by it.
    before = member.hello
    if before is not None and (hello.inputs, hello.outputs) != (before.inputs, before.outputs):
        return f"{hello.name!r} came back with other inputs or outputs than it had before"
    return ""


def _unknown_part(hello: Hello) -> str:
    """The first part that a HELLO asks for and its topic does not have; empty: none.

    A service of a later minor version than the broker's may know further ones.
    """
    if hello.version > PROTOCOL_VERSION:
        return ""
    for entry in hello.inputs:
        known = PARTS.get(entry.topic, ())
        for part in entry.parts:
            if entry.topic in PAYLOADS and part not in known:
                hint = suggestion(part, known) if known else "it has none"
                asked = f"{hello.name!r} asks for the part {part!r} of topic {entry.topic!r}"
                return f"{asked}, which has no such part; {hint}"
    return ""


MAX_LOSSES = 5
"""A service that was lost so often without an answer in between is not waited for again."""


class Liveness:
    """Notices of life and death, and what becomes of silence.

    Args:
        run: The run.
        episodes: What services owe now.
    """

    def __init__(self, run: Run, episodes: Episodes) -> None:
        self._run = run
        self._episodes = episodes

    # --- life and death ------------------------------------------------------------------------------

    def handle_heartbeat(self, event: ev.Progressed, now: int) -> None:
        """A heartbeat."""
        self._run.members[event.service].heartbeat(event.progress, event.phase, event.grace_ns, now)

    def handle_violation(self, event: ev.Violated, now: int) -> None:
        """A service broke the protocol beyond repair."""
        self._run.fail(f"{self._run.members[event.service]} {event.text}", event.service, now)

    def handle_bye(self, event: ev.ByeReceived, now: int) -> None:
        """A service leaves: after SHUTDOWN, or on its own account."""
        member = self._run.members[event.service]
        if member.present and self._run.over:
            member.move(ServiceEvent.BYE, now)
        elif member.present:
            self.handle_loss(ev.Lost(event.service, f"it left: {event.reason or 'no reason given'}"), now)

    def handle_loss(self, event: ev.Lost, now: int) -> None:
        """A service died; the run ends, unless it can do without it or wait for its return."""
        run, member = self._run, self._run.members[event.service]
        # Several witnesses report one death: the descriptor of its process, the launcher, the connection.
        if member.state in (ServiceState.LOST, ServiceState.LEFT):
            return
        dispatcher = self._episodes.dispatcher if run.takes_part(member) else None
        owed = dispatcher.outstanding(member.name) if dispatcher else []
        text = f"{member} died while {member.doing}: {event.verdict}; {member.last_words(now)}"
        if owed and dispatcher:
            died = f"died ({event.verdict})"
            text = member.blame_task(owed[0], died, now, dispatcher.table.describe_waiting(member.name))
        member.verdict = event.verdict
        # Counted before it is asked whether the service may come back.
        member.losses += 1
        member.move(ServiceEvent.LOST, now)
        if run.over:
            return
        run.notice("lost", member.name, text, owed[0].frame if owed else -1)
        if not run.takes_part(member):
            return
        # Whether the loss of a service is survived for a while: it was ready once, perhaps under a broker
        # before, or is started by hand and can be again; and it got somewhere.
        was_ready = member.ready is not None or member.plan.remote or self._run.plan.epoch > 1
        if not (member.rejoin(self._run.plan.timeouts) > 0 and was_ready and member.losses < MAX_LOSSES):
            run.fail(text, member.name, now)
            return
        limit = member.rejoin(run.plan.timeouts) / 1e9
        text = f"{member} is away; the run waits for it for at most {limit:g} s (timeouts.rejoin_s)"
        run.notice("away", member.name, text, owed[0].frame if owed else -1)
        if dispatcher:
            dispatcher.suspend_service(member.name)

    # --- deadlines -----------------------------------------------------------------------------------

    def next_deadline(self) -> int | None:
        """Instant at which the silence of a service is too long [ns]; None: none has to say anything."""
        run = self._run
        if run.state is RunState.FINISHED:
            return None
        if run.state is RunState.STOPPING:
            return run.since + run.plan.timeouts.shutdown
        # A disk that takes nothing stalls the run as a service does.
        waiting = run.ledger.waiting_since
        earliest = None if waiting is None else waiting + run.plan.timeouts.stall
        for member in run.members.values():
            due = self._due(member)
            if due is not None and (earliest is None or due < earliest):
                earliest = due
        return earliest

    def expire(self, now: int) -> None:
        """Act on silence that has been too long: the run ends with blame."""
        run = self._run
        if run.state is RunState.STOPPING:
            if run.since + run.plan.timeouts.shutdown <= now:
                for member in self._run.members.values():
                    if member.present:
                        words = member.last_words(now)
                        text = f"{member} did not say BYE in time (timeouts.shutdown_s); {words}"
                        self._run.notice("lost", member.name, text)
                        member.move(ServiceEvent.LOST, now)
            return
        if run.over:
            return
        # The longest silence is the cause; others may be silent because they wait for that service.
        silent = [(due, p) for p in run.members.values() if (due := self._due(p)) is not None and due <= now]
        if silent:
            _, culprit = min(silent, key=lambda pair: pair[0])
            run.fail(self._blame(culprit, now), culprit.name, now)
        elif (since := run.ledger.waiting_since) is not None and since + run.plan.timeouts.stall <= now:
            waited = run.plan.timeouts.stall / 1e9
            run.fail(f"the journal was not written for {waited:g} s; the disk may be full or gone", "", now)

    def _due(self, member: Member) -> int | None:
        """Instant by which a service has to show life or progress [ns]."""
        timeouts = self._run.plan.timeouts
        if not self._run.takes_part(member):
            return None
        match member.state:
            case ServiceState.EXPECTED:
                return self._run.since + timeouts.connect
            case ServiceState.PREPARING:
                return member.silent_until(member.since, timeouts.ready)
            case ServiceState.RESETTING | ServiceState.RESTORING:
                return member.silent_until(member.since, timeouts.reset)
            case ServiceState.LOST:
                return member.since + member.rejoin(timeouts)
            case ServiceState.ACTIVE:
                dispatcher = self._episodes.dispatcher
                task = dispatcher.awaited(member.name) if dispatcher else None
                since = task.started_at if task else self._saving_since(member)
                since = self._loading_since(member) if since is None else since
                return None if since is None else member.silent_until(since, timeouts.stall)
            case _:
                return None  # it waits for others

    def _saving_since(self, member: Member) -> int | None:
        """Since when a service without which the run cannot go on saves its state [ns]."""
        return self._episodes.checkpoints.saving_since(member) if member.plan.is_indispensable else None

    def _loading_since(self, member: Member) -> int | None:
        """Since when frames wait for a service to load the meshes of GEOMETRY [ns]."""
        return self._episodes.geometry.awaited_since(member) if member.plan.is_indispensable else None

    def _blame(self, member: Member, now: int) -> str:
        timeouts, dispatcher = self._run.plan.timeouts, self._episodes.dispatcher
        task = dispatcher.awaited(member.name) if dispatcher and member.state is ServiceState.ACTIVE else None
        if dispatcher and task:
            waiting = dispatcher.table.describe_waiting(member.name)
            return member.blame_task(task, "makes no progress (timeouts.stall_s)", now, waiting)
        match member.state:
            case ServiceState.ACTIVE:
                saving, loading = self._saving_since(member), self._loading_since(member)
                asked = saving if saving is not None else loading if loading is not None else now
                order = "CHECKPOINT" if saving is not None else "GEOMETRY"
                words = f"makes no progress (timeouts.stall_s): {(now - asked) / 1e9:.3g} s since {order}"
                return f"{member} {words}; {member.last_words(now)}"
            case ServiceState.EXPECTED:
                missing = [p for p in self._run.members.values() if p.state is ServiceState.EXPECTED]
                names = ", ".join(str(p) for p in missing)
                remote = [p.name for p in missing if p.plan.remote]
                hint = f"; start {' and '.join(remote)} while the run waits" if remote else ""
                waited = f"{timeouts.connect / 1e9:g} s (timeouts.connect_s)"
                return f"{names} did not connect within {waited}{hint}"
            case ServiceState.LOST:
                waited = f"{member.rejoin(timeouts) / 1e9:g} s (timeouts.rejoin_s)"
                return f"{member} died and did not come back within {waited}: {member.verdict}"
            case _:
                key = "ready_s" if member.state is ServiceState.PREPARING else "reset_s"
                return member.blame(f"makes no progress (timeouts.{key}) while {member.doing}", now)
