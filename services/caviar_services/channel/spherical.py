"""Rung ``spherical``: the paths of ``siso-rt``, with the exact length of each between any two elements.

H[m, n] = Σ_p a_p · (s_p[m, n] / s_p) · exp(−j2πf(d_p[m, n] − d_p)/c), over the paths that elements m and n have,
with the length d and the spreading s between the elements (s = 1/d but for diffraction and scattering,
see `element_paths`) and d_p, s_p those between the arrays' centres, which a_p belongs to.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from caviar_protocol.arrays import Complex128Array, Float64Array, Int64Array
from caviar_protocol.coordinates import SPEED_OF_LIGHT
from caviar_protocol.topics import Carrier, ChannelMatrix
from caviar_services.antenna import element_positions
from caviar_services.channel.assemble import Antenna, Located
from caviar_services.channel.element_paths import ElementPaths, Surfaces
from caviar_services.channel.visibility import Elements, Nearest, Visibility, visibility
from caviar_services.columns import aligned_columns

_LANES = 1 << 15
"""Element pairs times paths computed at once: what stays in a processor's cache."""


def elements(antennas: Sequence[Antenna], wavelength: float) -> Elements:
    """Elements of antennas where they stand at a wavelength [m]: arrays are given in wavelengths."""
    sizes = np.array([antenna.array.size for antenna in antennas], np.int64)
    places = [
        antenna.position + wavelength * element_positions(antenna.array) @ antenna.rotation.T
        for antenna in antennas
    ]
    return Elements(
        arrays=tuple(antenna.array for antenna in antennas),
        first=np.cumsum(sizes) - sizes,
        positions=np.concatenate([np.zeros((0, 3)), *places]),
    )


def nearest_in(mi_scene: Any) -> Nearest:
    """Distances to the first surface of a Mitsuba scene."""

    def nearest(origin: Float64Array, direction: Float64Array) -> Float64Array:
        import mitsuba as mi

        columns = aligned_columns(np.concatenate([origin, direction], axis=1).T)
        start, along = mi.Point3f(*map(mi.Float, columns[:3])), mi.Vector3f(*map(mi.Float, columns[3:]))
        met = mi_scene.ray_intersect_preliminary(mi.Ray3f(start, along), coherent=False)
        distance: Float64Array = met.t.numpy().astype(np.float64)
        return distance

    return nearest


class SphericalWaves:
    """Makes the matrices of a frame.

    Element patterns, polarisation and the reflection and diffraction coefficients are those of the path
    between the arrays' centres, as in ``siso-rt``.

    Parameters
    ----------
    surfaces
        What the paths meet, in the order of the model's table.
    nearest
        Answers rays in this frame's scene.
    """

    def __init__(self, surfaces: Surfaces, nearest: Nearest) -> None:
        self._surfaces = surfaces
        self._nearest = nearest

    def __call__(
        self,
        carriers: Sequence[Carrier],
        transmitters: Sequence[Antenna],
        receivers: Sequence[Antenna],
        located: Located,
    ) -> tuple[ChannelMatrix, ...]:
        paths = ElementPaths(self._surfaces.take(located.row))
        made: list[ChannelMatrix] = []
        for carrier, properties in enumerate(carriers):
            wavelength = SPEED_OF_LIGHT / properties.frequency_hz
            transmit, receive = elements(transmitters, wavelength), elements(receivers, wavelength)
            tx, rx = np.divmod(located.pair, max(len(receivers), 1))
            seen = visibility(paths, tx, rx, transmit, receive, self._nearest)
            centres = _positions(transmitters)[tx], _positions(receivers)[rx]
            made += [
                ChannelMatrix(carrier=carrier, tx=pair // len(receivers), rx=pair % len(receivers), h=h)
                for pair, h in enumerate(
                    _matrices(paths, located, located.a[carrier], wavelength, transmit, receive, seen, centres)
                )
            ]
        return tuple(made)


def _positions(antennas: Sequence[Antenna]) -> Float64Array:
    return np.array([antenna.position for antenna in antennas]).reshape(-1, 3)


def _matrices(
    paths: ElementPaths,
    located: Located,
    a: Complex128Array,
    wavelength: float,
    transmit: Elements,
    receive: Elements,
    seen: Visibility,
    centres: tuple[Float64Array, Float64Array],
) -> Iterator[Complex128Array]:
    """H of each pair of antennas, in order."""
    reference = paths.lengths(slice(0, len(a)), centres[0][:, None], centres[1][:, None])
    amplitude = a / reference.spreading[:, 0, 0]
    for group in _groups(located.offsets, transmit, receive):
        begin, end = int(located.offsets[group.start]), int(located.offsets[group.stop])
        rows = slice(begin, end)
        tx, rx = np.divmod(located.pair[rows], max(len(receive.arrays), 1))
        sizes = _sizes(group.start, transmit, receive)
        if begin == end:
            for _ in range(group.start, group.stop):
                yield np.zeros(sizes, np.complex128)
            continue
        lengths = paths.lengths(
            rows,
            transmit.positions[transmit.first[tx][:, None] + np.arange(sizes[1])],
            receive.positions[receive.first[rx][:, None] + np.arange(sizes[0])],
        )
        turns = ((located.geometry.tau[rows] * SPEED_OF_LIGHT)[:, None, None] - lengths.length) / wavelength
        turns -= np.round(turns)
        turns *= 2 * np.pi
        waves = np.empty(turns.shape, np.complex128)
        np.cos(turns, out=waves.real)
        np.sin(turns, out=waves.imag)
        waves *= lengths.spreading
        for path in np.flatnonzero(~seen.every[rows]).tolist():
            waves[path] *= seen.some.get(begin + path, False)
        waves *= amplitude[rows, None, None]
        bounds = located.offsets[group.start : group.stop + 1] - begin
        for first, last in zip(bounds[:-1].tolist(), bounds[1:].tolist(), strict=True):
            yield waves[first:last].sum(0)


def _sizes(pair: int, transmit: Elements, receive: Elements) -> tuple[int, int]:
    tx, rx = divmod(pair, len(receive.arrays))
    return receive.arrays[rx].size, transmit.arrays[tx].size


def _groups(offsets: Int64Array, transmit: Elements, receive: Elements) -> Iterator[slice]:
    """Consecutive pairs of arrays of the same sizes, as many as are computed at once."""
    pairs = len(offsets) - 1
    begin = 0
    while begin < pairs:
        sizes = _sizes(begin, transmit, receive)
        most = offsets[begin] + _LANES // (sizes[0] * sizes[1])
        end = begin + 1
        while end < pairs and offsets[end + 1] <= most and _sizes(end, transmit, receive) == sizes:
            end += 1
        yield slice(begin, end)
        begin = end
