"""Agent ``learner``: online learning, as in the paper (section 2): a model that trains while it serves.

A perceptron estimates what each beam pair is worth to a user, from parts of the observation. In every frame
pilots try the pair along the straight line, the pairs that the perceptron deems best and some at random; the
best of them as measured serves the user, and all of them are learnt from. So users are never served worse
than by ``los-beam``, but for the air time of the pilots, which counts as that of a sweep does
(`caviar_services.agent.pilots`); with noise another pair serves only where its lower bound is above what was
measured along the straight line. All users with equal codebooks of a carrier share a perceptron, and learn
from each other.

With ``policy`` the ranking begins as that of a trained policy, and the perceptron learns what is different
where it serves.

Weights and memory are state: checkpointed, so that an agent that is killed goes on with the same bytes. Draws
are seeded by frame. As all state of a service it ends with the episode.

A perceptron in NumPy that learns what each of several choices is worth, quick enough for every frame.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, ClassVar, NamedTuple, cast

import msgspec
import numpy as np
from numpy.typing import NDArray

from caviar_protocol.arrays import Float64Array, Int64Array, quantity
from caviar_protocol.errors import ScenarioError, suggestion
from caviar_protocol.messages import Input
from caviar_protocol.observations import FAR, KnownDevices, KnownScenario, Moment, Observer, Users
from caviar_protocol.scenario import Scenario
from caviar_protocol.scenario.conversion import Place
from caviar_protocol.seeding import generator
from caviar_protocol.space.beams import straight_beams
from caviar_protocol.space.scene import directions
from caviar_protocol.topics import Link, Scene
from caviar_services.agent.pilots import Measured, PilotAgent, PilotSettings, Sounding
from caviar_services.agent.policy import SCORES, PolicyAgent, PolicySettings, Served
from caviar_services.checkpoint import Packed, restored, saved
from caviar_services.link.base import User
from caviar_services.registry import with_inputs
from caviar_services.service import Frame, Preparation, Prepared, RunInfo

_DECAY = 0.9, 0.999
_EPSILON = 1e-8


class PerceptronState(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """Weights that a `Perceptron` learnt."""

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
        first: Factor of those of the last layer; 0: every choice is worth 0 until something is learnt.

    Example:
        >>> rng = np.random.default_rng(0)
        >>> network = Perceptron((1, 16, 2), rng)
        >>> for _ in range(300):
        ...     x, chosen = rng.uniform(-1, 1, (32, 1)), rng.integers(2, size=32)
        ...     network.learn(x, chosen, np.where(chosen == 0, x[:, 0], -x[:, 0]), 1e-2)
        >>> network.values(np.array([[0.8], [-0.8]])).argmax(1).tolist()  # the first is worth x, the other −x
        [0, 1]
    """

    def __init__(self, sizes: Sequence[int], generator: np.random.Generator, first: float = 0.1) -> None:
        self._parameters: list[Float64Array] = []
        for inputs, outputs in pairwise(sizes):
            self._parameters += [
                generator.standard_normal((inputs, outputs)) * np.sqrt(2 / inputs),
                np.zeros(outputs),
            ]
        self._parameters[-2] *= first  # at first all choices are worth much the same
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
        """State that it learnt, to be saved."""
        return PerceptronState(
            self.updates,
            *(
                tuple(Packed.pack(array, "<f8") for array in arrays)
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


_SURE = 2.0
"""Standard deviations of a measured |y| by which a pair has to exceed the straight one, to serve."""
MOST_WEIGHTS = 2**22
"""Between hidden layers: with more, an update takes longer than frames are apart."""


class LearnerSettings(PilotSettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the agent ``learner``."""

    candidates: Annotated[
        int, quantity("1", "pairs that are tried for a user in a frame, the straight one too", ge=2, le=4096)
    ] = 8
    policy: str = ""
    """``file:`` and the path of a policy with the output ``scores`` (`caviar_services.agent.policy`) from
    whose ranking the agent begins, relative to the folder of the scenario; empty: from none. It is read on
    the machine of the agent."""
    observe: tuple[str, ...] = ("aod",)
    """Parts of the observation (`caviar_protocol.observations.PARTS`) that come from scene and link."""
    scale: dict[str, Scale] = msgspec.field(default_factory=dict)
    """What a part is divided by; of those that are left out their bound, or 1 where they have none."""
    waves: Annotated[
        int, quantity("1", "sines and cosines of each number, up to this multiple", ge=0, le=64)
    ] = 8
    """Of π times the scaled number: of an angle those of its multiples."""
    hidden: tuple[Units, ...] = (64, 64)
    """Units of each hidden layer; none: a linear model."""
    learning_rate: Annotated[float, quantity("1", "of Adam", gt=0, le=1)] = 2e-3
    batch: Annotated[int, quantity("1", "pairs that an update learns from", ge=1, le=4096)] = 32
    updates: Annotated[int, quantity("1", "of each perceptron in a frame", ge=0, le=100)] = 2
    memory: Annotated[int, quantity("1", "pairs that are remembered", ge=1, le=1_000_000)] = 2000
    explore_frames: Annotated[
        int, quantity("frame", "until candidates at random become as rare as they stay", ge=1, le=10**9)
    ] = 100
    """With a policy they are as rare from the beginning."""
    explore_least: Annotated[float, quantity("1", "share of candidates at random then", ge=0, le=1)] = 0.2


class ModelKey(NamedTuple):
    """Users that share a perceptron: those of a carrier with equal codebooks."""

    carrier: str
    beams: tuple[int, int]
    """Sizes of both codebooks."""


class _ModelState(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    key: ModelKey
    network: PerceptronState
    features: Packed
    pairs: Packed
    worth: Packed
    seen: int


class _LearnerState(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    models: tuple[_ModelState, ...]


class Model:
    """The perceptron of all users with equal codebooks, and the pairs that it remembers.

    Args:
        network: The perceptron.
        features: How many numbers it takes.
        size: Pairs that are remembered; then the oldest make room.
    """

    def __init__(self, network: Perceptron, features: int, size: int) -> None:
        self.network = network
        self.seen = 0
        """Pairs so far."""
        self._features: Float64Array = np.zeros((size, features))
        self._pairs: Int64Array = np.zeros(size, np.int64)
        self._worth: Float64Array = np.zeros(size)

    def remember(self, features: Float64Array, pair: int, worth: float) -> None:
        """Keep a pair and what it was worth."""
        place = self.seen % len(self._pairs)
        self._features[place], self._pairs[place], self._worth[place] = features, pair, worth
        self.seen += 1

    def learn(self, draws: np.random.Generator, batch: int, rate: float) -> None:
        """Learn from some of what is remembered."""
        rows = draws.integers(min(self.seen, len(self._pairs)), size=batch)
        self.network.learn(self._features[rows], self._pairs[rows], self._worth[rows], rate)

    def state(self, key: ModelKey) -> _ModelState:
        """State of all of it, to be saved."""
        count = min(self.seen, len(self._pairs))
        return _ModelState(
            key=key,
            network=self.network.state(),
            features=Packed.pack(self._features[:count], "<f8"),
            pairs=Packed.pack(self._pairs[:count], "<i8"),
            worth=Packed.pack(self._worth[:count], "<f8"),
            seen=self.seen,
        )

    @classmethod
    def restored(cls, state: _ModelState, size: int) -> Model:
        """The model of a `state`."""
        features = state.features.array(np.float64)
        model = cls(Perceptron.restored(state.network), features.shape[1], size)
        count = len(features)
        model._features[:count], model._pairs[:count] = features, state.pairs.array(np.int64)
        model._worth[:count], model.seen = state.worth.array(np.float64), state.seen
        return model


class LearnerAgent(PilotAgent[LearnerSettings]):
    """Learns which beams are worth most while it serves.

    Args:
        settings: Users, pilots, observation, perceptron and exploration.
        run: What the agent knows about the run.

    Raises:
        ScenarioError: A part of the observation does not exist, or needs a sensor.
    """

    Settings: ClassVar[type[msgspec.Struct]] = LearnerSettings
    checkpoints: ClassVar[bool] = True
    _observer: Observer
    _places: Users
    _policy: Served | None = None

    def __init__(self, settings: LearnerSettings, run: RunInfo) -> None:
        super().__init__(settings, run)
        self._models: dict[ModelKey, Model] = {}
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

    @classmethod
    def inputs_with(cls, settings: Mapping[str, object]) -> Sequence[Input]:
        """Inputs that the sensors of the policy need, which the agent begins from."""
        policy = settings.get("policy")
        return PolicyAgent.inputs_with({"file": policy}) if policy else ()

    def prepare(self, preparation: Preparation) -> Prepared:
        """Look the parts of the observation up, and load the policy."""
        known = KnownDevices(self.run.devices)
        self._places, self._observer = _observed(self.settings, known, self.run.settings_place)
        if self.settings.policy:
            self._policy = self._load_policy()
        return super().prepare(preparation)

    def _load_policy(self) -> Served:
        settings = self.settings
        served_by = PolicySettings(
            file=settings.policy, users=settings.users, except_users=settings.except_users
        )
        agent = cast(PolicyAgent, with_inputs(PolicyAgent, tuple(self.inputs))(served_by, self.run))
        path = Path(settings.policy.removeprefix("file:"))
        served = agent.load(path, f"policy {path.name}", setting="policy")
        if SCORES not in served.model.outputs:
            raise self.run.settings_place.at("policy").error(
                f"policy {path.name} gives {', '.join(served.model.outputs)} and no {SCORES!r}; train "
                "one that ranks pairs of beams"
            )
        return served

    def reset(self, episode: int, seed: int, t0_ns: int) -> None:
        """Every episode begins without knowledge, or with that of the policy."""
        self._models, self._episode = {}, (seed, episode)

    def checkpoint(self) -> bytes:
        """Weights and memories."""
        models = tuple(model.state(key) for key, model in sorted(self._models.items()))
        return saved(self, 2, _LearnerState(models))

    def restore(self, state: bytes) -> None:
        """See `checkpoint`."""
        found = restored(self, 2, _LearnerState, state)
        self._models = {of.key: Model.restored(of, self.settings.memory) for of in found.models}

    def select(self, sounding: Sounding) -> Iterator[Measured]:
        """Try the candidates of each user, take the best, then learn from all."""
        frame, scene, settings = sounding.frame, sounding.scene, self.settings
        present = self._places.present(scene)
        moment = Moment(frame, scene, frame.only("link", Link), present)
        seen = self._observer.read(moment)
        rankings = {} if self._policy is None else _rankings(self._policy, frame, scene)
        places = {(pair.tx.name, pair.rx.name): place for place, pair in present}
        for index, (user, at_tx, at_rx) in enumerate(
            zip(sounding.users, *directions(scene, sounding.users), strict=True)
        ):
            place = places[user.tx.name, user.rx.name]
            features = self._features(seen, place)
            model = self._model(ModelKey(user.carrier.name, user.beams), len(features))
            known = rankings.get((user.tx.name, user.rx.name), np.zeros(user.beam_pairs))
            straight_tx, straight_rx = straight_beams(user.tx.array, at_tx, user.rx.array, at_rx)
            straight = straight_tx * user.beams[1] + straight_rx
            tried = self._candidates(frame, user, straight, model.network.values(features[None])[0] + known)
            measured = sounding.measure(index, [divmod(pair, user.beams[1]) for pair in tried])
            best = 0
            if measured is not None:
                best = int(measured.argmax())
                if measured[best] - _SURE * sounding.error_of(user) < measured[0]:
                    best = 0
                # By the best of the frame: far from the transmitter all magnitudes are small.
                scale = float(measured.max()) or 1.0
                for pair, abs_y in zip(tried, measured.tolist(), strict=True):
                    model.remember(features, pair, abs_y / scale - float(known[pair]))
            yield Measured(index, *divmod(tried[best], user.beams[1]))
        for key, model in sorted(self._models.items()):
            draws = frame.generator(f"memory/{key.carrier}/{key.beams[0]}/{key.beams[1]}")
            for _ in range(settings.updates if model.seen else 0):
                model.learn(draws, settings.batch, settings.learning_rate)

    def _candidates(self, frame: Frame, user: User, straight: int, values: Float64Array) -> list[int]:
        """Pairs to try for a user: the straight one first, some at random, the others by their values."""
        settings = self.settings
        count = min(settings.candidates, len(values))
        share = settings.explore_least
        if self._policy is None:
            share = max(share, 1.0 - frame.number / settings.explore_frames)
        # A stream of its own for each user: who else is there does not move its draws.
        draws = frame.generator(f"{user.carrier.name}/{user.tx.name}/{user.rx.name}")
        random = draws.choice(len(values), size=int(draws.binomial(count - 1, share)), replace=False)
        ranked = np.argsort(-values, kind="stable")[:count]
        return list(dict.fromkeys([straight, *random.tolist(), *ranked.tolist()]))[:count]

    def _model(self, key: ModelKey, features: int) -> Model:
        model = self._models.get(key)
        if model is None:
            seed, episode = self._episode
            stream = f"{self.run.name}/weights/{key.carrier}/{key.beams[0]}/{key.beams[1]}"
            sizes = features, *self.settings.hidden, key.beams[0] * key.beams[1]
            # With a policy it is what that lacks, and ranks nothing before it has learnt something.
            first = 0.1 if self._policy is None else 0.0
            network = Perceptron(sizes, generator(seed, episode, stream), first)
            model = self._models[key] = Model(network, features, self.settings.memory)
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


def _rankings(policy: Served, frame: Frame, scene: Scene) -> dict[tuple[str, str], Float64Array]:
    """Worth of the pairs of beams by their rank r in a policy, 1/(1 + r), Shape ``[Nt·Nr]``, of each pair of
    devices that it was trained for."""
    users = policy.places.present(scene)
    moment = Moment(frame, scene, frame.only("link", Link), users)
    order = policy.model.ranked(policy.observer.read(moment))
    worth = np.empty(order.shape)
    np.put_along_axis(worth, order, 1.0 / np.arange(1, order.shape[1] + 1)[None], axis=1)
    return {(pair.tx.name, pair.rx.name): worth[place] for place, pair in users}


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
