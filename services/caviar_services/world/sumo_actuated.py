"""World ``sumo-actuated``: the world ``sumo`` whose vehicles and traffic lights agents command.

It is an implementation of its own because commands close the loop: a frame waits for the actions of the one
before, while frames of ``sumo`` overlap.
"""

from __future__ import annotations

from typing import ClassVar

from caviar_protocol.errors import RunError
from caviar_protocol.messages import Input
from caviar_protocol.topics import Action
from caviar_services.service import Frame, Preparation, Prepared, RunInfo, StepResult
from caviar_services.world.sumo import SumoSettings, SumoWorld
from caviar_services.world.sumo_commands import Commanded, carry_out, traffic_commands


class ActuatedSumoWorld(SumoWorld):
    """Traffic of a SUMO network that obeys `DriveCommand` and `SignalCommand`.

    Commands are carried out at the beginning of the frame after the one in which they were decided. Traffic
    lights have the names of SUMO behind the world's prefix.

    Args:
        settings: Those of the world ``sumo``.
        run: What the world knows about the run.

    Example:
        >>> world = ActuatedSumoWorld(SumoSettings(net="/maps/town.net.xml"), RunInfo(name="traffic"))
        >>> [entry.topic for entry in world.inputs]
        ['action']
    """

    inputs: ClassVar[tuple[Input, ...]] = (Input(topic="action", lag=1, required=False),)

    def __init__(self, settings: SumoSettings, run: RunInfo) -> None:
        super().__init__(settings, run)
        self._alone = True
        self._knows_past = False

    def prepare(self, preparation: Preparation) -> Prepared:
        """See `SumoWorld.prepare`.

        Args:
            preparation: Who else brings scenes, among others.
        """
        self._alone = len(preparation.producers.get("scene", ())) <= 1
        return super().prepare(preparation)

    def begin(self, episode: int, seed: int) -> None:
        """See `SumoWorld.begin`.

        Args:
            episode, seed: Which.
        """
        self._knows_past = False
        super().begin(episode, seed)

    def step(self, frame: Frame) -> StepResult:
        """See `SumoWorld.step`; commands act from the state of the frame before on.

        Args:
            frame: With the actions of the frame before.

        Raises:
            PayloadError: A command is for what is not there, or has a value that is not.
            RunError: The process before this one took the commands of the episode with it.
        """
        if frame.number > 0 and not self._knows_past:
            raise RunError(
                f"world {self.run.name!r} came back in frame {frame.number}: what agents had commanded is "
                "lost with the process that knew it; have states saved (run.checkpoint_frames above 0), "
                "and start the run again"
            )
        self._knows_past = True
        actions = frame.payloads("action", Action)
        commands = traffic_commands(actions, self.run.name, self._prefix, alone=self._alone)
        if commands:
            carry_out(self._started().api, commands, self._prefix)
            self._commanded.append(Commanded(step=self._steps, commands=commands))
        return super().step(frame)

    def restore(self, state: bytes) -> None:
        """See `SumoWorld.restore`.

        Args:
            state: Of `checkpoint`, with all commands of the episode.
        """
        super().restore(state)
        self._knows_past = True
