"""States that services save and take over (contract, clause 18): bytes that say what they are of.

A service keeps its state in a frozen struct, `saved` makes bytes of it and `restored` a struct again.
Equal states give equal bytes. What is in them is data alone: nothing in them is ever run.
"""

from __future__ import annotations

import hashlib
from typing import Any, Literal, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from caviar_protocol.errors import RunError
from caviar_services.service import Service

_FORMAT: Literal["caviar-state-1"] = "caviar-state-1"

T = TypeVar("T", bound=msgspec.Struct)


class _Envelope(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """Envelope around a state."""

    format: Literal["caviar-state-1"]
    implementation: str
    version: int
    circumstances: bytes
    """Digest of the settings, and of the parts of `RunInfo` that a state depends on."""
    digest: bytes
    """Of the body."""
    body: bytes


class Packed(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """An array inside a state, C order.

    Example:
        >>> Packed.pack(np.array([1.0, 2.0]), "<f8").array(np.float64).tolist()
        [1.0, 2.0]
    """

    dtype: Literal["<f8", "<i8", "<i4"]
    shape: tuple[int, ...]
    data: bytes

    @classmethod
    def pack(cls, array: NDArray[Any], dtype: Literal["<f8", "<i8", "<i4"]) -> Packed:
        """Pack an array.

        Args:
            array: The array.
            dtype: Type of the numbers in the state, which must hold them all.
        """
        return cls(dtype, array.shape, array.astype(dtype).tobytes())

    def array(self, kind: type[Any]) -> NDArray[Any]:
        """Unpack the array; it is a copy, which may be written to.

        Args:
            kind: Type of its numbers.
        """
        return np.frombuffer(self.data, self.dtype).reshape(self.shape).astype(kind)


def saved(service: Service[Any], version: int, state: msgspec.Struct) -> bytes:
    """A state as bytes. Equal states give equal bytes.

    Args:
        service: The service, of which implementation and circumstances are noted.
        version: Version of the struct ``state``; raise it whenever what its fields mean changes.
        state: The state, a frozen struct; arrays in it are `Packed`.

    Returns:
        What `Service.checkpoint` returns.

    Example:
        >>> import msgspec
        >>> from caviar_services.agent.baselines import RandomAgent
        >>> from caviar_services.agent.base import AgentSettings
        >>> from caviar_services.service import RunInfo
        >>> class State(msgspec.Struct, frozen=True):
        ...     next: int
        >>> agent = RandomAgent(AgentSettings(), RunInfo(name="agent"))
        >>> restored(agent, 1, State, saved(agent, 1, State(3)))
        State(next=3)
    """
    # Dictionaries in the order of their keys: the order of insertion would make equal states differ.
    body = msgspec.msgpack.encode(state, order="deterministic")
    name = type(service).__qualname__
    return msgspec.msgpack.encode(
        _Envelope(_FORMAT, name, version, _circumstances(service), _digest(body), body)
    )


def restored(service: Service[Any], version: int, cls: type[T], state: bytes) -> T:
    """The struct that `saved` was given.

    Args:
        service: The service that takes the state over.
        version: As for `saved`.
        cls: Class of the struct.
        state: The bytes.

    Raises:
        RunError: The bytes are of another implementation, of another version of it, of other circumstances
            (settings, seed, sampling period, carriers, devices), or no state at all.
    """
    # Each check has a text of its own: a state of another release asks something else of a user than one that
    # a full disk cut off.
    who = f"{service.run.name!r} cannot go on from a saved state"
    try:
        envelope = msgspec.msgpack.decode(state, type=_Envelope)
    except (msgspec.MsgspecError, UnicodeDecodeError) as error:
        raise RunError(f"{who}: these {len(state)} bytes are none ({error}); start the run again") from error
    # Before anything is made of the body, so that a damaged one is called so, and not «no state of …».
    if _digest(envelope.body) != envelope.digest:
        raise RunError(f"{who}: its bytes are not those that were saved; start the run again")
    name = type(service).__qualname__
    if envelope.implementation != name:
        raise RunError(f"{who} of {envelope.implementation}: this is {name}; use the same implementation")
    if envelope.version != version:
        raise RunError(
            f"{who} of version {envelope.version}: this is version {version} of {name}; "
            "use the release that saved it, or start the run again"
        )
    if envelope.circumstances != _circumstances(service):
        raise RunError(
            f"{who} of another scenario: settings, seed, sampling period, carriers or devices differ; "
            "use the scenario that it was saved in, or start the run again"
        )
    try:
        return msgspec.msgpack.decode(envelope.body, type=cls)
    except msgspec.MsgspecError as error:
        raise RunError(f"{who}: it is no state of {name} ({error}); start the run again") from error


# What a state may depend on. The directory and the scenario as a whole are left out: a run that is moved, or
# resumed under other timeouts, has the same states.
def _circumstances(service: Service[Any]) -> bytes:
    run = service.run
    known = (run.name, run.seed, run.sampling_period_ns, run.carriers, run.devices)
    return _digest(msgspec.msgpack.encode((service.settings, known), order="deterministic"))


def _digest(data: bytes) -> bytes:
    return hashlib.blake2b(data, digest_size=16).digest()
