"""Topic ``channel``: how radio waves get from each transmitter to each receiver."""

from __future__ import annotations

from enum import Enum, IntEnum
from typing import Annotated, ClassVar

import msgspec

from caviar_protocol.arrays import (
    BoolArray,
    Complex64Array,
    Complex128Array,
    Float64Array,
    Int32Array,
    Int64Array,
    Payload,
    UInt8Array,
    UInt64Array,
    array,
    quantity,
)
from caviar_protocol.errors import PayloadError
from caviar_protocol.fields import MAX_SUBCARRIERS

# `imported` has paths of another program's files, `spherical` exact lengths between elements, and `mimo-rt`
# traces every pair of them.
PLANE_WAVES = ("free-space", "geometric", "siso-rt", "imported")
"""Rungs on which arrays see plane waves: H follows from the paths between their reference points."""


# Numbers are on the wire (`Channel.interactions`): existing ones keep their meaning.
class Interaction(IntEnum):
    """Interaction of a path at one of its points."""

    NONE = 0
    REFLECTION = 1
    DIFFRACTION = 2
    SCATTERING = 3
    TRANSMISSION = 4


class Carrier(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One radio carrier, with the OFDM numerology and the instants of its wideband channel.

    Subcarrier k of K is at ``frequency_hz + (k − ⌊K/2⌋)·subcarrier_spacing_hz``, slot s of a frame begins
    ``s·slot_duration_s`` after the frame's instant.

    Example:
        >>> carrier = Carrier(name="n257", frequency_hz=28e9, subcarriers=264, subcarrier_spacing_hz=120e3)
        >>> carrier.subcarriers * carrier.subcarrier_spacing_hz <= carrier.bandwidth_hz
        True
    """

    name: str
    """Unique in the run."""
    frequency_hz: Annotated[float, quantity("Hz", "centre frequency", gt=0)]
    bandwidth_hz: Annotated[float, quantity("Hz", "noise and rate bandwidth", gt=0)] = 100e6
    subcarriers: Annotated[
        int,
        quantity(
            "1", "subcarriers K of part `hf`; 0: the carrier has no part `hf`", ge=0, le=MAX_SUBCARRIERS
        ),
    ] = 0
    subcarrier_spacing_hz: Annotated[
        float, quantity("Hz", "between neighbouring subcarriers; above 0 where there are any", ge=0)
    ] = 0.0
    taps: Annotated[
        int, quantity("1", "taps L of part `taps`; 0: the carrier has no part `taps`", ge=0, le=65536)
    ] = 0
    slots: Annotated[
        int, quantity("1", "slots S of a frame, for each of which `hf` and `taps` are given", ge=1, le=65536)
    ] = 1
    slot_duration_s: Annotated[
        float, quantity("s", "from one slot to the next; above 0 where there are several", ge=0)
    ] = 0.0


class ChannelOptions(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What a ray-traced product modelled. Defaults say: nothing but line of sight.

    Example:
        >>> ChannelOptions(reflection=True, max_depth=3, samples=1_000_000).diffraction
        False
    """

    los: bool = True
    """The direct path."""
    reflection: bool = False
    """Specular reflection."""
    refraction: bool = False
    """Passing through objects."""
    diffraction: bool = False
    """Bending around edges."""
    scattering: bool = False
    """Diffuse reflection."""
    max_depth: Annotated[int, quantity("1", "interactions of a path at most", ge=0)] = 0
    samples: Annotated[int, quantity("1", "rays launched per transmitter", ge=0)] = 0
    materials_outside: tuple[str, ...] = ()
    """Materials used outside the range they are defined in, as ``brick@mmwave: nearest 40 GHz``."""
    absorption_db_per_km: tuple[
        Annotated[float, quantity("dB/km", "specific attenuation by the air", ge=0)], ...
    ] = ()
    """By the air (ITU-R P.676), for each carrier; empty: none."""
    detail: str = ""
    """What is left of the scenery, as ``312 of 1240 triangles, 91.2% of the area``; empty: all of it."""
    foliage: tuple[str, ...] = ()
    """What attenuates as foliage (ITU-R P.833), by kind and carrier, as ``tree*@v: 2.1 dB/m, at most 40 dB
    (measured)``; empty: nothing."""
    blockage: tuple[str, ...] = ()
    """People that are screens (3GPP TR 38.901, model B) and no bodies, by class; empty: none."""


class ChannelMatrix(Payload, frozen=True, kw_only=True, omit_defaults=True):
    """Narrowband MIMO channel of one carrier and one TX/RX pair, at the carrier frequency.

    Nr and Nt are the elements of the receiver's and of the transmitter's array: rows·columns, since 1.4 times
    the polarizations and the panels. Where arrays see plane waves (rungs ``free-space``, ``geometric``,
    ``siso-rt``), h[m, n] = Σ a·exp(+j2π/λ·(u_rx·d_m + u_tx·d_n)) over the paths, with λ of the carrier; u_tx
    the unit vector of ``aod`` and u_rx that of ``aoa``, both pointing away from their device; and d the place
    of an element from the reference point of its device, in world axes. In the axes of its panel element i is
    at (0, (⌊i/rows⌋ − (columns − 1)/2)·horizontal_spacing·λ, ((rows − 1)/2 − i mod rows)·vertical_spacing·λ);
    the panel's own position_m is added, and its rotation applied. ``a`` and ``tau`` are those between the
    devices' reference points, also where no panel stands there. Between other subarrays than those of
    `Channel.a`, amplitudes differ by the elements' patterns and polarizations.

    Example:
        >>> import numpy as np
        >>> ChannelMatrix(carrier=0, tx=0, rx=1, h=np.zeros((4, 32), np.complex128)).h.shape  # Nr × Nt
        (4, 32)
    """

    carrier: Annotated[int, quantity("1", "index into `Channel.carriers`", ge=0)]
    tx: Annotated[int, quantity("1", "index into `Channel.tx`", ge=0)]
    rx: Annotated[int, quantity("1", "index into `Channel.rx`", ge=0)]
    h: Annotated[
        Complex128Array,
        array("<c16", "Nr", "Nt", unit="1", doc="amplitude gain from TX element n to RX element m"),
    ]


class ChannelResponse(Payload, frozen=True, kw_only=True, omit_defaults=True):
    """Frequency response of one carrier and one TX/RX pair, at each subcarrier and slot of the carrier.

    With amplitudes a, delays τ and Doppler shifts ν of the paths, Δf from the carrier and Δt from the frame:
    H(Δf, Δt) = Σ a·exp(−j2π(Δf·(τ − Δt·ν/frequency_hz) − ν·Δt)), between elements as in ``h``, which it is
    at Δf = 0 and Δt = 0.

    Example:
        >>> import numpy as np
        >>> response = np.zeros((14, 264, 4, 32), np.complex64)  # slots × subcarriers × Nr × Nt
        >>> ChannelResponse(carrier=0, tx=0, rx=1, h=response).h.nbytes
        3784704
    """

    carrier: Annotated[int, quantity("1", "index into `Channel.carriers`", ge=0)]
    tx: Annotated[int, quantity("1", "index into `Channel.tx`", ge=0)]
    rx: Annotated[int, quantity("1", "index into `Channel.rx`", ge=0)]
    # Single precision: part `hf` is the largest there is, and 1e-7 of a gain is far below any model.
    h: Annotated[
        Complex64Array,
        array("<c8", "S", "K", "Nr", "Nt", unit="1", doc="amplitude gain from TX element n to RX element m"),
    ]


class ChannelTaps(Payload, frozen=True, kw_only=True, omit_defaults=True):
    """Sampled impulse response of one carrier and one TX/RX pair, in each slot of the carrier.

    Tap l is at the absolute delay (first + l)/W with the sampling rate W = ``bandwidth_hz``, after an ideal
    low-pass filter: h = Σ a·sinc(first + l − W·(τ − Δt·ν/frequency_hz))·exp(j2πν·Δt), where
    sinc(x) = sin(πx)/(πx). ``first`` is ⌊W·τ⌋ − 6 with the delay τ of the pair's earliest path, which may be
    negative, and 0 without a path; what arrives past the last tap is left out.

    Example:
        >>> import numpy as np
        >>> taps = ChannelTaps(carrier=0, tx=0, rx=1, first=-6, h=np.zeros((1, 64, 4, 32), np.complex64))
        >>> taps.first / 100e6  # [s] of the first tap at a bandwidth of 100 MHz
        -6e-08
    """

    carrier: Annotated[int, quantity("1", "index into `Channel.carriers`", ge=0)]
    tx: Annotated[int, quantity("1", "index into `Channel.tx`", ge=0)]
    rx: Annotated[int, quantity("1", "index into `Channel.rx`", ge=0)]
    first: Annotated[int, quantity("1", "sample of the first tap; 0 is the delay 0")]
    h: Annotated[
        Complex64Array,
        array("<c8", "S", "L", "Nr", "Nt", unit="1", doc="amplitude gain from TX element n to RX element m"),
    ]


class Channel(Payload, frozen=True, kw_only=True, omit_defaults=True):
    """Paths, and where asked for MIMO matrices, of all TX/RX pairs in a frame.

    Pair ``p`` is TX ``p // R`` and RX ``p % R`` with R receivers; its paths are
    ``offsets[p]:offsets[p + 1]``. Within a pair paths are sorted by: number of interactions,
    interaction types, object names, then delay, departure and arrival angles. Angles are in
    world axes: zenith from +z, azimuth counter-clockwise from +x. ``a`` contains
    exp(−j2πfτ): its phase is absolute, and τ is the true propagation delay. It is that between single
    elements; where a device has several panels or dual polarization, between the two subarrays (elements of
    one panel and one polarization) of its pair that most power passes between, on all carriers and paths.

    A path's ``id`` is unique in its pair. It is a hash of the interaction types, the names of the objects
    and, where a model knows them, the numbers of their faces, which are planes of an object; paths that agree
    in all that are numbered by their rank. So a path keeps its id while ends and objects move;
    `caviar_protocol.multipath.changes` says which were born and died between two products.

    Example:
        >>> from caviar_protocol.recording import Recording
        >>> channel = Recording("runs/smoke-20261122-101500")["channel"][7]
        >>> channel.rung, channel.tx, channel.rx, channel.a.shape  # carriers × paths
        ('free-space', ('bs',), ('car/rx', 'uav/rx-uav'), (1, 2))
    """

    sizes_from: ClassVar[dict[str, tuple[str, ...]]] = {"C": ("carriers",), "T": ("tx",), "R": ("rx",)}

    rung: str
    """Step of the fidelity ladder: ``free-space``, ``geometric``, ``siso-rt``, ``spherical``, ``mimo-rt``; of
    paths that were read from another program's files ``imported``."""
    options: ChannelOptions = ChannelOptions()
    """What was modelled."""
    expected_error_db: Annotated[
        float | None,
        quantity(
            "dB", "bound on the NMSE of all H together, if each pair is within its own; absent: unknown"
        ),
    ] = None
    carriers: tuple[Carrier, ...]
    """The carriers that axis C counts."""
    tx: tuple[str, ...]
    """Names of the transmitting devices, sorted."""
    rx: tuple[str, ...]
    """Names of the receiving devices, sorted."""
    los: Annotated[BoolArray, array("|b1", "T", "R", unit="1", doc="line of sight is free")]
    # One array of all pairs' paths with offsets: a list of arrays a pair would cost a header entry each.
    offsets: Annotated[Int64Array, array("<i8", "L1", unit="1", doc="T·R + 1 path offsets")]
    object_names: tuple[str, ...] = ()
    """What ``objects`` points into: moving objects and scenery by name."""
    # 64 bits: among 1e6 paths of a pair two hashes agree with a chance of 3e-8.
    id: Annotated[UInt64Array, array("<u8", "P", unit="1", doc="stable id: hash of types, objects and faces")]
    a: Annotated[Complex128Array, array("<c16", "C", "P", unit="1", doc="amplitude gain incl. exp(−j2πfτ)")]
    tau: Annotated[Float64Array, array("<f8", "P", unit="s", doc="absolute delay")]
    aod: Annotated[Float64Array, array("<f8", "P", 2, unit="rad", doc="departure (zenith, azimuth)")]
    aoa: Annotated[
        Float64Array,
        array("<f8", "P", 2, unit="rad", doc="direction the wave comes from (zenith, azimuth)"),
    ]
    doppler: Annotated[Float64Array, array("<f8", "C", "P", unit="Hz", doc="Doppler shift")]
    interactions: Annotated[
        UInt8Array,
        array(
            "|u1",
            "P",
            "D",
            unit="1",
            doc="what happens at each point, TX to RX: 0 nothing (past the last), 1 reflection, "
            "2 diffraction, 3 scattering, 4 transmission",
        ),
    ]
    # Zeros and no NaN: a product with numbers that are none is refused (clause 21).
    points: Annotated[
        Float64Array, array("<f8", "P", "D", 3, unit="m", doc="interaction points; 0 where none")
    ]
    objects: Annotated[
        Int32Array, array("<i4", "P", "D", unit="1", doc="index into object_names; −1 where none")
    ]
    h: tuple[ChannelMatrix, ...] = ()
    """One matrix per carrier and pair that uses it, carriers slowest; empty unless part ``h`` is in
    demand."""
    dropped: Annotated[int, quantity("1", "paths dropped for non-finite values", ge=0)] = 0
    hf: tuple[ChannelResponse, ...] = ()
    """One response per carrier with subcarriers and pair that uses it, carriers slowest; empty unless part
    ``hf`` is in demand."""
    taps: tuple[ChannelTaps, ...] = ()
    """One impulse response per carrier with taps and pair that uses it, likewise; empty unless part ``taps``
    is in demand."""
    error_bound_db: Annotated[
        Float64Array | None,
        array("<f8", "T", "R", unit="dB", doc="NMSE of H that nine of ten pairs are within; absent: unknown"),
    ] = None
    error_reference: str = ""
    """What errors are relative to: the rung and label of the channel that counts as exact; empty: unknown."""
    used: Annotated[
        BoolArray | None,
        array("|b1", "C", "T", "R", unit="1", doc="both ends use the carrier; absent: all pairs use all"),
    ] = None
    """Whether both ends of a pair use a carrier; absent: all use all. On a carrier that it does not use a
    pair is no user and has no matrix, response and taps, and ``a`` is 0; one that uses none has no paths."""

    def uses(self, carrier: int, tx: int, rx: int) -> bool:
        """Return whether both ends of a pair use a carrier.

        Args:
            carrier: Index into ``carriers``.
            tx: Index into ``tx``.
            rx: Index into ``rx``.
        """
        return self.used is None or bool(self.used[carrier, tx, rx])

    def check(self) -> None:
        """``offsets`` cuts the path axis into one run for each pair."""
        # As a list: for a few dozen pairs Python's comparisons are quicker than NumPy's calls.
        offsets, pairs, paths = self.offsets.tolist(), len(self.tx) * len(self.rx), len(self.tau)
        if len(offsets) != pairs + 1 or offsets[0] != 0 or offsets[-1] != paths or offsets != sorted(offsets):
            raise PayloadError(
                f"Channel.offsets {offsets!r:.80} does not cut {paths} paths into {pairs} pairs: "
                f"it needs {pairs + 1} ascending entries from 0 to {paths}"
            )

    def pair(self, tx: str, rx: str) -> slice:
        """Slice of the path axis that belongs to one TX/RX pair.

        Args:
            tx: Name of the transmitting device.
            rx: Name of the receiving device.

        Raises:
            ValueError: The channel has no such device.

        Example:
            >>> from caviar_protocol.recording import Recording
            >>> channel = Recording("runs/smoke-20261122-101500")["channel"][0]
            >>> channel.tau[channel.pair("bs", "car/rx")].shape  # paths
            (1,)
        """
        p = self.tx.index(tx) * len(self.rx) + self.rx.index(rx)
        return slice(int(self.offsets[p]), int(self.offsets[p + 1]))


class Cause(Enum):
    """Cause for which no path reaches a user; of several causes the one that stands first."""

    NOT_FINITE = "not finite"
    """The paths that were found have values that are not finite, and were dropped: a defect of the model."""
    INSIDE = "inside an object"
    """An end is inside a building or a body, its own or another."""
    TOO_CLOSE = "too close"
    """The ends are nearer to each other than one wavelength, where no path loss holds."""
    OUT_OF_RANGE = "out of range"
    """An end is beside the scenery or below its lowest point, and its line of sight is not free."""
    BLOCKED = "blocked"
    """Something stands between the ends, and no way around it was found."""
    NOT_FOUND = "no path found"
    """The line of sight is free, but not modelled, or of amplitude 0."""

    @property
    def count_name(self) -> str:
        """Name in the counts of a report, as ``no-path/out-of-range``."""
        return f"no-path/{self.value.replace(' ', '-')}"


UNMATCHED_PREFIX = "unmatched/"
"""Before ``SETTING.KEY`` in the counts of a report: a key that is for nothing in the frame."""
# Counts are maps of text to numbers: what is counted stands in the name.
INSIDE_PREFIX = "inside/"
"""Before ``ANTENNA in OBJECT`` in the counts of a report: an antenna that no path reaches, and the object
that it stands inside."""
