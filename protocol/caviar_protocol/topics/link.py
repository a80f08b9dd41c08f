"""Topics ``action``, what agents decide, and ``link``, what the communication system achieved with it."""

from __future__ import annotations

from typing import Annotated, ClassVar

import msgspec

from caviar_protocol.arrays import (
    BoolArray,
    Float64Array,
    Int32Array,
    Int64Array,
    Payload,
    Quaternion,
    Vector3,
    array,
    quantity,
)


class BeamChoice(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True, tag="beam"):
    """Use this pair of codebook beams between a transmitter and a receiver.

    `Link` defines the beams by their index. The actuator is ``beam:<rx>``.

    Example:
        >>> BeamChoice(tx="bs", rx="car/rx", tx_beam=3).rx_beam  # of a receiver with one element
        0
    """

    tx: str
    """Transmitting device."""
    rx: str
    """Receiving device."""
    tx_beam: Annotated[int, quantity("1", "index into the transmitter's codebook", ge=0)]
    rx_beam: Annotated[int, quantity("1", "index into the receiver's codebook", ge=0)] = 0
    # By name and not by index: an agent need not know the channel's order of carriers.
    carrier: str = ""
    """Name of the carrier; empty: every carrier."""


class WaypointCommand(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True, tag="waypoint"):
    """Fly or drive an object to a point. The actuator is ``motion:<object>``.

    Example:
        >>> WaypointCommand(object="uav", position=(10.0, 0.0, 30.0), speed=5.0).at_once
        False
    """

    object: str
    """Object to be moved."""
    position: Vector3
    """Where to."""
    speed: Annotated[float, quantity("m/s", "at most", gt=0)]
    # A world of an earlier version ignores the field and flies there: later, and without harm.
    at_once: bool = False
    """Be there in the next frame, at rest, without the way between: to begin an episode elsewhere."""
    # As for `at_once`: such a world heads along the course.
    yaw: Annotated[float, quantity("rad", "counter-clockwise from +x")] | None = None
    """Heading to turn to and to keep; absent: along the course."""


class VelocityCommand(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True, tag="velocity"):
    """Give an object a velocity. The actuator is ``motion:<object>``.

    Example:
        >>> VelocityCommand(object="uav", velocity=(0.0, 3.0, 0.0)).velocity  # to the north
        (0.0, 3.0, 0.0)
    """

    object: str
    """Object to be moved."""
    velocity: Annotated[tuple[float, float, float], quantity("m/s", "in world axes")]
    # Worlds need not know both that follow: others head along the course.
    yaw: Annotated[float, quantity("rad", "counter-clockwise from +x")] | None = None
    """Heading to turn to and to keep; absent: along the course."""
    yaw_rate: Annotated[float, quantity("rad/s", "counter-clockwise")] | None = None
    """With which the heading turns, where ``yaw`` is absent; 0 keeps it."""


# Agents choose beams of all users; which of them is served is a decision of its own.
class UserSchedule(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True, tag="schedule"):
    """Let a transmitter serve this receiver in the frame. The actuator is ``schedule:<tx>``.

    Receivers of the transmitter that no command names are not served; without any command for it all may be.
    Since 1.5 there may be several for a transmitter: a link with packets serves these in turn, or at once, as
    it is set; a link without takes each of them as served.

    Example:
        >>> UserSchedule(tx="bs", rx="car/rx").rx
        'car/rx'
    """

    tx: str
    """Transmitting device."""
    rx: str
    """Device that it serves."""


class PathCommand(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True, tag="path"):
    """Fly an object along straight lines between points, without a stop between them. The actuator is
    ``motion:<object>``.

    The same command again, in the frames after, continues on the way. Worlds need not know it.

    Example:
        >>> square = ((0.0, 0.0, 9.0), (9.0, 0.0, 9.0), (9.0, 9.0, 9.0))
        >>> len(PathCommand(object="uav", points=square, speed=5.0).points)
        3
    """

    object: str
    """Object to be moved."""
    points: tuple[Vector3, ...]
    """Corners in the order of flight; it hovers at the last one, and where there is none."""
    speed: Annotated[float, quantity("m/s", "at most", gt=0)]


class AttitudeCommand(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True, tag="attitude"):
    """Give an object that flies by rotors an attitude and a thrust. The actuator is ``motion:<object>``.

    Worlds need not know it.

    Example:
        >>> level = (1.0, 0.0, 0.0, 0.0)
        >>> AttitudeCommand(object="uav", orientation=level, thrust=9.80665).thrust  # it hovers
        9.80665
    """

    object: str
    """Object to be moved."""
    orientation: Quaternion
    """Of the body: body axes to world axes."""
    thrust: Annotated[float, quantity("m/s2", "over the mass, along the body's z", ge=0)]


class RoadStop(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Where a vehicle stops, and for how long.

    Example:
        >>> RoadStop(road="east2", position=40.0, duration=10.0).lane
        0
    """

    road: str
    """Name of the road in the world's network."""
    position: Annotated[float, quantity("m", "along the road, of the front of the vehicle", ge=0)]
    duration: Annotated[float, quantity("s", "from when it stands", ge=0)]
    lane: Annotated[int, quantity("1", "from the outermost one", ge=0)] = 0


class DriveCommand(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True, tag="drive"):
    """Drive a vehicle on its network of roads. The actuator is ``motion:<object>``.

    Worlds need not know it.

    Example:
        >>> DriveCommand(object="traffic.bus", speed=0.0).route  # it brakes, and stays on its route
        ()
    """

    object: str
    """Vehicle to be driven."""
    speed: Annotated[float, quantity("m/s", "as far as traffic allows", ge=0)] | None = None
    """Until the next command for the vehicle; absent: as the world's own driver chooses."""
    lane: Annotated[int, quantity("1", "to change to, from the outermost one", ge=0)] | None = None
    """Absent: as the world's own driver chooses."""
    route: tuple[str, ...] = ()
    """Roads from the one on which it is to its destination; empty: as before."""
    stop: RoadStop | None = None
    """To be made on the route; absent: none is added."""


class SignalCommand(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True, tag="signal"):
    """Switch traffic lights to a phase of their program. The actuator is ``signal:<signal>``.

    Worlds need not know it.

    Example:
        >>> SignalCommand(signal="traffic.junction", phase=2).duration is None  # that of the program
        True
    """

    signal: str
    """Name of the lights, with the prefix of the world."""
    phase: Annotated[int, quantity("1", "index into the program", ge=0)]
    duration: Annotated[float, quantity("s", "from now on", gt=0)] | None = None
    """After it the program continues; absent: that of the phase."""


MotionCommand = WaypointCommand | VelocityCommand | PathCommand | AttitudeCommand
"""Commands that move an object freely; the actuator is ``motion:<object>``."""

TrafficCommand = DriveCommand | SignalCommand
"""Commands for traffic on a network of roads."""

Command = (
    BeamChoice
    | WaypointCommand
    | VelocityCommand
    | UserSchedule
    | PathCommand
    | AttitudeCommand
    | DriveCommand
    | SignalCommand
)


class Action(Payload, frozen=True, kw_only=True, omit_defaults=True):
    """All commands of one agent in a frame, sorted by actuator, TX and carrier.

    At most one per actuator; of beam choices, one per actuator, TX and carrier; of schedules, since 1.5, one
    per actuator and receiver.

    Example:
        >>> from caviar_protocol.codec import decode_payload, encode_payload
        >>> chosen = Action(commands=(BeamChoice(tx="bs", rx="car/rx", tx_beam=3),))
        >>> header, body = encode_payload(chosen)
        >>> decode_payload("action", header, body) == chosen
        True
    """

    # In one order, so that equal decisions are equal bytes.
    commands: tuple[Command, ...]
    """Each with its ``type``."""


class Link(Payload, frozen=True, kw_only=True, omit_defaults=True):
    """Result per user; a user is one (TX, RX, carrier) of which both devices use the carrier: carriers in the
    order of the channel, then TX, then RX by name. A device that both transmits and receives is no user of
    itself.

    ``y`` is the equivalent channel w* H f of a beam pair (paper, eq. 1) with beams of unit norm
    and without transmit power. Beam ``k`` of a panel of one polarization, with N = rows·columns elements, is
    c_k[i] = exp(+j2π(p·(i % rows)/rows + q·(i // rows)/columns))/sqrt(N) with p = k % rows and
    q = k // rows; a receiver uses w = c_k, a transmitter f = conj(c_k), so that an index means
    the same direction at both ends. With several panels or dual polarization, beam ``s·N + k`` is beam ``k``
    of the ``s``-th block of N elements and 0 at all others. Another `AntennaArray.codebook` has other vectors
    c_k, and its own number of them for each block.

    The pair along the straight line has, at each end, the beam of the greatest |c_k* a| for the unit
    vector u towards the other end, in the panel's axes. Of the DFT, p is the integer nearest to
    −rows·vertical_spacing·u_z, modulo rows, and q that nearest to columns·horizontal_spacing·u_y, modulo
    columns; of equal beams it is the one of lower index. Of several panels it is the one with the
    greatest u_x. Of polarizations it is the two that couple best between upright devices that face each
    other, of equal ones the first: V to V, RHCP to RHCP, but −45° to +45°.

    The SNR is P·|y|²/(k·T·B·F), with the transmit power P [W] of ``power_dbm``, B = ``bandwidth_hz`` of the
    carrier, k = 1.380649e-23 J/K, and temperature T and noise factor F as the link is set: 290 K and 9 dB
    unless its settings ``temperature_k`` and ``noise_figure_db`` say otherwise.

    A user without a path has ``has_path`` false and zeros; one that no agent served has beams −1
    and |y| 0. The lists of best pairs end with beams −1 and |y| 0 where a user has no path or
    fewer pairs. Of pairs with equal |y| the one of lower TX, then RX beam stands first. Means
    over users leave out those without a path and state how many they were.

    Where a link counts interference, the SINR is P·|y|²/(k·T·B·F + I), and the spectral efficiency of a link
    without packets follows from it. I is what the receiver gets, with its chosen beam, of the other
    transmitters that serve on its carrier: each spreads its power evenly over those that it serves at once,
    or, without packets, over all its users with beams.

    A link with packets has a buffer for each receiver and carrier. What it did in the frame stands with the
    user of the transmitter that serves the receiver, and 0 with its other users. Over the users of a receiver
    and carrier, from one frame to the next,

        buffered(k) = buffered(k − 1) + arrived(k) − sent(k) − dropped(k)

    exactly, where ``buffered`` was 0 before the first frame of an episode, and of a receiver that comes. Ages
    and delays count in whole slots, from the beginning of that in which a packet arrives to the end of that
    in which its last bit is sent.

    Example:
        >>> from caviar_protocol.recording import Recording
        >>> link = Recording("runs/smoke-20261122-101500")["link"][7]
        >>> link.rx, link.top_abs_y.shape  # users, best pairs
        (('car/rx', 'uav/rx-uav'), (2, 10))
        >>> bool((link.abs_y <= link.top_abs_y[:, 0]).all())
        True
    """

    sizes_from: ClassVar[dict[str, tuple[str, ...]]] = {"U": ("tx", "rx", "carrier")}

    tx: tuple[str, ...]
    """Transmitting device of each user."""
    rx: tuple[str, ...]
    """Receiving device of each user."""
    carrier: tuple[str, ...]
    """Name of each user's carrier."""
    has_path: Annotated[BoolArray, array("|b1", "U", unit="1", doc="at least one path reaches the user")]
    los: Annotated[BoolArray, array("|b1", "U", unit="1", doc="line of sight is free")]
    tx_beam: Annotated[Int32Array, array("<i4", "U", unit="1", doc="chosen TX beam; −1: none chosen")]
    rx_beam: Annotated[Int32Array, array("<i4", "U", unit="1", doc="chosen RX beam; −1: none chosen")]
    abs_y: Annotated[Float64Array, array("<f8", "U", unit="1", doc="|y| of the chosen pair")]
    # Indices of both ends apart: one number for a pair would need the size of a codebook to be read.
    top_tx_beam: Annotated[
        Int32Array, array("<i4", "U", "K", unit="1", doc="TX beams of the best K pairs, best first")
    ]
    top_rx_beam: Annotated[
        Int32Array, array("<i4", "U", "K", unit="1", doc="RX beams of the best K pairs, best first")
    ]
    top_abs_y: Annotated[
        Float64Array, array("<f8", "U", "K", unit="1", doc="|y| of the best K pairs; [:, 0] is eq. 2")
    ]
    baseline_abs_y: Annotated[
        Float64Array,
        array("<f8", "U", unit="1", doc="|y| of the pair that points along the straight line TX–RX"),
    ]
    aod_azimuth: Annotated[
        Float64Array, array("<f8", "U", unit="rad", doc="azimuth of RX from TX, in the TX device's axes")
    ]
    aoa_azimuth: Annotated[
        Float64Array, array("<f8", "U", unit="rad", doc="azimuth of TX from RX, in the RX device's axes")
    ]
    snr: Annotated[Float64Array, array("<f8", "U", unit="1", doc="linear SNR of the chosen pair")]
    snr_best: Annotated[Float64Array, array("<f8", "U", unit="1", doc="linear SNR of the best pair")]
    spectral_efficiency: Annotated[Float64Array, array("<f8", "U", unit="bit/s/Hz", doc="log2(1 + SNR)")]
    bit_rate: Annotated[Float64Array, array("<f8", "U", unit="bit/s", doc="bandwidth · spectral efficiency")]
    reward: Annotated[
        Float64Array, array("<f8", "U", unit="1", doc="as the link is configured; |y| by default")
    ]
    buffered: (
        Annotated[Float64Array, array("<f8", "U", unit="bit", doc="waiting in the user's buffer")] | None
    ) = None
    no_path: Annotated[int, quantity("1", "users without a path in this frame", ge=0)] = 0
    # A link with packets sends all that follow and `buffered`, one without none of them but `sinr`.
    serving: (
        Annotated[BoolArray, array("|b1", "U", unit="1", doc="this transmitter serves the receiver")] | None
    ) = None
    arrived: (
        Annotated[Int64Array, array("<i8", "U", unit="bit", doc="came for the user in this frame")] | None
    ) = None
    sent: (
        Annotated[Int64Array, array("<i8", "U", unit="bit", doc="left the buffer and came through")] | None
    ) = None
    dropped: (
        Annotated[
            Int64Array,
            array("<i8", "U", unit="bit", doc="left the buffer unsent: too old, or it was full"),
        ]
        | None
    ) = None
    delivered: (
        Annotated[Int64Array, array("<i8", "U", unit="1", doc="packets of which the last bit came through")]
        | None
    ) = None
    delay: (
        Annotated[
            Float64Array,
            array("<f8", "U", unit="s", doc="mean of the delivered packets, from arrival on; 0: none"),
        ]
        | None
    ) = None
    waiting: (
        Annotated[Float64Array, array("<f8", "U", unit="s", doc="age of the oldest packet; 0: none waits")]
        | None
    ) = None
    sinr: (
        Annotated[
            Float64Array,
            array("<f8", "U", unit="1", doc="linear SINR; with packets, mean over the slots that served it"),
        ]
        | None
    ) = None
    throughput: (
        Annotated[Float64Array, array("<f8", "U", unit="bit/s", doc="`sent` over the length of the frame")]
        | None
    ) = None
    blocks: (
        Annotated[Int64Array, array("<i8", "U", unit="1", doc="transport blocks, one a slot that served it")]
        | None
    ) = None
    block_errors: (
        Annotated[Int64Array, array("<i8", "U", unit="1", doc="of these, how many were not decoded")] | None
    ) = None
