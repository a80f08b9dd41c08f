"""Between the messages of the protocol and a `Service`, without I/O: for the runner and the embedded run.

What a service answered, kept for a GRANT that is repeated; and exceptions turned into FAULTs.
"""

from __future__ import annotations

import logging
import time
import traceback
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec

from caviar_protocol import limits
from caviar_protocol import messages as m
from caviar_protocol.arrays import Payload
from caviar_protocol.digest import geometry_digest, payload_digest
from caviar_protocol.errors import CaviarError, PayloadError, ProductError
from caviar_protocol.scenario import DeviceSpec
from caviar_protocol.topics import PAYLOADS, Carrier
from caviar_protocol.validation import ContentCheck, ContentRules
from caviar_services.service import (
    Encoded,
    Frame,
    FrameInput,
    Preparation,
    Prepared,
    Progress,
    RunInfo,
    Service,
    StepResult,
    decoded,
    encoded,
)


def hello_of(name: str, use: str, cls: type[Service[Any]], host: str = "", pid: int = 0) -> m.Hello:
    """What a service says of itself."""
    return m.Hello(
        version=m.PROTOCOL_VERSION,
        name=name,
        role=cls.role,
        inputs=cls.inputs,
        outputs=cls.outputs,
        capabilities=tuple(c for c in m.CAPABILITIES if c != "checkpoint" or cls.checkpoints),
        implementation=use,
        max_in_flight=limits.MAX_IN_FLIGHT,
        host=host,
        pid=pid,
    )


def run_info(name: str, welcome: m.Welcome, progress: Progress) -> RunInfo:
    """What WELCOME tells about the run."""
    told = welcome.scenario
    return RunInfo(
        name=name,
        run=welcome.run,
        again=welcome.epoch > 1 or welcome.attempt > 1,
        seed=welcome.seed,
        sampling_period_ns=int(told.get("sampling_period_ns", 1)),
        frames=int(told.get("frames", 1)),
        carriers=msgspec.convert(told.get("carriers", ()), tuple[Carrier, ...]),
        devices=msgspec.convert(told.get("devices", ()), tuple[DeviceSpec, ...]),
        scenario=told.get("resolved", {}),
        directory=Path(str(told.get("directory", "."))),
        progress=progress,
    )


def is_needed(service: Service[Any], order: m.Prepare) -> bool:
    """Whether anybody wants what the service makes, or it is there for its own sake."""
    return bool(order.demand) or service.role in ("agent", "recorder") or not service.outputs


def preparation_of(order: m.Prepare, assets: Mapping[str, Path]) -> Preparation:
    """What PREPARE orders, with the files of scenery where they lie."""
    return Preparation(
        demand={d.topic: frozenset(d.parts) for d in order.demand}, assets=assets, producers=order.producers
    )


def ready_of(identity: dict[str, int], prepared: Prepared | None, assets: Sequence[m.Asset]) -> m.Ready:
    """READY of a service that loaded these assets; ``prepared`` is None where nobody needs it."""
    if prepared is None:
        return m.Ready(epoch=identity["epoch"], attempt=identity["attempt"])
    return m.Ready(
        **identity,
        geometry=geometry_digest(assets),
        prefixes=prepared.prefixes,
        actuators=prepared.actuators,
        notes=prepared.notes,
        seed=prepared.seed,
    )


def frame_of(service: Service[Any], reset: m.Reset, grant: m.Grant, inputs: tuple[FrameInput, ...]) -> Frame:
    """The frame that GRANT grants, in the episode that RESET began."""
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


def content_rules_of(service: Service[Any], order: m.Prepare) -> ContentRules:
    """What WELCOME and PREPARE say about the products that a service is going to get."""
    run = service.run
    worlds = order.producers.get("scene", ())
    devices: dict[str, list[DeviceSpec]] = {world: [] for world in worlds}
    for device in run.devices:
        world = device.world or (worlds[0] if len(worlds) == 1 else "")
        devices.setdefault(world, []).append(device)
    return ContentRules(
        prefixes=order.prefixes,
        devices={world: tuple(specs) for world, specs in devices.items()},
        assets=frozenset(asset.name for asset in order.assets) if order.prefixes else None,
        carriers=run.carriers,
        parts=service.parts,
    )


def inputs_of(grant: m.Grant, parts: Sequence[Any], check: ContentCheck) -> tuple[FrameInput, ...]:
    """Inputs of a grant; ``parts`` are header and body of each one that is present."""
    inputs, taken = [], 0
    for entry in grant.inputs:
        if entry.status is m.Status.ABSENT:
            inputs.append(FrameInput(entry))
        else:
            inputs.append(FrameInput(entry, parts[taken], parts[taken + 1], check=check))
            taken += 2
    return tuple(inputs)


def done_of(
    identity: dict[str, int], use: str, grant: m.Grant, result: StepResult, step_ns: int
) -> tuple[m.Done, list[Any]]:
    """DONE, and header and body of each product behind it; ``step_ns`` is what the step took.

    Raises `PayloadError` for a product that is not its topic's.
    """
    started = time.monotonic_ns()
    headers, parts = [], list[Any]()
    for topic, payload in _products(use, result):
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
    )
    return done, parts


def plain_done_of(
    identity: dict[str, int], use: str, grant: m.Grant, result: StepResult
) -> tuple[m.Done, tuple[Payload, ...]]:
    """DONE without digests, and the products as they are, for a consumer in this process.

    What a recorder would be told beside them is left out: there is none. Raises `PayloadError` for a
    product that is not its topic's.
    """
    products = _products(use, result)
    done = m.Done(
        epoch=identity["epoch"],
        attempt=identity["attempt"],
        episode=grant.episode,
        frame=grant.frame,
        products=tuple([m.ProductHeader(topic=t, digest="", fidelity=result.fidelity) for t, _ in products]),
        end_episode=result.end_episode,
        seed=result.seed,
    )
    return done, tuple([decoded(payload) for _, payload in products])


def _products(use: str, result: StepResult) -> list[tuple[str, Payload]]:
    products = sorted(result.products.items()) if len(result.products) > 1 else [*result.products.items()]
    for topic, payload in products:
        if type(payload) is not PAYLOADS.get(topic) and not isinstance(payload, Encoded):
            raise PayloadError(f"{use} made a payload {type(payload).__name__} for the topic {topic!r}")
    return products


_log = logging.getLogger("caviar.service")

KEPT_BYTES = 64 << 20
"""[B] of answers that are kept, beyond the newest two."""
MAX_MESSAGE = 2000
MAX_DETAIL = 20000
"""[characters] of a FAULT's texts."""


class Answers:
    """The newest answers of an episode, by frame, as they travel (contract, clause 7)."""

    def __init__(self) -> None:
        self._parts: OrderedDict[int, Sequence[Any]] = OrderedDict()
        self._bytes = 0
        self._newest = -1

    def clear(self) -> None:
        """A new episode begins."""
        self.go_on_behind(-1)

    def go_on_behind(self, frame: int) -> None:
        """The service is where it was after this frame: that and those before are not answered again."""
        self._parts.clear()
        self._bytes, self._newest = 0, frame

    def is_new(self, frame: int) -> bool:
        """Whether the frame lies behind all that were answered."""
        return frame > self._newest

    def get(self, frame: int) -> Sequence[Any] | None:
        """The answer to a frame; None where it is not kept."""
        return self._parts.get(frame)

    def put(self, frame: int, parts: Sequence[Any]) -> None:
        """Keep an answer, and forget the oldest where they get too many or too large."""
        self._parts[frame], self._newest = parts, frame
        self._bytes += _size(parts)
        while len(self._parts) > 2 and (len(self._parts) > limits.MAX_IN_FLIGHT or self._bytes > KEPT_BYTES):
            self._bytes -= _size(self._parts.popitem(last=False)[1])


def _size(parts: Sequence[Any]) -> int:
    return sum(map(len, parts))


class Guard:
    """Context in which an exception becomes a FAULT, handed to ``report``, and goes no further.

    ``phase`` may be changed inside the context.
    """

    def __init__(
        self,
        identity: Mapping[str, Any],
        report: Callable[[m.Fault], None],
        phase: str,
        episode: int = 0,
        frame: int = -1,
    ) -> None:
        self.phase = phase
        self._identity, self._report = identity, report
        self._episode, self._frame = episode, frame

    def __enter__(self) -> Guard:
        return self

    def __exit__(self, _: object, error: BaseException | None, __: object) -> bool:
        if not isinstance(error, Exception):
            return False
        known = isinstance(error, CaviarError)
        text = str(error) if known else f"{type(error).__name__}: {error}"
        detail = "" if known else "".join(traceback.format_exception(error))
        _log.error(detail or text)
        self._report(
            m.Fault(
                **self._identity,
                episode=self._episode,
                frame=self._frame,
                phase=self.phase,
                message=_sendable(text[:MAX_MESSAGE]),
                detail=_sendable(detail[-MAX_DETAIL:]),
                culprit=error.source if isinstance(error, ProductError) else "",
            )
        )
        return True


def _sendable(text: str) -> str:
    """The text without what UTF-8 cannot say: names of files may hold such."""
    return text.encode(errors="backslashreplace").decode()
