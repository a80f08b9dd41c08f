"""Features of an observation: each part scaled, and as waves, as the `Encoding` of an experiment says."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import cache
from typing import Any

from caviar_clients.learning.experiment import Encoding
from caviar_protocol.errors import suggestion
from caviar_protocol.scenario.conversion import Place


def check_encodings(
    observation_space: Any,
    encodings: Mapping[str, Encoding],
    place: Place,
    remedy: Callable[[int, int], str] = lambda given, size: "write one for all, or one for each",
) -> None:
    """Check that encodings fit what is observed.

    Args:
        observation_space: Parts by name, each a box.
        encodings: By part.
        place: Where they stand.
        remedy: What is to be written where an encoding has another number of numbers than its part.

    Raises:
        ScenarioError: A part is not observed, or its encoding has another number of numbers.

    Example:
        >>> import numpy as np
        >>> from gymnasium import spaces
        >>> space = spaces.Dict({"aod": spaces.Box(-np.pi, np.pi, (1,), np.float32)})
        >>> check_encodings(space, {"aoa": Encoding()}, Place("features"))
        Traceback (most recent call last):
            ...
        caviar_protocol.errors.ScenarioError: features.aoa: 'aoa' is not observed; did you mean 'aod'?
    """
    parts = getattr(observation_space, "spaces", {})
    for name, encoding in encodings.items():
        if name not in parts:
            raise place.at(name).error(f"{name!r} is not observed; {suggestion(name, parts)}")
        size = math.prod(parts[name].shape)
        for what in ("offset", "scale", "waves"):
            values = getattr(encoding, what)
            if isinstance(values, tuple) and len(values) != size:
                text = f"has {len(values)} numbers, and {name!r} has {size}"
                raise place.at(name).at(what).error(f"{text}; {remedy(len(values), size)}")


def encoded_parts(observation_space: Any, encodings: Mapping[str, Encoding]) -> Any:
    """Make the features extractor of Stable-Baselines3 that encodes parts of an observation.

    Args:
        observation_space: Parts by name, each a box.
        encodings: By part, as `check_encodings` accepts them; a part that is not named goes through as it is.

    Returns:
        A module of PyTorch, from a mapping of tensors of Shape ``[N, …]`` to features of Shape ``[N, F]``.

    Example:
        >>> import numpy as np, torch
        >>> from gymnasium import spaces
        >>> space = spaces.Dict({"aod": spaces.Box(-np.pi, np.pi, (1,), np.float32)})
        >>> encoded = encoded_parts(space, {"aod": Encoding(scale=math.pi, waves=2)})
        >>> features = encoded({"aod": torch.tensor([[math.pi / 2]])})
        >>> (features.numpy().round(3) + 0.0).tolist()  # z = 0.5, sin(πz), sin(2πz), cos(πz), cos(2πz)
        [[0.5, 1.0, 0.0, 0.0, -1.0]]
    """
    return _encoded_parts_class()(observation_space, encodings)


def _each(values: Any, size: int) -> tuple[Any, ...]:
    return values if isinstance(values, tuple) else (values,) * size


def __getattr__(name: str) -> Any:
    # The class is made when PyTorch is there; by this name a saved model finds it again.
    if name == "EncodedParts":
        return _encoded_parts_class()
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


@cache
def _encoded_parts_class() -> Any:
    import torch
    from stable_baselines3.common.torch_layers import BaseFeaturesExtractor

    class EncodedParts(BaseFeaturesExtractor):  # type: ignore[misc]  # Stable-Baselines3 is not looked at
        """The module that `encoded_parts` makes."""

        def __init__(self, observation_space: Any, encodings: Mapping[str, Encoding]) -> None:
            sizes = {name: math.prod(box.shape) for name, box in observation_space.spaces.items()}
            of = {name: encodings.get(name, Encoding()) for name in sizes}
            waves = {name: _each(of[name].waves, size) for name, size in sizes.items()}
            super().__init__(observation_space, sum(len(w) + 2 * sum(w) for w in waves.values()))
            self._parts = tuple(sizes)
            for name, size in sizes.items():
                for what, values in (("offset", of[name].offset), ("scale", of[name].scale)):
                    each = torch.tensor(_each(values, size), dtype=torch.float32)
                    self.register_buffer(f"{name}_{what}", each)
                # Of each wave the number that it is of, and how often it comes round.
                numbers = [(i, k) for i, count in enumerate(waves[name]) for k in range(1, count + 1)]
                self.register_buffer(f"{name}_of", torch.tensor([i for i, _ in numbers], dtype=torch.int64))
                k = torch.tensor([k for _, k in numbers], dtype=torch.float32)
                self.register_buffer(f"{name}_waves", math.pi * k)

        def forward(self, observations: Mapping[str, Any]) -> Any:
            found = []
            for name in self._parts:
                x = observations[name].flatten(1).to(torch.float32)
                z = (x - getattr(self, f"{name}_offset")) / getattr(self, f"{name}_scale")
                found.append(z)
                k = getattr(self, f"{name}_waves")
                if len(k):  # ONNX gives a product of nothing a type of its own
                    phase = k * z[:, getattr(self, f"{name}_of")]
                    found += [torch.sin(phase), torch.cos(phase)]
            return torch.cat(found, dim=1)

    EncodedParts.__qualname__ = EncodedParts.__name__  # found in this module, and not in this function
    return EncodedParts
