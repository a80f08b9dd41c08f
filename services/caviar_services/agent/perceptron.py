"""A perceptron in NumPy that learns what each of several choices is worth, quick enough for every frame."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import msgspec
import numpy as np

from caviar_protocol.arrays import Float64Array, Int64Array
from caviar_services.checkpoint import Packed

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
