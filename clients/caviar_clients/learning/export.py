"""Trained policies as ONNX files, which the agent ``policy`` serves without the library that trained them.

`export_policy` takes a model of Stable-Baselines3, `export_module` a PyTorch module of the user's own. Both
hold the exported file against the original before they are done.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from itertools import zip_longest
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
from caviar_protocol.errors import RunError, ScenarioError, SetupError
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
    made = PolicyCard(
        observe=tuple(env.observation_space.spaces),
        codebooks=tuple(place.beams for place in env.users.places),
        transmitters=getattr(env, "transmitters", ("*",)),  # a recorded user has one
        environment=f"caviar/{type(env).__name__.removesuffix('Env')}-v0",
        scenario=env.scenario.run.name,
        versions=versions(),
    )
    return replace(made, **facts)


def versions() -> dict[str, str]:
    """Versions of the packages that policies are trained with."""
    found = {}
    for package in PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            continue
    return found


def export_policy(model: Any, env: BeamEnv, file: Path, **facts: Any) -> PolicyCard:
    """Export a model of Stable-Baselines3: its deterministic choice.

    The statistics of a ``VecNormalize`` that the model was trained behind become part of the policy: the file
    takes observations as the environment makes them.

    Args:
        model: A DQN, PPO or A2C of policy ``MultiInputPolicy``, with the environment that it was trained in
            where that has a ``VecNormalize``: a model's file has no statistics, and not always a trace of
            them; a model loaded from one gets them by ``model.set_env(VecNormalize.load(…))``.
        env: An environment as it was trained in.
        file: Where the ONNX file goes.
        facts: Further fields of the card: ``steps``, ``seeds``, ``figures``.

    Returns:
        The card, as it stands in the file.

    Raises:
        RunError: The file cannot be written.
        ScenarioError: The model observes something else than the environment.
        SetupError: A package is missing, or the exported policy chooses otherwise than the model.

    Example:
        >>> from stable_baselines3 import DQN
        >>> env = BeamSelectionEnv("geometric", observe=("aoa", "last_abs_y"))
        >>> card = export_policy(DQN("MultiInputPolicy", env), env, Path("untrained.onnx"))
        >>> card.observe
        ('aoa', 'last_abs_y')
    """
    import torch

    policy, normalizer = model.policy, model.get_vec_normalize_env()
    if normalizer is not None and not normalizer.norm_obs:
        normalizer = None
    # In the order of the model's space, in which it makes its features.
    names = tuple(model.observation_space.spaces)
    _check_observed(model, env.observation_space, normalizer)
    turned = {n for n in names if model.observation_space[n].shape != env.observation_space[n].shape}
    statistics = {} if normalizer is None else {n: normalizer.obs_rms[n] for n in normalizer.norm_obs_keys}

    class Choice(torch.nn.Module):  # type: ignore[misc]  # torch is not looked at
        """The deterministic choice of the model's policy, from what the environment shows."""

        def __init__(self) -> None:
            super().__init__()
            self.policy = policy

        def forward(self, *parts: Any) -> Any:
            seen = dict(zip(names, parts, strict=True))
            for name, found in statistics.items():
                # In double precision, as the library does.
                deviation = torch.from_numpy(np.sqrt(found.var + normalizer.epsilon))
                scaled = (seen[name].double() - torch.from_numpy(found.mean)) / deviation
                seen[name] = scaled.clamp(-normalizer.clip_obs, normalizer.clip_obs).float()
            for name in turned:
                seen[name] = seen[name].permute(0, 3, 1, 2)
            return self.policy._predict(seen, deterministic=True)

    card = card_of(
        env, **{"algorithm": f"Stable-Baselines3 {type(model).__name__}", "observe": names} | facts
    )

    def choose(observation: Observation) -> NDArray[np.int64]:
        if normalizer is not None:
            rows = normalizer.normalize_obs({name: value[None] for name, value in observation.items()})
            observation = {name: value[0] for name, value in rows.items()}
        return np.ravel(model.predict(observation, deterministic=True)[0])

    # What the policy tells apart lies about the mean of what it saw, however narrow that is.
    usual = {name: (found.mean, np.sqrt(found.var)) for name, found in statistics.items()}
    return export_module(Choice(), env.observation_space, file, card, choose, usual)


def _check_observed(model: Any, shown: spaces.Dict[Any], normalizer: Any) -> None:
    """Raise `ScenarioError` where a model observes something else than an environment shows."""
    learnt = model.observation_space
    if [*learnt.spaces] != [*shown.spaces]:
        raise ScenarioError(
            f"the model observes {', '.join(learnt.spaces)}, and the environment {', '.join(shown.spaces)}; "
            "give the environment that it was trained in"
        )
    for name, box in learnt.spaces.items():
        mine, last = shown[name], (model._last_obs or {}).get(name)
        shape = mine.shape or ()
        channels_first = len(shape) == 3 and box.shape == (shape[2], *shape[:2])
        if normalizer is None and last is not None and not all(map(box.contains, last)):
            raise ScenarioError(
                f"the model last saw {name!r} outside of its bounds {box}, as behind VecNormalize, whose "
                "statistics no model file holds: call model.set_env(VecNormalize.load(…)), or give "
                "caviar policy export --normalization"
            )
        if box != mine and not channels_first:
            raise ScenarioError(
                f"the model observes {name!r} as {box}, and the environment shows {mine}; give the "
                "environment that it was trained in"
            )


def export_module(
    module: Any,
    space: spaces.Dict[Any],
    file: Path,
    card: PolicyCard,
    choose: Callable[[Observation], NDArray[np.int64]] | None = None,
    usual: Mapping[str, tuple[Any, Any]] | None = None,
    outputs: Sequence[str] = (ACTION,),
    any_size: Mapping[str, Sequence[int]] | None = None,
) -> PolicyCard:
    """Export a PyTorch module.

    Args:
        module: A `torch.nn.Module`. It takes one tensor for each part of ``card.observe``, in that order,
            each of Shape ``[1, …]`` and of the dtype of ``space``, and returns the action, integers of Shape
            ``[1]`` or ``[1, U]``.
        space: Of the observation.
        file: Where the ONNX file goes; a file of this name is replaced.
        card: What the policy is.
        choose: What the exported policy is held against; None: the module itself.
        usual: Mean and standard deviation of parts as the policy sees them, about which they are drawn to
            hold it against the original; of others values are drawn over their bounds, within ±10.
        outputs: Names of what the module returns, a tuple of several.
        any_size: By input or output, axes of any size.

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
    blank = {name: np.zeros((1, *(space[name].shape or ())), space[name].dtype) for name in card.observe}
    example = tuple(map(torch.from_numpy, blank.values()))
    with TemporaryDirectory() as folder, warnings.catch_warnings(), torch.no_grad():
        # The exporter by tracing is deprecated; the newer one needs onnxscript, for the same graph.
        warnings.simplefilter("ignore")
        traced = Path(folder) / "policy.onnx"
        torch.onnx.export(
            module,
            example,
            str(traced),
            input_names=list(blank),
            output_names=list(outputs),
            dynamic_axes={n: {a: f"{n}_{a}" for a in axes} for n, axes in (any_size or {}).items()},
            opset_version=OPSET,
            dynamo=False,
        )
        model = onnx.load(str(traced))
        onnx.helper.set_model_props(model, {CARD_KEY: write_card(card)})
        made = Path(folder) / file.name
        onnx.save(model, str(made))
        _check(PolicyModel(made), module if choose is None else choose, space, card, usual or {})
        with writing(file):
            replace_file(file, made.read_bytes())
    return card


def _check(
    exported: PolicyModel,
    original: Any,
    space: spaces.Dict[Any],
    card: PolicyCard,
    usual: Mapping[str, tuple[Any, Any]],
) -> None:
    """Raise `SetupError` where the exported policy chooses otherwise than the original, more than once."""
    import torch

    rng, otherwise = np.random.default_rng(0), 0
    for _ in range(TRIALS):
        seen = {name: _drawn(space[name], rng, usual.get(name)) for name in card.observe}
        if isinstance(original, torch.nn.Module):
            with torch.no_grad():
                wanted = np.ravel(
                    original(*(torch.from_numpy(value[None]) for value in seen.values())).numpy()
                )
        else:
            wanted = original(seen)
        found = exported.act(seen)
        otherwise += sum(a != b for a, b in zip_longest(found.tolist(), wanted.tolist()))
        # One may be a tie: of two values that are equal within rounding either is right.
        if otherwise > 1:
            raise SetupError(
                f"the exported policy chooses {found.tolist()} where the original chooses {wanted.tolist()}, "
                f"for {seen}; the policy draws at random, or has layers that PyTorch cannot export"
            )


def _drawn(space: Any, rng: np.random.Generator, usual: tuple[Any, Any] | None) -> NDArray[Any]:
    """A value of a box: about the usual ones where these are known, else at most 10 where it has hardly a
    bound."""
    if usual is not None:
        mean, deviation = usual
        value = np.clip(mean + 2 * deviation * rng.standard_normal(space.shape), space.low, space.high)
    elif np.issubdtype(space.dtype, np.integer):
        value = rng.integers(space.low, space.high, endpoint=True, dtype=space.dtype)
    else:
        bound = np.minimum(space.high, 10.0)
        value = rng.uniform(np.maximum(space.low, -bound), bound)
    drawn: NDArray[Any] = value.astype(space.dtype)
    return drawn
