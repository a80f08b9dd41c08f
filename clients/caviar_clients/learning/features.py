"""Features of an observation: each part scaled, and as waves, as the `Encoding` of an experiment says."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cache
from typing import Any

from caviar_clients.learning.experiment import Encoding
from caviar_protocol.errors import suggestion
from caviar_protocol.scenario.conversion import Place


def check_encodings(observation_space: Any, encodings: Mapping[str, Encoding], place: Place) -> None:
    """Check that encodings fit what is observed.

    Args:
        observation_space: Parts by name, each a box.
        encodings: By part.
        place: Where they stand.

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
        for what, values in (("offset", encoding.offset), ("scale", encoding.scale)):
            if isinstance(values, tuple) and len(values) != size:
                text = (
                    f"has {len(values)} numbers, and {name!r} has {size}; write one for all, or one for each"
                )
                raise place.at(name).at(what).error(text)


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
            super().__init__(
                observation_space, sum(n * (1 + 2 * of[name].waves) for name, n in sizes.items())
            )
            self._parts = tuple(sizes)
            for name, size in sizes.items():
                for what, values in (("offset", of[name].offset), ("scale", of[name].scale)):
                    each = values if isinstance(values, tuple) else (values,) * size
                    self.register_buffer(f"{name}_{what}", torch.tensor(each, dtype=torch.float32))
                numbers = torch.arange(1, of[name].waves + 1, dtype=torch.float32)
                self.register_buffer(f"{name}_waves", math.pi * numbers)

        def forward(self, observations: Mapping[str, Any]) -> Any:
            found = []
            for name in self._parts:
                x = observations[name].flatten(1).to(torch.float32)
                z = (x - getattr(self, f"{name}_offset")) / getattr(self, f"{name}_scale")
                phase = (z[:, :, None] * getattr(self, f"{name}_waves")).flatten(1)
                found += [z, torch.sin(phase), torch.cos(phase)]
            return torch.cat(found, dim=1)

    EncodedParts.__qualname__ = EncodedParts.__name__  # found in this module, and not in this function
    return EncodedParts
