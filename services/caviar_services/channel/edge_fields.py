"""Fields of diffracted paths, in float64 from the meshes' own corners.

Those of the ray tracer change by 10 dB and more with where a scene stands, for the first two reasons:

- Of a path with fewer interactions than the solver's depth, it counts the way from the last point to the
  origin of coordinates, and from there to the receiver, as the length behind the edge.
- A ray in the plane of a face is neither before nor behind it, and rounding in float32 says one or the other:
  the wedge is then taken for its mirror image, the angle 0 for 2π, or a face for one in the shadow.
- The terms that make up for the reflected wave where it ends have its opposite sign.

Here legs are those of the path, faces those of the mesh, angles those of the exterior, and what lies in a
plane to within `_IN_PLANE` counts as lying in it.

The coefficient is that of the uniform theory of diffraction (R. G. Kouyoumjian and P. H. Pathak, "A
uniform geometrical theory of diffraction for an edge in a perfectly conducting surface", Proc. IEEE 62(11),
1974) for a wedge of reflection matrices R0 and Rn, in the ray tracer's heuristic form: exact for a conductor
and a field along the edge, else where light and reflection end,

D = R0·(D1 − D4) + Rn·(D2 − D3), Di = −exp(−jπ/4) / (2n·sqrt(2πk)·sin β0) · cot(ψi)·F(kL·ai),

with Rn = −1 for a face in the shadow.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from caviar_protocol.arrays import BoolArray, Complex128Array, Float64Array, Int64Array, UInt8Array
from caviar_protocol.coordinates import SPEED_OF_LIGHT
from caviar_protocol.topics import Interaction
from caviar_services.channel.contributing import slab
from caviar_services.channel.vectors import cross

_IN_PLANE = 1e-8
"""[rad]; a ray this near the plane of a face is in it, and this near a shadow boundary on its lit side."""

_FLAT = 1e-6
"""Sine of the angle between faces below which they are one plane, or lie upon one another."""

_SIGN = -1.0
"""Of reflection matrices in the bases of diffraction, which turn round from the incoming to the outgoing ray:
with it the field is continuous where reflection ends, without it, as in the ray tracer, it is not."""

_ALONG = 1e-9
"""Sine of the angle between two directions below which they are one."""


@dataclass(frozen=True, eq=False)
class Media:
    """What surfaces at the interactions of P paths are made of, on C carriers."""

    permittivity: Float64Array
    """Relative, Shape ``[C, P, D]``."""
    conductivity: Float64Array
    """[S/m], Shape ``[C, P, D]``."""
    thickness: Float64Array
    """[m], Shape ``[P, D]``."""
    scattering: Float64Array
    """Scattering coefficients, Shape ``[P, D]``."""


@dataclass(frozen=True, eq=False)
class Faces:
    """The two faces of P wedges; the first of them is counted from."""

    normals: Float64Array
    """Unit, outward, Shape ``[P, 2, 3]``."""
    edge: Float64Array
    """Unit, along the edge, such that normal × edge leads into the first face, Shape ``[P, 3]``."""

    @property
    def exterior(self) -> Float64Array:
        """Angle between the faces outside of the wedge [rad], Shape ``[P]``: n·π in the coefficients."""
        first, second = np.moveaxis(self.normals, 1, 0)
        cosine, sine = -(first * second).sum(-1), _sine(first, second)
        exterior: Float64Array = 2 * np.pi - np.arctan2(sine, cosine)
        return exterior

    def seen_along(self, k: Float64Array) -> Faces:
        """The same, counted from the face that rays of directions ``k`` ``[P, 3]`` meet more steeply."""
        met = -(self.normals * k[:, None]).sum(-1)
        swap = (met[:, 1] > met[:, 0] + _IN_PLANE)[:, None]
        return Faces(
            np.where(swap[..., None], self.normals[:, ::-1], self.normals),
            np.where(swap, -self.edge, self.edge),
        )


def faces_of(corners: Float64Array, ends: Float64Array) -> tuple[Faces, BoolArray]:
    """Wedges of pairs of triangles, and where they are one: not where two share no side, or one has no area.

    Parameters
    ----------
    corners
        Of both triangles [m], Shape ``[P, 2, 3, 3]``.
    ends
        About where the edge ends [m], Shape ``[P, 2, 3]``: triangles that lie upon one another share three.
    """
    first, second = corners[:, 0], corners[:, 1]
    same = (first[:, :, None] == second[:, None]).all(-1)
    shared = same.any(2)
    sides = shared & np.roll(shared, -1, axis=1)  # side i runs from corner i to i + 1
    middles = (first + np.roll(first, -1, axis=1)) / 2 - ends.mean(1)[:, None]
    side = np.argmin(np.where(sides, (middles**2).sum(-1), np.inf), axis=1)
    rows = np.arange(len(corners))
    begin, end, apex = first[rows, side], first[rows, (side + 1) % 3], first[rows, (side + 2) % 3]
    on_edge = (second == begin[:, None]).all(-1) | (second == end[:, None]).all(-1)
    others = apex, second[rows, np.argmin(on_edge, axis=1)]
    with np.errstate(invalid="ignore", divide="ignore"):  # of what is no wedge
        edge = _unit(end - begin)
        inward = [_unit(_across(other - begin, edge)) for other in others]
        normals = [np.cross(edge, part) for part in inward]
        for normal, other in zip(normals, inward[::-1], strict=True):
            normal *= np.where((normal * other).sum(-1, keepdims=True) > 0, -1.0, 1.0)
        # One plane is seen from one side, two faces that lie upon one another from both.
        level = (_sine(*inward) < _FLAT)[:, None]
        turned = np.where((inward[0] * inward[1]).sum(-1, keepdims=True) > 0, -normals[0], normals[0])
        normals[1] = np.where(level, turned, normals[1])
        leads_in = (np.cross(normals[0], edge) * inward[0]).sum(-1, keepdims=True) >= 0
    is_edge = sides.any(1) & np.isfinite(normals).all((0, 2))
    return Faces(np.stack(normals, axis=1), np.where(leads_in, edge, -edge)), is_edge


def edge_fields(
    corners: Float64Array,
    types: UInt8Array,
    normals: Float64Array,
    faces: Faces,
    media: Media,
    wavelengths: Sequence[float],
) -> Complex128Array:
    """Dyads of `PathTable` of paths that are diffracted once, Shape ``[C, P, 3, 3]``; not finite where the
    geometry leaves none.

    Parameters
    ----------
    corners
        TX, interaction points, and RX in all places behind the last one [m], Shape ``[P, D + 2, 3]``.
    types
        `Interaction` at each point, Shape ``[P, D]``: reflections, transmissions, and one diffraction.
    normals
        Of the triangle at each point, of any length, Shape ``[P, D, 3]``.
    faces
        Of the wedge.
    media
        At each point.
    wavelengths
        Of the carriers [m].
    """
    steps = np.diff(corners, axis=1)
    lengths = np.sqrt((steps**2).sum(-1))
    bent = types == Interaction.DIFFRACTION
    behind = np.cumsum(bent, axis=1) > 0
    s_in = lengths[:, 0] + (lengths[:, 1:] * ~behind).sum(1)
    s_out = (lengths[:, 1:] * behind).sum(1)
    fields = []
    for carrier, wavelength in enumerate(wavelengths):
        k = _unit(steps[:, 0])
        field = np.eye(3) - k[:, :, None] * k[:, None] + 0j
        for d in range(types.shape[1]):
            going = types[:, d] != 0
            out = np.where(going[:, None], _unit(steps[:, d + 1]), k)
            constants = media.permittivity[carrier, :, d], media.conductivity[carrier, :, d]
            wall = Wall(*constants, media.thickness[:, d], media.scattering[:, d], wavelength)
            flat = wall.dyad(k, _unit(normals[:, d]), types[:, d] == Interaction.TRANSMISSION)
            there = bent[:, d]
            if there.any():
                rows = np.flatnonzero(there)
                flat[rows] = _diffracted(
                    k[rows],
                    out[rows],
                    Faces(faces.normals[rows], faces.edge[rows]).seen_along(k[rows]),
                    wall.take(rows),
                    (s_in[rows], s_out[rows]),
                )
            field = np.where(going[:, None, None], flat @ field, field)
            k = out
        spreading = 1 / np.sqrt(s_in * s_out * (s_in + s_out))
        fields.append(field * (wavelength / (4 * np.pi) * spreading)[:, None, None])
    return np.stack(fields)


@dataclass(frozen=True, eq=False)
class Wall:
    """Slabs that P rays meet, at one wavelength [m]."""

    permittivity: Float64Array
    conductivity: Float64Array
    thickness: Float64Array
    scattering: Float64Array
    wavelength: float

    def take(self, rows: Int64Array) -> Wall:
        """Those of these rays."""
        return Wall(
            self.permittivity[rows],
            self.conductivity[rows],
            self.thickness[rows],
            self.scattering[rows],
            self.wavelength,
        )

    def dyad(self, k: Float64Array, normal: Float64Array, through: BoolArray) -> Complex128Array:
        """From the field that comes in along ``k`` to what is reflected, or goes through."""
        across = (k * normal).sum(-1)
        frequency = SPEED_OF_LIGHT / self.wavelength
        back, passed = slab(np.abs(across), (self.permittivity, self.conductivity), self.thickness, frequency)
        te, tm = np.where(through, passed, back * np.sqrt(1 - self.scattering**2))
        s = _unit(_perpendicular(k, normal))
        out = np.where(through[:, None], k, k - 2 * across[:, None] * normal)
        return _outer(te[:, None] * s, s) + _outer(tm[:, None] * cross(out, s), cross(k, s))


def _diffracted(
    k: Float64Array, out: Float64Array, faces: Faces, wall: Wall, legs: tuple[Float64Array, Float64Array]
) -> Complex128Array:
    """Dyads of diffraction, without spreading, from ``k`` to ``out``; ``legs`` [m] are s' and s."""
    edge, (face_0, face_n) = faces.edge, np.moveaxis(faces.normals, 1, 0)
    exterior = faces.exterior
    angle_in, angle_out = (_angle(direction, faces, exterior) for direction in (-k, out))
    d14, d23 = _coefficients(angle_in, angle_out, exterior, _sine(k, edge), legs, wall.wavelength)
    s_in, s_out = _unit(np.cross(k, edge)), -_unit(np.cross(out, edge))
    incoming = np.stack([s_in, np.cross(k, s_in)], axis=1)
    outgoing = np.stack([s_out, np.cross(out, s_out)], axis=1)
    no = np.zeros(len(k), np.bool_)
    parts = []
    for normal in (face_0, face_n):
        sent_back = k - 2 * (k * normal).sum(-1, keepdims=True) * normal
        s_back = -_unit(np.cross(sent_back, edge))
        back = np.stack([s_back, np.cross(sent_back, s_back)], axis=1)
        parts.append(_SIGN * back @ wall.dyad(k, normal, no) @ incoming.transpose(0, 2, 1))
    shadowed = exterior >= np.pi + angle_in - _IN_PLANE
    r_n = np.where(shadowed[:, None, None], -np.eye(2), parts[1])
    jones = parts[0] * d14[:, None, None] + r_n * d23[:, None, None]
    dyad: Complex128Array = outgoing.transpose(0, 2, 1) @ jones @ incoming
    return dyad


def _angle(direction: Float64Array, faces: Faces, exterior: Float64Array) -> Float64Array:
    """Angle about the edge from the first face [rad], within the exterior: what rounding puts inside the
    wedge is at the nearer face."""
    normal = faces.normals[:, 0]
    into = np.cross(normal, faces.edge)
    angle = np.arctan2((direction * normal).sum(-1), (direction * into).sum(-1)) % (2 * np.pi)
    inside = angle > exterior
    nearer = np.where(angle - exterior < 2 * np.pi - angle, exterior, 0.0)
    angle = np.where(inside, nearer, angle)
    angle = np.where(angle < _IN_PLANE, 0.0, angle)
    clamped: Float64Array = np.where(exterior - angle < _IN_PLANE, exterior, angle)
    return clamped


def _coefficients(
    angle_in: Float64Array,
    angle_out: Float64Array,
    exterior: Float64Array,
    sine: Float64Array,
    legs: tuple[Float64Array, Float64Array],
    wavelength: float,
) -> tuple[Complex128Array, Complex128Array]:
    """D1 − D4 and D2 − D3."""
    k, n = 2 * np.pi / wavelength, exterior / np.pi
    kl = k * legs[0] * legs[1] / (legs[0] + legs[1]) * sine**2
    factor = -np.exp(-0.25j * np.pi) / (2 * n * np.sqrt(2 * np.pi * k) * sine)
    apart, both = angle_out - angle_in, angle_out + angle_in
    d1, d2, d3, d4 = (
        factor * _cot_f(sign * beta, exterior, kl) for beta in (apart, both) for sign in (1, -1)
    )
    return d1 - d4, d2 - d3


def _cot_f(beta: Float64Array, exterior: Float64Array, kl: Float64Array) -> Complex128Array:
    """cot(ψ)·F(kL·a) with ψ = (π + β)/2n and a = 2·cos²(nπN − β/2), N the nearest integer to (π + β)/2nπ.

    At a shadow boundary cot is infinite and F is 0: with F(x) = 2·sqrt(πx)·exp(jπ/4)·K(sqrt(x)), K the
    modified Fresnel integral, what remains is sqrt(a)/sin(ψ), which is sqrt(2)·n there.
    """
    from scipy.special import modfresnelm  # type: ignore[import-untyped]

    n = exterior / np.pi
    psi = (np.pi + beta) / (2 * n)
    off = np.pi + beta - 2 * exterior * np.round((np.pi + beta) / (2 * exterior))
    root = np.sqrt(2.0) * np.abs(np.sin(off / 2))
    on = np.abs(off) < _IN_PLANE
    ratio = np.where(on, np.sqrt(2.0) * n, root / np.where(on, 1.0, np.sin(psi)))
    _, k_minus = modfresnelm(np.sqrt(kl) * root)
    product: Complex128Array = 2 * np.sqrt(np.pi * kl) * np.exp(0.25j * np.pi) * np.cos(psi) * ratio * k_minus
    return product


def _sine(one: Float64Array, other: Float64Array) -> Float64Array:
    sine: Float64Array = np.sqrt((np.cross(one, other) ** 2).sum(-1))
    return sine


def _perpendicular(k: Float64Array, normal: Float64Array) -> Float64Array:
    """A direction across both; any across ``k`` where both are one."""
    across = cross(k, normal)
    axis = np.eye(3)[np.argmin(np.abs(k), axis=-1)]
    lost = (across**2).sum(-1, keepdims=True) < _ALONG**2
    perpendicular: Float64Array = np.where(lost, cross(k, axis), across)
    return perpendicular


def _across(vectors: Float64Array, axis: Float64Array) -> Float64Array:
    """What of vectors is across unit vectors."""
    across: Float64Array = vectors - (vectors * axis).sum(-1, keepdims=True) * axis
    return across


def _outer(one: Complex128Array | Float64Array, other: Float64Array) -> Complex128Array:
    outer: Complex128Array = one.astype(np.complex128)[:, :, None] * other[:, None]
    return outer


def _unit(vectors: Float64Array) -> Float64Array:
    unit: Float64Array = vectors / np.sqrt((vectors**2).sum(-1, keepdims=True))
    return unit
