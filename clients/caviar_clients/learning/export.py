"""Trained policies as ONNX files, which the agent ``policy`` serves without the library that trained them.

`export_policy` takes a model of Stable-Baselines3, `export_module` a PyTorch module of the user's own. Both
hold the exported file against the original before they are done.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from gymnasium import spaces
from msgspec.structs import replace
from numpy.typing import NDArray

from caviar_clients.envs.base import BeamSelectionEnv
from caviar_clients.files import make_folder_of, writing
from caviar_clients.learning.recorded import RecordedBeamsEnv
from caviar_protocol.errors import RunError, SetupError
from caviar_protocol.files import replace_file
from caviar_protocol.host import install_command
from caviar_services.agent.policy import ACTION, CARD_KEY, PolicyCard, PolicyModel, write_card

OPSET = 17
"""Of ONNX: one that ONNX Runtime knows since version 1.12."""
TRIALS = 200
"""Random observations on which the exported policy has to choose as the original does."""
PACKAGES = ("torch", "stable-baselines3", "gymnasium", "onnx", "numpy", "caviar-sim")

Observation = Mapping[str, NDArray[Any]]
BeamEnv = BeamSelectionEnv | RecordedBeamsEnv


def card_of(env: BeamEnv, **facts: Any) -> PolicyCard:
    """Make the card of a policy that was trained in an environment.

    Args:
        env: The environment; it says what is observed, and the codebooks of all places.
        facts: Further fields of `PolicyCard`.

    Example:
        >>> card_of(BeamSelectionEnv("geometric"), algorithm="DQN", steps=20_000).codebooks
        ((64, 1),)
    """
    versions = {}
    for package in PACKAGES:
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            continue
    made = PolicyCard(
        observe=tuple(env.observation_space.spaces),
        codebooks=tuple((place.tx.size, place.rx.size) for place in env.users.places),
        environment=f"caviar/{type(env).__name__.removesuffix('Env')}-v0",
        scenario=env.scenario.run.name,
        versions=versions,
    )
    return replace(made, **facts)


def export_policy(model: Any, env: BeamEnv, file: Path, **facts: Any) -> PolicyCard:
    """Export a model of Stable-Baselines3: its deterministic choice.

    Args:
        model: A DQN, PPO or A2C of policy ``MultiInputPolicy``.
        env: An environment as it was trained in.
        file: Where the ONNX file goes.
        facts: Further fields of the card: ``steps``, ``seeds``, ``figures``.

    Returns:
        The card, as it stands in the file.

    Raises:
        RunError: The file cannot be written.
        SetupError: A package is missing, or the exported policy chooses otherwise than the model.

    Example:
        >>> from stable_baselines3 import DQN
        >>> env = BeamSelectionEnv("geometric", observe=("aoa", "last_abs_y"))
        >>> card = export_policy(DQN("MultiInputPolicy", env), env, Path("untrained.onnx"))
        >>> card.observe
        ('aoa', 'last_abs_y')
    """
    from torch import nn

    names, policy = tuple(env.observation_space.spaces), model.policy

    class Choice(nn.Module):  # type: ignore[misc]  # torch is not looked at
        """The deterministic choice of the model's policy."""

        def __init__(self) -> None:
            super().__init__()
            self.policy = policy

        def forward(self, *parts: Any) -> Any:
            return self.policy._predict(dict(zip(names, parts, strict=True)), deterministic=True)

    card = card_of(env, **{"algorithm": f"Stable-Baselines3 {type(model).__name__}"} | facts)

    def choose(observation: Observation) -> NDArray[np.int64]:
        return np.ravel(model.predict(observation, deterministic=True)[0])

    return export_module(Choice(), env.observation_space, file, card, choose)


def export_module(
    module: Any,
    space: spaces.Dict[Any],
    file: Path,
    card: PolicyCard,
    choose: Callable[[Observation], NDArray[np.int64]] | None = None,
) -> PolicyCard:
    """Export a PyTorch module.

    Args:
        module: A `torch.nn.Module`. It takes one tensor for each part of ``card.observe``, in that order,
            each of Shape ``[1, …]``, and returns the action, integers of Shape ``[1]`` or ``[1, U]``.
        space: Of the observation.
        file: Where the ONNX file goes; a file of this name is replaced.
        card: What the policy is.
        choose: What the exported policy is held against; None: the module itself.

    Returns:
        The card.

    Raises:
        RunError: The file cannot be written.
        SetupError: A package is missing, or the exported policy chooses otherwise.
    """
    try:
        import onnx
        import torch
    except ImportError as error:
        raise SetupError(
            f"policies are exported by PyTorch and onnx; run: {install_command('learning')}"
        ) from error
    make_folder_of(file)
    if file.is_dir():
        raise RunError(f"{file} is a folder; name the ONNX file that is written")
    module = module.eval().cpu()
    shapes = {name: space[name].shape or () for name in card.observe}
    example = tuple(torch.zeros((1, *shape), dtype=torch.float32) for shape in shapes.values())
    with TemporaryDirectory() as folder, warnings.catch_warnings(), torch.no_grad():
        # The exporter by tracing is deprecated; the newer one needs onnxscript, for the same graph.
        warnings.simplefilter("ignore")
        traced = Path(folder) / "policy.onnx"
        torch.onnx.export(
            module,
            example,
            str(traced),
            input_names=list(shapes),
            output_names=[ACTION],
            opset_version=OPSET,
            dynamo=False,
        )
        model = onnx.load(str(traced))
        onnx.helper.set_model_props(model, {CARD_KEY: write_card(card)})
        made = Path(folder) / file.name
        onnx.save(model, str(made))
        _check(PolicyModel(made), module if choose is None else choose, space, card)
        with writing(file):
            replace_file(file, made.read_bytes())
    return card


def _check(exported: PolicyModel, original: Any, space: spaces.Dict[Any], card: PolicyCard) -> None:
    """Raise `SetupError` where the exported policy chooses otherwise than the original."""
    import torch

    rng = np.random.default_rng(0)
    for _ in range(TRIALS):
        seen = {name: _drawn(space[name], rng) for name in card.observe}
        if isinstance(original, torch.nn.Module):
            with torch.no_grad():
                wanted = np.ravel(
                    original(*(torch.from_numpy(value[None]) for value in seen.values())).numpy()
                )
        else:
            wanted = original(seen)
        found = exported.act(seen)
        if found.tolist() != wanted.tolist():
            raise SetupError(
                f"the exported policy chooses {found.tolist()} where the original chooses {wanted.tolist()}, "
                f"for {seen}; the policy draws at random, or has layers that PyTorch cannot export"
            )


def _drawn(space: Any, rng: np.random.Generator) -> NDArray[Any]:
    """A value of a box, at most 10 where it has hardly a bound."""
    bound = np.minimum(space.high, 10.0)
    value: NDArray[Any] = rng.uniform(np.maximum(space.low, -bound), bound).astype(space.dtype)
    return value
