"""A client of a measured run: the protocol, and nothing else.

``python -m caviar_broker.bench.client TOPOLOGY SERVICES NUMBER PAYLOAD ENDPOINT``, with keys where
CAVIAR_KEY and CAVIAR_BROKER_KEY name them.
"""

from __future__ import annotations

import os
import sys
from typing import Literal, get_args

import msgspec
import zmq

from caviar_protocol import messages as m
from caviar_protocol.codec import encode_message
from caviar_protocol.digest import payload_digest
from caviar_protocol.host import host_identity
from caviar_protocol.keys import credentials
from caviar_protocol.messages import Input, Role

Topology = Literal["hub", "all"]

HUB = "hub"


class Part(msgspec.Struct, frozen=True):
    """One service of a measured run."""

    name: str
    role: Role
    inputs: tuple[Input, ...]
    output: str


def parts(topology: Topology, services: int) -> tuple[Part, ...]:
    """Make the services of a run.

    Args:
        topology: ``hub``: one takes the products of all others in the same frame, and they take its product
            of the frame before. ``all``: each takes what every other made in the frame before.
        services: Number of services.

    Example:
        >>> [part.name for part in parts("hub", 3)]
        ['hub', 'leaf-1', 'leaf-2']
    """
    if topology == "hub":
        leaf = (Input(topic="link", lag=1, required=False),)
        leaves = [Part(f"leaf-{i}", "sensors", leaf, "lidar") for i in range(1, services)]
        return (Part(HUB, "link", (Input(topic="lidar"),), "link"), *leaves)
    everyone = (Input(topic="lidar", lag=1, required=False),)
    return tuple(Part(f"peer-{i}", "sensors", everyone, "lidar") for i in range(services))


def deliveries(topology: Topology, services: int) -> int:
    """Count the products that consumers get in a frame.

    Example:
        >>> deliveries("hub", 3), deliveries("all", 3)
        (4, 9)
    """
    # A service of `all` gets its own product too: the topic has all of them as sources.
    return 2 * (services - 1) if topology == "hub" else services * services


# Plain integers, and no multipart calls: pyzmq's flags are enumerations, which cost more than a small send.
_MORE = int(zmq.SNDMORE)
# [B] from which a payload is sent without a copy.
_COPIED = 1 << 16


def speak(part: Part, payload: int, endpoint: str) -> None:
    """Take part in a run until the broker ends it, with a product of the same size in every frame.

    Args:
        part: The service.
        payload: Size of its products [B].
        endpoint: Address of the broker.
    """
    with zmq.Context() as context, context.socket(zmq.DEALER) as socket:
        keys = credentials()
        if keys is not None:
            keys.apply_to(socket)
        socket.connect(endpoint)
        socket.send(encode_message(_hello(part)))
        header, body = b"\x80", bytes(payload)
        # Hashed once, since it is the same in every frame: hashing is the producer's work, not the broker's.
        products = (m.ProductHeader(topic=part.output, digest=payload_digest(header, body)),)
        done = _Done(epoch=0, attempt=0, episode=0, frame=0, products=products)
        # Looked up once: at 100 B the exchange itself is what is measured.
        receive, send = socket.recv, socket.send
        while True:
            first = rest = receive(0, False)
            while rest.more:  # payloads come into this process, and are not looked at
                rest = receive(0, False)
            message = _decoder.decode(first.buffer)
            if message.type == "GRANT":
                done.episode, done.frame = message.episode, message.frame
                send(_encoder.encode(done), _MORE)
                send(header, _MORE)
                send(body, 0, payload < _COPIED)
                continue
            epoch, attempt = done.epoch, done.attempt
            match message.type:
                case "WELCOME":
                    done.epoch, done.attempt = message.epoch, message.attempt
                case "PREPARE":
                    send(encode_message(m.Ready(epoch=epoch, attempt=attempt)))
                case "RESET":
                    send(encode_message(m.ResetDone(epoch=epoch, attempt=attempt, episode=message.episode)))
                case "SHUTDOWN":
                    send(encode_message(m.Bye(epoch=epoch, attempt=attempt)))
                    return
                case "REFUSE":
                    raise SystemExit(f"{part.name}: {message.message}")


class _Received(msgspec.Struct):
    """What is read of a message: enough to answer it. What a service does with its inputs is its own cost."""

    type: str
    epoch: int = 0
    attempt: int = 0
    episode: int = 0
    frame: int = 0
    message: str = ""


class _Done(msgspec.Struct, tag="DONE"):
    """What this client fills in of `caviar_protocol.messages.Done`, anew in every frame."""

    epoch: int
    attempt: int
    episode: int
    frame: int
    products: tuple[m.ProductHeader, ...]


_decoder = msgspec.msgpack.Decoder(_Received)
_encoder = msgspec.msgpack.Encoder()


def _hello(part: Part) -> m.Hello:
    return m.Hello(
        version=m.PROTOCOL_VERSION,
        name=part.name,
        role=part.role,
        inputs=part.inputs,
        outputs=(part.output,),
        host=host_identity(),
        pid=os.getpid(),
    )


def main() -> None:
    """Take part as the command line says."""
    topology, services, number, payload, endpoint = sys.argv[1:]
    chosen: Topology = next(t for t in get_args(Topology) if t == topology)
    speak(parts(chosen, int(services))[int(number)], int(payload), endpoint)


if __name__ == "__main__":
    main()
