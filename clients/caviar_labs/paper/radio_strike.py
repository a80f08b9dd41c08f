"""Radio-Strike played by the agents of the challenge, under its own rules and with its defects mended."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from caviar_labs.paper.radio_strike_published import PublishedRun, Run, made_again, read_run
from caviar_labs.radio_strike.env import RadioStrikeEnv, Returned
from caviar_labs.radio_strike.rules import (
    BEAMS,
    USERS,
    Rays,
    RulesName,
    magnitudes,
    rules_of,
    straight_lines,
)
from caviar_labs.radio_strike.sources import Source, episode_loaders
from caviar_labs.radio_strike.trajectories import Episode
from caviar_protocol.arrays import Float64Array, Int64Array
from caviar_protocol.seeding import derive_seed

AgentName = Literal["B-Dummy", "straight line", "B-A2C", "B-BeamOracle"]

RULES: tuple[RulesName, ...] = ("legacy", "fixed")
AGENTS: tuple[AgentName, ...] = ("B-Dummy", "straight line", "B-A2C", "B-BeamOracle")
"""Random users and beams; users in turn with the beam along the straight line to where they were last; what
the challenge trains; users in turn with the best beam."""

TRAINING_EPISODES = 20
"""Episodes after those that are played, which B-A2C is trained on."""


@dataclass(frozen=True)
class Settings:
    """Agents, episodes and trainings of the experiment."""

    episodes: Source | Sequence[Source] | None = None
    """Sources of trajectories; None: made-up ones."""
    count: int = 10
    """Episodes that each agent plays."""
    steps: int = 4000
    """Of each at most: dense and light traffic twice each."""
    train_steps: int = 20_000
    """Of B-A2C; 0: it is left out."""
    published: Path | None = None
    """File of the published run."""
    repeats: int = 20
    """Times that the published run is played again."""
    seed: int = 1


@dataclass(frozen=True, eq=False)
class Played:
    """An agent in one episode, Shape ``[N]`` each."""

    reward: Float64Array
    bit_rate: Float64Array
    """[bit/s]."""
    sent: Float64Array
    dropped: Float64Array
    beam: Int64Array

    @property
    def delivered(self) -> float:
        """Share of the packets that were sent, of those that were sent or dropped."""
        gone = float(self.sent.sum() + self.dropped.sum())
        return float(self.sent.sum()) / gone if gone else 0.0

    @property
    def favourite(self) -> float:
        """Share of the steps that use the beam that is used most."""
        return float(np.bincount(self.beam).max()) / len(self.beam)


@dataclass(frozen=True)
class Report:
    """Returns by rules and agent, an entry for each episode; and the published run, once more."""

    played: dict[RulesName, dict[AgentName, list[Played]]]
    published: PublishedRun | None = None
    again: list[Run] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    """What was left out, and how to have it."""


class StraightLine:
    """Users in turn, each with the strongest beam along the straight line to where it was seen last.

    Args:
        rules: Have the codebook.
    """

    def __init__(self, rules: RulesName) -> None:
        self._rules = rules_of(rules)
        self._beams = [0] * len(USERS)

    def seen(self, user: int, position: Float64Array) -> None:
        """Note where a scheduled user was.

        Args:
            user: Its number.
            position: [m], Shape ``[3]``.
        """
        azimuth, zenith, level = straight_lines(position[None], self._rules)
        lone = Rays(*np.zeros((4, 1, 2)))
        every = np.arange(BEAMS)[None]
        self._beams[user] = int(magnitudes(self._rules, azimuth, zenith, level, lone, every).argmax())

    def beam(self, user: int) -> int:
        """The beam for a user.

        Args:
            user: Its number.
        """
        return self._beams[user]


def experiment(
    settings: Settings, progress: Callable[[str, float], None] = lambda what, share: None
) -> Report:
    """Play all agents under both rules, and the published run again.

    Args:
        settings: What is played.
        progress: Called with what is done and the share of all that is done.

    Raises:
        ScenarioError: A source or a file is wrong.
    """
    published = None if settings.published is None else read_run(settings.published)
    loaders = episode_loaders(settings.episodes)
    episodes = [load() for load in loaders[: settings.count]]
    agents = list(AGENTS)
    notes: list[str] = []
    training: list[Episode] = []
    if not settings.train_steps or not _can_train():
        agents.remove("B-A2C")
        missing = "it needs the extra `learning`" if settings.train_steps else "write --train-steps"
        notes.append(f"B-A2C is left out: {missing}.")
    else:
        training = [load() for load in loaders[settings.count : settings.count + TRAINING_EPISODES]]
        if not training:
            training = episodes
            notes.append("B-A2C was trained on the episodes that it plays: there are no others.")
    report = Report({rules: {agent: [] for agent in agents} for rules in RULES}, published, notes=notes)
    total, done = len(RULES) * len(agents), 0
    for rules in RULES:
        for agent in agents:
            progress(f"{rules}, {agent}", done / total)
            model = _trained(rules, training, settings) if agent == "B-A2C" else None
            for index, episode in enumerate(episodes):
                seed = derive_seed(settings.seed, index, f"radiostrike/{rules}")
                report.played[rules][agent].append(_play(rules, agent, model, episode, settings.steps, seed))
            done += 1
    if published is not None:
        progress("the published run", 1.0)
        report.again.extend(made_again(published, settings.seed + n) for n in range(settings.repeats))
    else:
        notes.append(
            "The published run is left out: name its file, data_output_optimun_traffic.csv of the "
            "challenge's code, by --published."
        )
    return report


def _can_train() -> bool:
    try:
        import stable_baselines3  # noqa: F401 - whether it is there
    except ImportError:
        return False
    return True


def _trained(rules: RulesName, episodes: Sequence[Episode], settings: Settings) -> Any:
    """B-A2C, with the settings of the challenge's baseline."""
    import torch
    from stable_baselines3 import A2C
    from stable_baselines3.common.logger import Logger

    # The network is tiny: threads that wait for each other take more time than its products.
    torch.set_num_threads(1)
    env = RadioStrikeEnv(rules, episodes=episodes)
    model = A2C("MlpPolicy", env, learning_rate=1e-3, n_steps=1, gamma=0.7, seed=settings.seed, device="cpu")
    # Its own logger makes a temporary folder that it never removes.
    model.set_logger(Logger(folder=None, output_formats=[]))
    # Of `legacy` a user that is always scheduled is at the end of its trajectories by then.
    most = sum(episode.steps for episode in episodes) if rules == "legacy" else settings.train_steps
    return model.learn(min(settings.train_steps, most))


def _play(rules: RulesName, agent: AgentName, model: Any, episode: Episode, steps: int, seed: int) -> Played:
    env = RadioStrikeEnv(rules, episodes=episode)
    observation, _ = env.reset(seed=seed)
    if agent == "B-A2C":
        model.set_random_seed(seed)
    rows, beams = np.zeros((min(steps, episode.steps), 4)), []
    for row, (beam, returned) in zip(rows, _steps(env, rules, agent, model, observation, seed), strict=False):
        _, reward, _, _, info = returned
        row[:] = reward, info["bit_rate"], info["pkts_transmitted"], info["pkts_dropped"]
        beams.append(beam)
    rewards, rates, sent, dropped = rows.T
    return Played(rewards, rates, sent, dropped, np.array(beams))


def _steps(
    env: RadioStrikeEnv, rules: RulesName, agent: AgentName, model: Any, observation: Float64Array, seed: int
) -> Iterator[tuple[int, Returned]]:
    """Beams and steps of an agent, one after the other, without an end."""
    random, straight = np.random.default_rng(seed), StraightLine(rules)
    step = 0
    while True:
        user = step % len(USERS)
        action = np.array([user, straight.beam(user)])
        match agent:
            case "B-Dummy":
                action = random.integers([len(USERS), BEAMS])
            case "B-A2C":
                # As the challenge plays it: actions are drawn from the policy.
                action = model.predict(observation)[0]
        returned = env.best_beam_step(user) if agent == "B-BeamOracle" else env.step(action)
        observation = returned[0]
        if agent == "straight line":
            straight.seen(user, observation[:3])
        step += 1
        yield int(returned[4].get("best_beam", action[1])), returned
