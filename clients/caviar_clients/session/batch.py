"""Many episodes of one scenario at once, in this process, for environments of which a learner steps a batch.

The worlds of a batch show the same in every episode: their scenes come from one embedded run, which also
prepares the services and checks what they say. Channels and links of all episodes are computed as arrays.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NoReturn

from caviar_clients.session.embedded import EmbeddedSession
from caviar_clients.session.prepared import PreparedScenario, implemented
from caviar_protocol.arrays import Int64Array
from caviar_protocol.errors import RunError
from caviar_protocol.messages import Input, Role
from caviar_protocol.scenario import Scenario
from caviar_protocol.scenario.rules import scenario_error
from caviar_protocol.topics import Action
from caviar_services.channel.base import ChannelModel, SceneAt
from caviar_services.channel.base import MemberSeed as MemberSeed
from caviar_services.link.base import BatchLink as BatchLink
from caviar_services.link.base import LinkBatch, LinkModel

REMEDY = (
    'make such environments one by one, by gymnasium.make_vec(…, vectorization_mode="sync"), a '
    'SyncVectorEnv, or "async", an AsyncVectorEnv'
)
_COMPUTED: tuple[Role, ...] = ("channel", "link")


def check_batch(scenario: Scenario | PreparedScenario, agent: str) -> None:
    """Check that many episodes of a scenario can be computed at once.

    Args:
        scenario: Checked, as `caviar_clients.session.prepared.prepare` returns it.
        agent: Whose place is taken.

    Raises:
        ScenarioError: They cannot; the text names the service, where it stands, and the remedy.

    Example:
        >>> from caviar_clients.session.prepared import prepare
        >>> check_batch(prepare("geometric"), "agent")
    """

    prepared = implemented(scenario)
    scenario = prepared.scenario

    def refuse(name: str, why: str) -> NoReturn:
        text = f"many episodes cannot be computed at once: {why}; {REMEDY}"
        raise scenario_error(scenario, f"services.{name}.use", text)

    for name, spec in scenario.services.items():
        called = f"{spec.role} {name!r}"
        if spec.role == "agent" and name != agent:
            refuse(name, f"{called} decides beside {agent!r}")
        if spec.role not in ("world", *_COMPUTED):
            continue  # recorders are left out, and of sensors nothing is observed
        if spec.remote:
            refuse(name, f"{called} is another program")
        if not prepared.services[name].cls.computes_batches(spec.settings):
            refuse(name, f"{called} is {spec.use!r}, which computes one episode at a time as it is set")
    for role in _COMPUTED:
        names = [name for name, spec in scenario.services.items() if spec.role == role]
        if len(names) != 1:
            text = f"a batch needs one {role}, and the scenario has {', '.join(names) or 'none'}; {REMEDY}"
            raise scenario_error(scenario, "services", text)


class BatchSession:
    """Episodes of M members that are in the same frame.

    Call `begin`, then `step` for each frame from 0 on, then `begin` again; `close` at the end.

    Args:
        scenario: Checked, as `caviar_clients.session.prepared.prepare` returns it.
        agent: Whose place is taken.
        members: M.

    Raises:
        ScenarioError: Many episodes of the scenario cannot be computed at once (`check_batch`).

    Example:
        >>> import numpy as np
        >>> from caviar_clients.session.prepared import prepare
        >>> session = BatchSession(prepare("geometric"), "agent", members=2)
        >>> session.begin([MemberSeed(5, 0), MemberSeed(6, 0)])
        >>> session.step(0, np.array([[3], [3]])).abs_y.shape
        (2, 1)
        >>> session.close()
    """

    def __init__(self, scenario: Scenario | PreparedScenario, agent: str, members: int) -> None:
        prepared = implemented(scenario)
        check_batch(prepared, agent)
        self.frames = prepared.scenario.run.frames
        """Frames of an episode."""
        self._members = members
        self._channel, self._link = (prepared.of_role(role)[0].name for role in _COMPUTED)
        inputs = (Input(topic="scene"), Input(topic="link", lag=1, required=False))
        self._session = EmbeddedSession(prepared, agent, inputs)
        # Of the frames that the run has come to. It is played once: scenes are the same in every episode.
        self._scenes: list[SceneAt] = []
        self._instants_ns: list[int] = []
        self._links: LinkBatch | None = None

    def begin(self, members: Sequence[MemberSeed]) -> None:
        """Begin an episode of each member.

        Args:
            members: A seed each.

        Raises:
            RunError: A service failed; the text has its name.
        """
        self._play_to(0)
        if self._links is None:
            channel, link = (self._session.service(name) for name in (self._channel, self._link))
            if not (isinstance(channel, ChannelModel) and isinstance(link, LinkModel)):
                raise RunError(f"{self._channel!r} and {self._link!r} are no channel and link")
            self._links = link.batch(channel.batch(), self._members, self.frames, self.scene_at)
        self._links.begin(members)

    def step(self, number: int, beams: Int64Array) -> BatchLink:
        """Score the beams of a frame.

        Args:
            number: Of the frame, which follows on the one before.
            beams: As in `caviar_services.link.base.LinkBatch.step`.

        Raises:
            RunError: No episode has begun, or a service failed.
        """
        if self._links is None:
            raise RunError("no episode has begun; call begin()")
        return self._links.step(number, beams)

    def scene_at(self, number: int) -> SceneAt:
        """The scene of a frame, by its number."""
        self._play_to(number)
        return self._scenes[number]

    def instant_ns(self, number: int) -> int:
        """Simulated time of a frame [ns]; that after the last one has one, too."""
        self._play_to(number)
        return self._instants_ns[number]

    def close(self) -> None:
        """End the run and close its services."""
        self._session.close()

    def _play_to(self, number: int) -> None:
        while len(self._instants_ns) <= number:
            begun = bool(self._instants_ns)
            frame = self._session.step({"action": Action(commands=())}) if begun else self._session.reset()
            self._instants_ns.append(frame.t_ns)
            if not frame.final:
                self._scenes.append(SceneAt(frame.number, frame.t_ns, frame.scene()))
