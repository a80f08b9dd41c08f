"""Agent ``learner``: online learning, as in the paper (section 2): a model that trains while it serves.

A perceptron estimates what each beam pair is worth to a user, from parts of the observation. In every frame
it learns from the feedback of the frame before and from what it remembers, then chooses the best pair for
each user; now and then it tries one at random. All users with equal codebooks share a perceptron, and learn
from each other.

Weights, memory and what is asked are state: checkpointed, so that an agent that is killed goes on with the
same bytes. Draws are seeded by frame. As all state of a service it ends with the episode.

A perceptron in NumPy that learns what each of several choices is worth, quick enough for every frame.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Annotated, Any, ClassVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from caviar_protocol.arrays import Float64Array, Int64Array, quantity
from caviar_protocol.errors import ScenarioError, suggestion
from caviar_protocol.observations import FAR, KnownDevices, KnownScenario, Moment, Observer, Users
from caviar_protocol.scenario import Scenario
from caviar_protocol.scenario.conversion import Place
from caviar_protocol.seeding import generator
from caviar_protocol.space.scene import Pair
from caviar_protocol.topics import BeamChoice, Link, Scene
from caviar_services.agent.bandits import Feedback, Feedbacks
from caviar_services.agent.base import Agent, AgentSettings
from caviar_services.checkpoint import Packed, restored, saved
from caviar_services.service import Frame, Preparation, Prepared, RunInfo

_DECAY = 0.9, 0.999
_EPSILON = 1e-8


class PerceptronState(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """What a `Perceptron` learnt."""

    updates: int
    parameters: tuple[Packed, ...]
    means: tuple[Packed, ...]
    squares: tuple[Packed, ...]


class Perceptron:
    """Layers of rectified linear units, and a linear one with an output for each choice.

    It is trained on the outputs of the choices that were made alone, by Adam (Kingma and Ba, "Adam: a method
    for stochastic optimization", ICLR 2015).

    Args:
        sizes: Number of features, of the units of each hidden layer, and of choices.
        generator: Draws the weights, of He et al. ("Delving deep into rectifiers", ICCV 2015).

    Example:
        >>> rng = np.random.default_rng(0)
        >>> network = Perceptron((1, 16, 2), rng)
        >>> for _ in range(300):
        ...     x, chosen = rng.uniform(-1, 1, (32, 1)), rng.integers(2, size=32)
        ...     network.learn(x, chosen, np.where(chosen == 0, x[:, 0], -x[:, 0]), 1e-2)
        >>> network.values(np.array([[0.8], [-0.8]])).argmax(1).tolist()  # the first is worth x, the other −x
        [0, 1]
    """

    def __init__(self, sizes: Sequence[int], generator: np.random.Generator) -> None:
        self._parameters: list[Float64Array] = []
        for inputs, outputs in pairwise(sizes):
            self._parameters += [
                generator.standard_normal((inputs, outputs)) * np.sqrt(2 / inputs),
                np.zeros(outputs),
            ]
        self._parameters[-2] *= 0.1  # at first all choices are worth much the same
        self._means = [np.zeros_like(p) for p in self._parameters]
        self._squares = [np.zeros_like(p) for p in self._parameters]
        self.updates = 0
        """Number of steps of training."""

    def values(self, features: Float64Array) -> Float64Array:
        """Estimate what each choice is worth.

        Args:
            features: Shape ``[N, F]``.

        Returns:
            Shape ``[N, A]``.
        """
        values: Float64Array = self._hidden(features)[-1] @ self._parameters[-2] + self._parameters[-1]
        return values

    def learn(self, features: Float64Array, chosen: Int64Array, worth: Float64Array, rate: float) -> None:
        """Take a step towards what some choices were worth: of the mean of the squares of the errors.

        Args:
            features: Shape ``[N, F]``.
            chosen: Index of each choice, Shape ``[N]``.
            worth: What it was worth, Shape ``[N]``.
            rate: Of learning.
        """
        layers = self._hidden(features)
        weights, offsets = self._parameters[-2:]
        # Of the last layer only the columns of what was chosen: a codebook has thousands of pairs.
        columns = weights[:, chosen]
        error = (np.einsum("nh,hn->n", layers[-1], columns) + offsets[chosen] - worth) * (2 / len(worth))
        gradients = [np.zeros_like(weights), np.zeros_like(offsets)]
        np.add.at(gradients[0].T, chosen, error[:, None] * layers[-1])
        np.add.at(gradients[1], chosen, error)
        below = error[:, None] * columns.T
        for layer in range(len(layers) - 2, -1, -1):
            below = below * (layers[layer + 1] > 0)
            gradients[:0] = [layers[layer].T @ below, below.sum(0)]
            below = below @ self._parameters[2 * layer].T
        self.updates += 1
        first, second = (1 - decay**self.updates for decay in _DECAY)
        for parameter, mean, square, gradient in zip(
            self._parameters, self._means, self._squares, gradients, strict=True
        ):
            mean += (1 - _DECAY[0]) * (gradient - mean)
            square += (1 - _DECAY[1]) * (gradient**2 - square)
            parameter -= rate * (mean / first) / (np.sqrt(square / second) + _EPSILON)

    def state(self) -> PerceptronState:
        """What it learnt, to be saved."""
        return PerceptronState(
            self.updates,
            *(
                tuple(Packed.of(array, "<f8") for array in arrays)
                for arrays in (self._parameters, self._means, self._squares)
            ),
        )

    @classmethod
    def restored(cls, state: PerceptronState) -> Perceptron:
        """The perceptron of a `state`.

        Args:
            state: What `state` gave.
        """
        network = cls.__new__(cls)
        network.updates = state.updates
        network._parameters = [packed.array(np.float64) for packed in state.parameters]
        network._means = [packed.array(np.float64) for packed in state.means]
        network._squares = [packed.array(np.float64) for packed in state.squares]
        return network

    def _hidden(self, features: Float64Array) -> list[Float64Array]:
        """The features, and what comes out of each hidden layer."""
        layers = [features]
        for weights, offsets in zip(self._parameters[:-2:2], self._parameters[1:-2:2], strict=True):
            layers.append(np.maximum(layers[-1] @ weights + offsets, 0.0))
        return layers


Units = Annotated[int, quantity("1", "units of a hidden layer", ge=1, le=4096)]
Scale = Annotated[float, quantity("1", "what a part is divided by, in its unit", gt=0)]


MOST_WEIGHTS = 2**22
"""Between hidden layers: with more, an update takes longer than frames are apart."""


class LearnerSettings(AgentSettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the agent ``learner``."""

    observe: tuple[str, ...] = ("aod",)
    """Parts of the observation (`caviar_protocol.observations.PARTS`) that come from scene and link."""
    scale: dict[str, Scale] = msgspec.field(default_factory=dict)
    """What a part is divided by; of those that are left out their bound, or 1 where they have none."""
    waves: Annotated[
        int, quantity("1", "sines and cosines of each number, up to this multiple", ge=0, le=64)
    ] = 8
    """Of π times the scaled number: of an angle those of its multiples."""
    feedback: Feedback = "abs_y"
    """What a receiver feeds back of the frame before: ``abs_y`` or ``spectral_efficiency``."""
    hidden: tuple[Units, ...] = (64, 64)
    """Units of each hidden layer; none: a linear model."""
    learning_rate: Annotated[float, quantity("1", "of Adam", gt=0, le=1)] = 2e-3
    batch: Annotated[int, quantity("1", "choices that an update learns from", ge=1, le=4096)] = 32
    updates: Annotated[int, quantity("1", "of each perceptron in a frame", ge=0, le=100)] = 2
    memory: Annotated[int, quantity("1", "choices that are remembered", ge=1, le=1_000_000)] = 2000
    explore_frames: Annotated[
        int, quantity("frame", "until choices at random become as rare as they stay", ge=1, le=10**9)
    ] = 300
    explore_least: Annotated[float, quantity("1", "share of choices at random then", ge=0, le=1)] = 0.05


class _Asked(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """A choice that no feedback came to yet."""

    tx: str
    rx: str
    beams: tuple[int, int]
    """Sizes of both codebooks."""
    pair: int
    features: Packed


class _ModelState(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    beams: tuple[int, int]
    network: PerceptronState
    features: Packed
    pairs: Packed
    worth: Packed
    seen: int
    highest: float


class _LearnerState(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    models: tuple[_ModelState, ...]
    asked: tuple[_Asked, ...]


class Model:
    """The perceptron of all users with equal codebooks, and the choices that it remembers.

    Args:
        network: The perceptron.
        features: How many numbers it takes.
        size: Choices that are remembered; then the oldest make room.
    """

    def __init__(self, network: Perceptron, features: int, size: int) -> None:
        self.network = network
        self.seen = 0
        """Choices so far."""
        self.highest = 0.0
        """Highest feedback so far, by which feedback is divided."""
        self._features: Float64Array = np.zeros((size, features))
        self._pairs: Int64Array = np.zeros(size, np.int64)
        self._worth: Float64Array = np.zeros(size)

    def remember(self, features: Float64Array, pair: int, worth: float) -> None:
        """Keep a choice and its feedback."""
        place = self.seen % len(self._pairs)
        self._features[place], self._pairs[place], self._worth[place] = features, pair, worth
        self.seen += 1
        self.highest = max(self.highest, worth)

    def learn(self, draws: np.random.Generator, batch: int, rate: float) -> None:
        """Learn from some of what is remembered."""
        rows = draws.integers(min(self.seen, len(self._pairs)), size=batch)
        scale = self.highest or 1.0
        self.network.learn(self._features[rows], self._pairs[rows], self._worth[rows] / scale, rate)

    def state(self, beams: tuple[int, int]) -> _ModelState:
        """All of it, to be saved."""
        count = min(self.seen, len(self._pairs))
        return _ModelState(
            beams=beams,
            network=self.network.state(),
            features=Packed.of(self._features[:count], "<f8"),
            pairs=Packed.of(self._pairs[:count], "<i8"),
            worth=Packed.of(self._worth[:count], "<f8"),
            seen=self.seen,
            highest=self.highest,
        )

    @classmethod
    def restored(cls, state: _ModelState, size: int) -> Model:
        """The model of a `state`."""
        features = state.features.array(np.float64)
        model = cls(Perceptron.restored(state.network), features.shape[1], size)
        count = len(features)
        model._features[:count], model._pairs[:count] = features, state.pairs.array(np.int64)
        model._worth[:count] = state.worth.array(np.float64)
        model.seen, model.highest = state.seen, state.highest
        return model


class LearnerAgent(Agent[LearnerSettings]):
    """Learns which beams are worth most while it serves.

    Args:
        settings: Users, observation, perceptron and exploration.
        run: What the agent knows about the run.

    Raises:
        ScenarioError: A part of the observation does not exist, or needs a sensor.
    """

    Settings: ClassVar[type[msgspec.Struct]] = LearnerSettings
    checkpoints: ClassVar[bool] = True
    _observer: Observer
    _places: Users

    def __init__(self, settings: LearnerSettings, run: RunInfo) -> None:
        super().__init__(settings, run)
        self._models: dict[tuple[int, int], Model] = {}
        self._asked: tuple[_Asked, ...] = ()
        self._episode = 0, 0

    @classmethod
    def check_settings(cls, settings: LearnerSettings, place: Place) -> None:
        """Refuse a perceptron that could not serve in time."""
        weights = sum(a * b for a, b in pairwise(settings.hidden))
        if weights > MOST_WEIGHTS:
            raise place.at("hidden").error(
                f"has {weights:,} weights between its layers; write fewer units or layers, with "
                f"{MOST_WEIGHTS:,} at most"
            )

    @classmethod
    def check_scenario(cls, settings: LearnerSettings, scenario: Scenario, place: Place) -> None:
        """Refuse an observation that the scenario does not have, as of packets where its link sends none."""
        _observed(settings, scenario, place)

    def prepare(self, preparation: Preparation) -> Prepared:
        """Look the parts of the observation up."""
        known = KnownDevices(self.run.devices)
        self._places, self._observer = _observed(self.settings, known, self.run.settings_place)
        return super().prepare(preparation)

    def reset(self, episode: int, seed: int, t0_ns: int) -> None:
        """Every episode begins without knowledge."""
        self._models, self._asked, self._episode = {}, (), (seed, episode)

    def checkpoint(self) -> bytes:
        """Weights, memories, and the choices that no feedback came to yet."""
        models = tuple(model.state(beams) for beams, model in sorted(self._models.items()))
        return saved(self, 1, _LearnerState(models, self._asked))

    def restore(self, state: bytes) -> None:
        """See `checkpoint`."""
        found = restored(self, 1, _LearnerState, state)
        self._asked = found.asked
        self._models = {of.beams: Model.restored(of, self.settings.memory) for of in found.models}

    def choose(self, frame: Frame, scene: Scene, pairs: Sequence[Pair]) -> Iterator[BeamChoice]:
        """Learn from the frame before, then choose for each user, the same on every carrier."""
        self._learn(frame)
        users = self._places.present(scene)
        seen = self._observer.read(Moment(frame, scene, frame.only("link", Link), users))
        settings, asked = self.settings, []
        share = max(settings.explore_least, 1.0 - frame.number / settings.explore_frames)
        for place, pair in users:
            features = self._features(seen, place)
            beams = pair.beams
            # A stream of its own for each user: who else is there does not move its draws.
            draws = frame.generator(f"{pair.tx.name}/{pair.rx.name}")
            if draws.random() < share:
                chosen = int(draws.integers(beams[0] * beams[1]))
            else:
                chosen = int(self._model(beams, len(features)).network.values(features[None])[0].argmax())
            asked.append(_Asked(pair.tx.name, pair.rx.name, beams, chosen, Packed.of(features, "<f8")))
            tx_beam, rx_beam = divmod(chosen, beams[1])
            yield BeamChoice(tx=pair.tx.name, rx=pair.rx.name, tx_beam=tx_beam, rx_beam=rx_beam)
        self._asked = tuple(asked)

    def _learn(self, frame: Frame) -> None:
        settings = self.settings
        feedbacks = Feedbacks(frame, settings.feedback)
        for asked in self._asked:
            found = [feedbacks.of(carrier.name, asked.tx, asked.rx) for carrier in self.run.carriers]
            # A pair that served is not always the one that was chosen: an agent may have come late.
            worth = [f[2] for f in found if f and f[0] * asked.beams[1] + f[1] == asked.pair]
            if worth:
                features = asked.features.array(np.float64)
                model = self._model(asked.beams, len(features))
                model.remember(features, asked.pair, math.fsum(worth) / len(worth))
        for beams, model in sorted(self._models.items()):
            draws = frame.generator(f"memory/{beams[0]}/{beams[1]}")
            for _ in range(settings.updates if model.seen else 0):
                model.learn(draws, settings.batch, settings.learning_rate)

    def _model(self, beams: tuple[int, int], features: int) -> Model:
        model = self._models.get(beams)
        if model is None:
            seed, episode = self._episode
            draws = generator(seed, episode, f"{self.run.name}/weights/{beams[0]}/{beams[1]}")
            network = Perceptron((features, *self.settings.hidden, beams[0] * beams[1]), draws)
            model = self._models[beams] = Model(network, features, self.settings.memory)
        return model

    def _features(self, seen: Mapping[str, NDArray[Any]], place: int) -> Float64Array:
        """The numbers of one user, scaled, and their waves."""
        places = len(self._places)
        found = []
        for name, bounds in self._observer.bounds.items():
            width = bounds.shape[0] // places
            high = bounds.high if bounds.high < FAR else 1.0
            numbers = seen[name][place * width : (place + 1) * width].astype(np.float64)
            found.append(numbers / self.settings.scale.get(name, high))
        scaled = np.concatenate(found)
        phases = np.outer(np.arange(1, self.settings.waves + 1), math.pi * scaled).reshape(-1)
        return np.concatenate([scaled, np.sin(phases), np.cos(phases)])


def _observed(settings: LearnerSettings, known: KnownScenario, place: Place) -> tuple[Users, Observer]:
    """The users, and what is observed of them.

    Raises:
        ScenarioError: Settings do not fit what is known of the scenario; names the key.
    """
    try:
        users = Users(known, settings.users, settings.except_users)
    except ScenarioError as error:
        raise place.at("users").error(error.message) from error
    here = place.at("observe")
    if not settings.observe:
        raise here.error('is empty; write observe = ["aod"]')
    try:
        observer = Observer(known, users, settings.observe)
    except ScenarioError as error:
        raise here.error(error.message) from error
    if observer.inputs:
        topics = ", ".join(sorted(i.topic for i in observer.inputs))
        raise here.error(
            f"needs {topics}, and this agent takes the scene and the link alone; write an agent of your "
            "own with these inputs"
        )
    for name in settings.scale:
        if name not in settings.observe:
            text = f"{name!r} is not observed; {suggestion(name, settings.observe)}"
            raise place.at("scale").error(text)
    return users, observer
