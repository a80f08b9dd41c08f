"""``policy``: an agent that serves a trained policy from an ONNX file, and the card that says what it is.

A policy takes parts of the observation (`caviar_protocol.observations`) as inputs of their names, each with
one row, Shape ``[1, …]``, and gives ``action``: for each place of a user the index ``tx_beam·Nr + rx_beam``
of a pair of beams, Shape ``[1]`` or ``[1, U]``. What it observes, and the codebooks that it was trained for,
stand on its card, in the metadata of the file. Of a grid or a picture the model's input has the size.
"""

from __future__ import annotations

import dataclasses
import hashlib
import threading
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

import msgspec
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from caviar_protocol.arrays import quantity
from caviar_protocol.errors import AssetError, CaviarError, PayloadError, ScenarioError, SetupError
from caviar_protocol.fields import DigestOrNone as Digest
from caviar_protocol.host import install_command
from caviar_protocol.messages import Input
from caviar_protocol.observations import KnownDevices, Moment, Observer, Place, Users, inputs_of
from caviar_protocol.policies import DECISION, NEXT, REFUSED
from caviar_protocol.scenario import ServiceSpec
from caviar_protocol.space.scene import Pair
from caviar_protocol.topics import BeamChoice, Link, Scene
from caviar_services.agent.base import Agent, AgentSettings
from caviar_services.agent.pilots import CHANNEL, Measured, PilotAgent, PilotSettings, Sounding
from caviar_services.registry import load
from caviar_services.service import Frame, Preparation, Prepared, RunInfo, StepResult

CARD_KEY = "caviar.card"
"""Key of the card in the metadata of an ONNX file."""
ACTION = "action"
"""Name of the output with the action."""
SCORES = "scores"
"""Name of the output of a policy that ranks pairs of beams: a score for each pair of each place, float32,
Shape ``[1, U, Nt·Nr]`` by the index of the pair."""
MAX_REASON = 500
"""Characters of the reason for which a policy is refused: it travels in the header of a DONE."""


class TrainedOn(msgspec.Struct, frozen=True, kw_only=True):
    """Dataset, and episodes of it, that a policy was trained on."""

    dataset: str
    """Name of its folder."""
    fingerprint: str
    """Digest of its settings (`caviar_clients.datasets.settings.fingerprint`)."""
    episodes: tuple[tuple[int, int], ...]
    """First and last number of each range of episodes, those of validation too."""


class PolicyCard(msgspec.Struct, frozen=True, kw_only=True):
    """Card of a policy: what it observes, what it was trained for, and how it came about.

    Example:
        >>> card = PolicyCard(observe=("aoa", "last_abs_y"), codebooks=((64, 1),))
        >>> read_card(write_card(card)) == card
        True
    """

    observe: tuple[str, ...]
    """Parts of the observation, as in `caviar_protocol.observations.PARTS`."""
    codebooks: tuple[tuple[int, int], ...]
    """Beams of the transmitter and of the receiver, of each place."""
    per_user: bool = False
    """Whether each user is decided for by itself: ``codebooks`` has one entry, which holds for all places,
    and the model takes any number of them."""
    transmitters: tuple[str, ...] = ("*",)
    """Those that it chooses for, as names with ``*`` and ``?``."""
    keeps_heading: bool | None = None
    """Whether receivers on objects kept their heading, or turned; None: not known (`Users.keeps_heading`)."""
    environment: str = ""
    """Of gymnasium, that it was trained in."""
    scenario: str = ""
    algorithm: str = ""
    """Library and algorithm."""
    seeds: tuple[int, ...] = ()
    steps: int = 0
    """Of training."""
    figures: Mapping[str, float] = {}
    """What was measured of it, by name."""
    trained_on: TrainedOn | None = None
    """Of a policy that was trained on a dataset."""
    versions: Mapping[str, str] = {}
    """Of the packages that it was trained with."""


def write_card(card: PolicyCard) -> str:
    """Write a card as text, for the metadata of a file.

    Args:
        card: The card.
    """
    return msgspec.json.format(msgspec.json.encode(card)).decode()


def read_card(text: str) -> PolicyCard:
    """Read a card that `write_card` wrote.

    Args:
        text: The JSON.

    Raises:
        msgspec.DecodeError: It is no card.
    """
    return msgspec.json.decode(text, type=PolicyCard)


class PolicyModel:
    """A policy in ONNX Runtime, on one thread: a small network is not worth the waiting of several.

    Args:
        file: The ONNX file.
        called: What errors call it.

    Raises:
        SetupError: ONNX Runtime is not installed; the text has the command.
        ScenarioError: The file cannot be read, or its card cannot.
    """

    def __init__(self, file: Path, called: str = "") -> None:
        called = called or str(file)
        try:
            import onnxruntime
        except ImportError as error:
            raise SetupError(f"policies need ONNX Runtime; run: {install_command('policy')}") from error
        try:
            content = file.read_bytes()
        except OSError as error:
            raise ScenarioError(f"{called} cannot be read: {error.strerror}; check the path") from error
        self.digest = hashlib.sha256(content).hexdigest()
        """SHA-256 of the file."""
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.use_deterministic_compute = True
        options.log_severity_level = 4  # what is wrong is said below, and not on standard error
        try:
            self._session: Any = onnxruntime.InferenceSession(
                content, options, providers=["CPUExecutionProvider"]
            )
        except Exception as error:  # its exceptions have no common base
            reason = str(error).partition("\n")[0]
            raise ScenarioError(f"{called} is no ONNX model ({reason}); export the policy again") from error
        self.inputs: dict[str, tuple[Any, ...]] = {i.name: tuple(i.shape) for i in self._session.get_inputs()}
        """Shape of each input, by name; what is not a number may have any size."""
        self.types: dict[str, str] = {i.name: i.type for i in self._session.get_inputs()}
        """Type of each input as ONNX Runtime calls it, ``tensor(float)``, by name."""
        self.outputs = tuple(output.name for output in self._session.get_outputs())
        text = self._session.get_modelmeta().custom_metadata_map.get(CARD_KEY)
        try:
            self.card = None if text is None else read_card(text)
            """None: the file has none."""
        except msgspec.DecodeError as error:
            raise ScenarioError(
                f"{called} has a card that cannot be read ({error}); export it again"
            ) from error

    def act(self, observation: Mapping[str, NDArray[Any]]) -> NDArray[np.int64]:
        """Choose an action.

        Args:
            observation: Parts by name, without the axis of the batch.

        Returns:
            Index of a pair of beams for each place, Shape ``[U]``.
        """
        # A part that changes no action is no input: exporters leave it out.
        rows = {name: observation[name][None] for name in self.inputs}
        (found,) = self._session.run([ACTION], rows)
        return np.asarray(found).reshape(-1)

    def ranked(self, observation: Mapping[str, NDArray[Any]]) -> NDArray[np.int64]:
        """Rank the pairs of beams of each place; the model has the output `SCORES`.

        Args:
            observation: Parts by name, without the axis of the batch.

        Returns:
            Indices of pairs, best first, Shape ``[U, Nt·Nr]``; of equal ones that of lower index is first.
        """
        rows = {name: observation[name][None] for name in self.inputs}
        (scores,) = self._session.run([SCORES], rows)
        order: NDArray[np.int64] = np.argsort(-np.asarray(scores)[0], axis=1, kind="stable")
        return order


class PolicySettings(PilotSettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of ``policy``."""

    file: str
    """``file:`` and the path of the ONNX file, relative to the folder of the scenario. The agent gets it from
    the broker, and looks for it on its own machine where the broker has none."""
    observe: tuple[str, ...] = ()
    """Parts of the observation; empty: those of the policy's card. For a file without a card, for one that
    only the agent's own machine has, and for parts that a policy to come observes (``caviar swap``)."""
    candidates: Annotated[int, quantity("1", "best ranked pairs of a user that are tried", ge=1, le=4096)] = 1
    """1: the policy's choice is taken without a pilot. More: the best of them as measured by pilots, of a
    policy that ranks pairs (output ``scores``)."""
    others: Literal["", "los-beam", "random"] = ""
    """Agent that chooses for the users of transmitters that the policy was not trained for; empty: they have
    no beams."""
    sha256: Digest = ""
    """SHA-256 of the file; another file is refused. Empty: of the one that is there."""
    earlier: tuple[Digest, ...] = ()
    """SHA-256 of the policies that the agent was given since (``caviar policy swap``), by the broker."""


class Served(NamedTuple):
    """A policy that fits the scenario, what it observes, and whom it serves."""

    model: PolicyModel
    observer: Observer
    places: Users


class PolicyAgent(PilotAgent[PolicySettings]):
    """Serves a trained policy: `caviar_services.agent.policy` says what its file holds.

    The digest of the file stands in the decisions of every frame, and a replay takes the files that decided.
    Another policy that the agent is given while a run goes on (`caviar_protocol.policies`) is loaded beside
    the frames; the first frame after that is decided by it.

    Raises:
        ScenarioError: The file is no policy, or does not fit the scenario; the text has both sides.
    """

    Settings: ClassVar[type[msgspec.Struct]] = PolicySettings
    packages: ClassVar[tuple[str, ...]] = ("onnxruntime",)
    # The channel, which pilots measure, is asked for by `inputs_with`.
    inputs: ClassVar[tuple[Input, ...]] = Agent.inputs
    _served: Served
    _producers: Mapping[str, tuple[str, ...]]
    # Pairs of beams that are tried in this frame, by transmitter and receiver.
    _tried: Mapping[tuple[str, str], Sequence[tuple[int, int]]]

    def __init__(self, settings: PolicySettings, run: RunInfo) -> None:
        super().__init__(settings, run)
        # By SHA-256, as all below.
        self._paths: dict[str, Path] = {}
        self._loaded: dict[str, Served] = {}
        self._refused: dict[str, str] = {}
        self._asked: set[str] = set()

    @classmethod
    def inputs_with(cls, settings: Mapping[str, object]) -> Sequence[Input]:
        """Inputs that the policy's sensors need, where its file is on this machine or ``observe`` names
        them; with several ``candidates`` the channel."""
        measured = (CHANNEL,) if settings.get("candidates", 1) != 1 else ()
        return (*cls._observed(settings), *measured)

    @staticmethod
    def _observed(settings: Mapping[str, object]) -> Sequence[Input]:
        observe = settings.get("observe")
        file = Path(str(settings.get("file", "")).removeprefix("file:"))
        if not observe and file.is_file():
            try:
                card = PolicyModel(file).card
            except CaviarError:
                return ()  # it is refused where the agent prepares
            observe = card.observe if card else ()
        return inputs_of(observe) if isinstance(observe, list | tuple) else ()

    @property
    def own_files(self) -> Sequence[str]:
        """The policies that the broker has for this agent."""
        return tuple(filter(None, dict.fromkeys((self.settings.sha256, *self.settings.earlier))))

    def prepare(self, preparation: Preparation) -> Prepared:
        """Load the policy, hold it against the scenario, and run it once."""
        prepared = super().prepare(preparation)
        self._paths = dict(preparation.files)
        self._producers = preparation.producers
        other = self.settings.others
        self._baseline: Any = load("agent", other)(AgentSettings(), self.run) if other else None
        path = Path(self.settings.file.removeprefix("file:"))
        self._served = served = self.load(
            self._paths.get(self.settings.sha256, path), f"policy {path.name}", self.settings.sha256
        )
        model, card = served.model, served.model.card
        self._loaded[model.digest] = served
        for digest in reversed(self.settings.earlier):  # the one given last that can be served goes on
            self._load_beside(digest, self._paths[digest])
            if digest in self._loaded:
                self._served = self._loaded[digest]
                break
        made = f", {card.algorithm} of {card.steps} steps" if card and card.algorithm else ""
        note = f"policy {path.name}, SHA-256 {model.digest[:12]}…{made}"
        return dataclasses.replace(prepared, notes=(*prepared.notes, note))

    def load(self, path: Path, called: str, digest: str = "", setting: str = "file") -> Served:
        """Load a policy, hold it against the scenario, and run it once.

        Args:
            path: Of the ONNX file.
            called: What errors call it.
            digest: SHA-256 that it has; empty: any.
            setting: Key that named it, for errors.

        Raises:
            AssetError: It has another digest.
            ScenarioError: It is no policy, or does not fit the scenario.
        """
        key = self.run.settings_place.at(setting).key
        try:
            model = PolicyModel(path, called)
        except ScenarioError as error:
            raise ScenarioError(error.message, key=key) from error
        if digest and model.digest != digest:
            raise AssetError(f"{called} is damaged in {path}; remove that file, and give the policy again")
        card = model.card
        observe = self.settings.observe or (card.observe if card else ())
        if not observe:
            raise ScenarioError(
                f"{called} has no card that says what it observes; write "
                f"observe = {list(model.inputs)!r} beside it, or export it with caviar policy export",
                key=key,
            )
        known = KnownDevices(self.run.devices, _grids(model, called, key))
        transmitters = card.transmitters if card else ("*",)
        places = Users(known, self.settings.users, self.settings.except_users, transmitters)
        sizes = tuple(place.beams for place in places.places)
        trained = card.codebooks if card else ()
        if card is not None and (set(trained) != set(sizes) if card.per_user else trained != sizes):
            raise ScenarioError(
                f"{called} was trained for {_codebooks(card.codebooks)}, and the scenario has "
                f"{_codebooks(sizes)}; train it for this scenario, or serve other users",
                key=key,
            )
        kept, keeps = card.keeps_heading if card else None, places.keeps_heading
        if None not in (kept, keeps) and kept != keeps:
            raise ScenarioError(
                f"{called} was trained for receivers with keeps_heading = {str(kept).lower()}, and "
                f"{', '.join(places.receivers)} has the other value: its beams would mean other directions; "
                "write the same below [[devices]]",
                key=key,
            )
        observer = Observer(known, places, observe)
        given = {entry.topic for entry in self.inputs}
        for entry in observer.inputs:
            wanted = ".".join((entry.topic, *entry.parts))
            if entry.topic not in given:
                raise ScenarioError(
                    f"{called} observes {', '.join(observe)}, which needs {wanted}; the agent did not ask "
                    f"for that when it joined: write observe = {list(observe)!r} beside the file, or start "
                    f"the agent with --inputs {wanted}",
                    key=key,
                )
        _check_shapes(model, observer, called, key)
        if self.settings.candidates > 1 and SCORES not in model.outputs:
            raise ScenarioError(
                f"{called} gives {', '.join(model.outputs)} and no {SCORES!r}: it ranks no pairs; write "
                'candidates = 1, or train one that does (kind = "classification")',
                key=key,
            )
        # Buffers are made at the first run, which would else be late.
        try:
            action = model.act({name: np.zeros(b.shape, b.dtype) for name, b in observer.bounds.items()})
        except Exception as error:  # of ONNX Runtime, whose exceptions have no common base
            reason = str(error).partition("\n")[0]
            raise ScenarioError(f"{called} cannot be run ({reason}); export it again", key=key) from error
        _check_action(action, places.places, called, key)
        return Served(model, observer, places)

    def wanted_files(self, decisions: Mapping[str, str]) -> Sequence[str]:
        """The policy that it is to change to, once."""
        digest = decisions.get(NEXT, "")
        if not digest or digest in self._asked or digest in self._loaded:
            return ()
        self._asked.add(digest)
        return (digest,)

    def take_file(self, digest: str, path: Path | None, reason: str) -> None:
        """Load a policy in a thread of its own, beside the frames."""
        if path is None:
            self._refused[digest] = _reason(reason)
            return
        self._paths[digest] = path
        load = threading.Thread(target=self._load_beside, args=(digest, path), name="policy", daemon=True)
        load.start()

    def _load_beside(self, digest: str, path: Path) -> None:
        called = f"policy {digest[:12]}…"
        try:
            served = self.load(path, called, digest)
        except Exception as error:  # whatever a strange file brings about: the run goes on with what it has
            self._refused[digest] = _reason(str(error) or type(error).__name__)
        else:
            self._loaded[digest] = served

    def step(self, frame: Frame) -> StepResult:
        """The policy's choice for each user; its digest among the decisions."""
        imposed, wanted = frame.imposed.get(DECISION, ""), frame.imposed.get(NEXT, "")
        if imposed:
            # The policy that decided a frame that is computed again.
            if imposed not in self._loaded and imposed in self._paths:
                self._loaded[imposed] = self.load(self._paths[imposed], f"policy {imposed[:12]}…", imposed)
            if imposed not in self._loaded:
                raise ScenarioError(
                    f"frame {frame.number} was decided by the policy of SHA-256 {imposed}, and this file has "
                    f"{self._served.model.digest}; give the replay the same file",
                    key=self.run.settings_place.at("file").key,
                )
            self._served = self._loaded[imposed]
        elif wanted:
            self._served = self._loaded.get(wanted, self._served)
        made = super().step(frame)
        if frame.final:
            return made
        decisions = {DECISION: self._served.model.digest}
        if wanted in self._refused:
            # Given once more, it is looked at once more: what was missing may be there.
            self._asked.discard(wanted)
            decisions[REFUSED] = f"{wanted} {self._refused.pop(wanted)}"
        return replace(made, decisions=decisions)

    def choose(self, frame: Frame, scene: Scene, pairs: Sequence[Pair]) -> Iterator[BeamChoice]:
        """The policy's choice for each user, and that of ``others``.

        Without pilots it is the same on every carrier; with several ``candidates`` the best of them on each.
        """
        model, observer, places = self._served
        users = places.present(scene)
        moment = Moment(frame, scene, frame.only("link", Link), users)
        if self._baseline is not None:
            served = {(pair.tx.name, pair.rx.name) for _, pair in users}
            left = [pair for pair in pairs if (pair.tx.name, pair.rx.name) not in served]
            yield from self._baseline.choose(frame, scene, left)
        observation, most = observer.read(moment), self.settings.candidates
        if most > 1:
            ranked = model.ranked(observation)[:, :most].tolist()
            self._tried = {
                (pair.tx.name, pair.rx.name): [divmod(index, pair.beams[1]) for index in ranked[place]]
                for place, pair in users
            }
            yield from super().choose(frame, scene, [pair for _, pair in users])
            return
        action = model.act(observation).tolist()
        for place, pair in users:
            size = places.places[place].beam_pairs
            index = action[place] if place < len(action) else -1
            if not 0 <= index < size:
                raise PayloadError(
                    f"the policy chose pair {index} of {size} for {pair.rx.name}; it gives one index for "
                    f"each of {len(places)} places, from 0 on"
                )
            tx_beam, rx_beam = divmod(int(index), pair.beams[1])
            yield BeamChoice(tx=pair.tx.name, rx=pair.rx.name, tx_beam=tx_beam, rx_beam=rx_beam)

    def select(self, sounding: Sounding) -> Iterator[Measured]:
        """The best of the pairs that the policy ranks first, as measured."""
        for index, user in enumerate(sounding.users):
            found = sounding.best_of(index, self._tried[user.tx.name, user.rx.name])
            if found is not None:
                yield found


def _check_action(action: NDArray[np.int64], places: Sequence[Place], called: str, key: str) -> None:
    """Refuse a model whose action is none: before it serves, while the run still has another."""
    if len(action) != len(places):
        raise ScenarioError(
            f"{called} gives {len(action)} index(es), and the scenario has {len(places)} user(s); give "
            "one for each",
            key=key,
        )
    for number, (place, index) in enumerate(zip(places, action.tolist(), strict=False)):
        if not 0 <= index < place.beam_pairs:
            raise ScenarioError(
                f"{called} chooses pair {index} of {place.beam_pairs} for place {number} where all that "
                "it observes is 0; it gives indices from 0 on",
                key=key,
            )


def _reason(text: str) -> str:
    """Text of a refusal: its text has what stands in the file, which may be anything of any length."""
    line = "".join(c if c.isprintable() else "?" for c in text.partition("\n")[0][: MAX_REASON + 1])
    return line if len(line) <= MAX_REASON else line[:MAX_REASON] + "…"


def _grids(model: PolicyModel, called: str, key: str) -> Mapping[str, ServiceSpec]:
    """The LIDAR's settings as far as a model knows them: its input has the size of the grid, which a run does
    not tell its agents."""
    for name, shape in model.inputs.items():
        if name.partition(":")[0] == "lidar_grid":
            cells = shape[-3:]
            if len(shape) < 4 or not all(isinstance(size, int) for size in cells):
                raise ScenarioError(
                    f"{called} takes {name!r} of shape {list(shape)}; export it with the numbers of cells "
                    "along x, y, z as its last three",
                    key=key,
                )
            lidar = ServiceSpec(
                role="sensors", use="lidar", budget_ms=1.0, settings={"grid": {"cells": cells}}
            )
            return {"lidar": lidar}
    return {}


def _codebooks(sizes: Sequence[tuple[int, int]]) -> str:
    shown = ", ".join(f"{tx} × {rx}" for tx, rx in sizes[:4]) + (", …" if len(sizes) > 4 else "")
    return f"{len(sizes)} user(s) with beams {shown}"


_ONNX_TYPES = {"float32": "float", "float64": "double"}


def _check_shapes(model: PolicyModel, observer: Observer, called: str, key: str) -> None:
    """Refuse a model that takes other inputs than are observed, or gives no action."""
    bounds = observer.bounds
    if not model.inputs.keys() <= bounds.keys():
        raise ScenarioError(
            f"{called} takes {', '.join(sorted(model.inputs))}, and {', '.join(sorted(bounds))} is "
            "observed; name inputs after the parts of the observation",
            key=key,
        )
    for part, given in model.inputs.items():
        needed = (1, *bounds[part].shape)
        # A size that is a name, or none, may be any.
        sizes = zip(given, needed, strict=True) if len(given) == len(needed) else [(0, 1)]
        if any(isinstance(size, int) and size != wanted for size, wanted in sizes):
            raise ScenarioError(
                f"{called} takes {part!r} of shape {list(given)}, and the scenario's is "
                f"{list(needed)}: it was trained for other users",
                key=key,
            )
        dtype = np.dtype(bounds[part].dtype).name
        if model.types[part] != f"tensor({_ONNX_TYPES.get(dtype, dtype)})":
            raise ScenarioError(
                f"{called} takes {part!r} as {model.types[part]}, and it is observed as {dtype}; export the "
                f"policy with inputs of {dtype}",
                key=key,
            )
    if ACTION not in model.outputs:
        raise ScenarioError(
            f"{called} gives {', '.join(model.outputs)} and no {ACTION!r}; name its output so", key=key
        )
