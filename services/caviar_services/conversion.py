"""Between the messages of the protocol and what a `Service` gets and gives.

From messages: what the service knows about the run, the frame with its inputs, what products are checked for.
To messages: DONE with products, encoded or as they are, and FAULT. The newest answers are kept, for a GRANT
that is repeated.

The line of a service's own code, for texts that say where it waits or failed.
"""

from __future__ import annotations

import logging
import sys
import time
import traceback
from collections import OrderedDict
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from types import CodeType, TracebackType
from typing import Any, TypeAlias

import msgspec

from caviar_protocol import messages as m
from caviar_protocol.arrays import Payload
from caviar_protocol.codec import decode_payload, encode_payload
from caviar_protocol.digest import payload_digest
from caviar_protocol.errors import CaviarError, PayloadError, ProductError, one_line
from caviar_protocol.fields import MAX_IN_FLIGHT
from caviar_protocol.scenario import DeviceSpec
from caviar_protocol.space.codebooks import codebook_digest, codebook_file
from caviar_protocol.topics import PAYLOADS, Carrier
from caviar_protocol.validation import ContentCheck, ContentRules
from caviar_services.service import (
    Frame,
    FrameInput,
    Progress,
    RunInfo,
    Service,
    StepResult,
    no_orders,
)


def place_in(cls: type | None, lines: Iterable[tuple[CodeType, int]]) -> str:
    """The first of some lines that is in a module of a class or of its bases.

    Args:
        cls: Implementation of a service.
        lines: Code and number of each line, the innermost call first.

    Returns:
        ``my_agent.py:7 in step``, relative to the present folder where it lies there; empty where no line is.
    """
    modules = (sys.modules.get(base.__module__) for base in (cls.__mro__ if cls else ()))
    files = {getattr(module, "__file__", None) for module in modules} - {None}
    found = next(((code, line) for code, line in lines if code.co_filename in files), None)
    if found is None:
        return ""
    code, line = found
    file = Path(code.co_filename)
    if file.is_relative_to(Path.cwd()):
        file = file.relative_to(Path.cwd())
    return f"{file}:{line} in {code.co_name}"


def place_of_error(cls: type | None, trace: TracebackType | None) -> str:
    """The line of a class's modules at which an exception left them.

    Args:
        cls: Implementation of a service.
        trace: Of the exception.
    """
    lines = [(frame.f_code, line) for frame, line in traceback.walk_tb(trace)]
    return place_in(cls, reversed(lines))


_log = logging.getLogger("caviar.service")

# Texts of a FAULT travel to the broker and into summaries: a repr of an array in an error would fill them.
MAX_MESSAGE = 2000
"""[characters] of a FAULT's message."""
MAX_DETAIL = 20000
"""[characters] of a FAULT's traceback."""


KEPT_BYTES = 64 << 20
"""[B] of answers that are kept, beyond the newest two."""

Answer: TypeAlias = tuple[m.Done | m.Fault, Sequence[Any]]


def run_info(
    name: str, welcome: m.Welcome, progress: Progress, attend: Callable[[], None] = no_orders
) -> RunInfo:
    """Read what WELCOME says about the run.

    Args:
        name: Name of the service.
        welcome: The message.
        progress: Where the service reports what it does.
        attend: What a step that waits calls, to be left when the run is over.

    Example:
        >>> times = {"heartbeat_ns": 100_000_000, "liveness_ns": 1_500_000_000}
        >>> welcome = m.Welcome(version=m.PROTOCOL_VERSION, epoch=2, attempt=1, run="demo", seed=1, **times)
        >>> run_info("agent", welcome, lambda phase, grace_s: None).again  # the broker was restarted
        True
        >>> welcome = msgspec.structs.replace(welcome, scenario={"episodes": 2})
        >>> run_info("agent", welcome, lambda phase, grace_s: None).episodes
        2
    """
    scenario = welcome.scenario
    return RunInfo(
        name=name,
        run=welcome.run,
        again=welcome.epoch > 1 or welcome.attempt > 1,
        seed=welcome.seed,
        sampling_period_ns=int(scenario.get("sampling_period_ns", 1)),
        frames=int(scenario.get("frames", 1)),
        episodes=int(scenario.get("episodes", 1)),
        carriers=msgspec.convert(scenario.get("carriers", ()), tuple[Carrier, ...]),
        devices=msgspec.convert(scenario.get("devices", ()), tuple[DeviceSpec, ...]),
        scenario=scenario.get("resolved", {}),
        directory=Path(str(scenario.get("directory", "."))),
        progress=progress,
        attend=attend,
    )


def is_needed(service: Service[Any], order: m.Prepare) -> bool:
    """Whether a consumer wants what the service makes, or the service is there for its own sake.

    Args:
        service: The service.
        order: PREPARE, with the demand for its products.
    """
    return bool(order.demand) or service.role in ("agent", "recorder") or not service.outputs


def missing_codebooks(service: Service[Any]) -> list[str]:
    """SHA-256 of the codebooks from files that a service uses and this process does not have.

    Args:
        service: The service, which knows the devices of the run.
    """
    arrays = [device.array for device in service.run.devices if device.array is not None]
    wanted = {codebook_digest(array): array for array in arrays if service.role in ("agent", "link")}
    return [digest for digest, array in wanted.items() if digest and codebook_file(array) is None]


def content_rules(service: Service[Any], order: m.Prepare) -> ContentRules:
    """Collect what WELCOME and PREPARE say about the products that a service is going to get.

    Args:
        service: The service, which knows carriers and devices of the run.
        order: PREPARE, with producers, prefixes and assets.
    """
    # A device without a world belongs to the only one; with several, the loader has asked for it.
    run = service.run
    worlds = order.producers.get("scene", ())
    devices: dict[str, list[DeviceSpec]] = {world: [] for world in worlds}
    for device in run.devices:
        world = device.world or (worlds[0] if len(worlds) == 1 else "")
        devices.setdefault(world, []).append(device)
    return ContentRules(
        prefixes=order.prefixes,
        devices={world: tuple(specs) for world, specs in devices.items()},
        # Without prefixes the service consumes no scene, and nothing is known about meshes.
        assets=frozenset(asset.name for asset in order.assets) if order.prefixes else None,
        carriers=run.carriers,
        parts=service.parts,
    )


def granted_frame(
    service: Service[Any], reset: m.Reset, grant: m.Grant, inputs: tuple[FrameInput, ...]
) -> Frame:
    """Make the frame that GRANT grants, in the episode that RESET began.

    Args:
        service: The service.
        reset: RESET of the episode.
        grant: The grant.
        inputs: Its inputs (`frame_inputs`).
    """
    return Frame(
        episode=grant.episode,
        number=grant.frame,
        t_ns=grant.t_ns,
        previous=grant.previous_frame,
        final=grant.final,
        budget_ns=grant.budget_ns,
        inputs=inputs,
        imposed=grant.decisions,
        reports=grant.reports,
        service=service.run.name,
        seed=reset.seed,
        seed_episode=reset.seed_episode,
    )


def frame_inputs(
    grant: m.Grant, parts: Sequence[Any], check: ContentCheck, *, encoded: bool
) -> tuple[FrameInput, ...]:
    """Inputs of a grant.

    Args:
        grant: The grant.
        parts: Of each input that is present, header and body where products are encoded, else the payload.
        check: Looks at products before the service does.
        encoded: Whether products are encoded.
    """
    left = iter(parts)
    # A list, not a generator: the embedded run does little else in a frame.
    return tuple(
        [
            FrameInput(entry)
            if entry.status is m.Status.ABSENT
            else FrameInput(entry, next(left), next(left), check=check)
            if encoded
            else FrameInput(entry, payload=next(left), check=check)
            for entry in grant.inputs
        ]
    )


class Encoded(Payload, frozen=True, kw_only=True):
    """Stands in `StepResult.products` for a payload of which only the bytes are known.

    A recorded product is sent as it was, not decoded and made again.
    """

    topic: str
    header: bytes
    body: bytes
    fidelity: str = ""


def encoded(payload: Payload) -> tuple[bytes, bytes]:
    """Encode a product, or take the bytes of one that is encoded already.

    Args:
        payload: The product.

    Returns:
        Header and body (`caviar_protocol.codec.encode_payload`).
    """
    return (payload.header, payload.body) if isinstance(payload, Encoded) else encode_payload(payload)


def decoded(payload: Payload) -> Payload:
    """Decode a product where it is encoded, for a consumer in the same process.

    Args:
        payload: The product.
    """
    if isinstance(payload, Encoded):
        return decode_payload(payload.topic, payload.header, payload.body)
    return payload


def encoded_done(
    identity: dict[str, int],
    use: str,
    grant: m.Grant,
    result: StepResult,
    step_ns: int,
    geometry: m.GeometryChange | None = None,
    geometry_digest: str = "",
) -> tuple[m.Done, list[Any]]:
    """Make DONE, and header and body of each product after it.

    Args:
        identity: Epoch and attempt of the service.
        use: What the implementation is called, for the error.
        grant: What is answered.
        result: What the service made of the frame.
        step_ns: What the step took [ns].
        geometry: Meshes that a world announces with it.
        geometry_digest: Of the geometry that it was made with, where that is not READY's.

    Raises:
        PayloadError: A product is not its topic's.

    Example:
        >>> grant = m.Grant(epoch=1, attempt=1, episode=0, frame=3, t_ns=0)
        >>> done, parts = encoded_done({"epoch": 1, "attempt": 1}, "link", grant, StepResult(), 1_000_000)
        >>> done.frame, done.measured["step"], parts
        (3, 1000000, [])
    """
    started = time.monotonic_ns()
    headers, parts = [], list[Any]()
    for topic, payload in sorted_products(use, result):
        header, body = encoded(payload)
        fidelity = payload.fidelity if isinstance(payload, Encoded) else result.fidelity
        headers.append(m.ProductHeader(topic=topic, digest=payload_digest(header, body), fidelity=fidelity))
        parts += [header, body]
    done = m.Done(
        **identity,
        episode=grant.episode,
        frame=grant.frame,
        products=tuple(headers),
        decisions=dict(result.decisions),
        measured={**result.measured, "step": step_ns, "encode": time.monotonic_ns() - started},
        counts=dict(result.counts),
        end_episode=result.end_episode,
        seed=result.seed,
        geometry=geometry,
        geometry_digest=geometry_digest,
    )
    return done, parts


def plain_done(
    identity: dict[str, int],
    use: str,
    grant: m.Grant,
    result: StepResult,
    geometry: m.GeometryChange | None = None,
    geometry_digest: str = "",
) -> tuple[m.Done, tuple[Payload, ...]]:
    """Make DONE without digests, and the products as they are, for a consumer in this process.

    Decisions, counts and times are left out: only a recorder gets them, and there is none.

    Args:
        identity: Epoch and attempt of the service.
        use: What the implementation is called, for the error.
        grant: What is answered.
        result: What the service made of the frame.
        geometry, geometry_digest: As for `encoded_done`.

    Raises:
        PayloadError: A product is not its topic's.
    """
    products = sorted_products(use, result)
    # Keyword by keyword: `**identity` makes a dictionary in each frame, and this loop does little else.
    done = m.Done(
        epoch=identity["epoch"],
        attempt=identity["attempt"],
        episode=grant.episode,
        frame=grant.frame,
        products=tuple([m.ProductHeader(topic=t, digest="", fidelity=result.fidelity) for t, _ in products]),
        end_episode=result.end_episode,
        seed=result.seed,
        geometry=geometry,
        geometry_digest=geometry_digest,
    )
    return done, tuple([decoded(payload) for _, payload in products])


def sorted_products(use: str, result: StepResult) -> list[tuple[str, Payload]]:
    """Products of a frame by topic, each of its topic's class.

    Args:
        use: What the implementation is called, for the error.
        result: What the service made of the frame.

    Raises:
        PayloadError: A product is not its topic's.
    """
    # Sorted, so that DONE and what follows it are the same bytes whatever order a service makes them in.
    products = sorted(result.products.items()) if len(result.products) > 1 else [*result.products.items()]
    for topic, payload in products:
        if type(payload) is not PAYLOADS.get(topic) and not isinstance(payload, Encoded):
            raise PayloadError(f"{use} made a payload {type(payload).__name__} for the topic {topic!r}")
    return products


def fault_from(
    error: Exception,
    identity: Mapping[str, int],
    phase: str,
    episode: int = 0,
    frame: int = -1,
    cls: type | None = None,
) -> m.Fault:
    """Make a FAULT that says what an exception says; where it is no `CaviarError`, in one line with the place
    in the service's code, and with a traceback.

    Args:
        error: The exception.
        identity: Epoch and attempt of the service.
        phase: What the service was doing.
        episode: Number of the episode.
        frame: Number of the frame; −1: none.
        cls: Implementation of the service; None: no place is named.

    Example:
        >>> fault_from(PayloadError("no scene"), {"epoch": 1, "attempt": 1}, "step", 0, 3).message
        'no scene'
    """
    known = isinstance(error, CaviarError)
    text = one_line(str(error))
    if not known:
        text = ": ".join(filter(None, (type(error).__name__, text)))
    text = text[:MAX_MESSAGE]
    if not known and (place := place_of_error(cls, error.__traceback__)):
        text = f"{text} (at {place})"
    detail = "" if known else "".join(traceback.format_exception(error))
    _log.error(detail or text)
    return m.Fault(
        **identity,
        episode=episode,
        frame=frame,
        phase=phase,
        message=_sendable(text),
        detail=_sendable(detail[-MAX_DETAIL:]),  # the end: the line that failed is the last
        culprit=error.source if isinstance(error, ProductError) else "",
    )


def _sendable(text: str) -> str:
    """The text without what UTF-8 cannot say: names of files may hold such."""
    return text.encode(errors="backslashreplace").decode()


class Answers:
    """The newest answers of an episode, by frame, for a GRANT that is repeated (contract, clause 7).

    Example:
        >>> answers = Answers()
        >>> answers.put(0, (m.Done(epoch=1, attempt=1, episode=0, frame=0), ()))
        >>> answers.is_new(0), answers.is_new(1), answers.get(1)
        (False, True, None)
    """

    def __init__(self) -> None:
        self._answers: OrderedDict[int, Answer] = OrderedDict()
        self._bytes = 0
        self._newest = -1

    def clear(self, newest: int = -1) -> None:
        """Forget all answers.

        Args:
            newest: Frame after which the service is; −1: before the first.
        """
        self._answers.clear()
        self._bytes, self._newest = 0, newest

    def is_new(self, frame: int) -> bool:
        """Whether a frame comes after all that were answered.

        Args:
            frame: Number of the frame.
        """
        return frame > self._newest

    def get(self, frame: int) -> Answer | None:
        """The answer to a frame; None where it is not kept.

        Args:
            frame: Number of the frame.
        """
        return self._answers.get(frame)

    def put(self, frame: int, answer: Answer) -> None:
        """Keep an answer, and forget the oldest where they get too many or too large.

        Args:
            frame: Number of the frame, a new one.
            answer: DONE or FAULT, with its parts.
        """
        self._answers[frame], self._newest = answer, frame
        self._bytes += _size(answer)
        # Two are kept whatever their size.
        while len(self._answers) > 2 and (len(self._answers) > MAX_IN_FLIGHT or self._bytes > KEPT_BYTES):
            self._bytes -= _size(self._answers.popitem(last=False)[1])


def _size(answer: Answer) -> int:
    return sum(map(len, answer[1]))
