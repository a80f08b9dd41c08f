"""Fields at surfaces and edges, in float64: Fresnel's coefficients of slabs (ITU-R P.2040-3), and diffraction
coefficients of edges by the uniform theory of diffraction (UTD).

Sionna RT's own diffracted fields are not used. They change by 10 dB and more with the place of a scene,
since

- of a path with fewer interactions than the solver's depth, the way from the last point to the origin of
  coordinates, and from there to the receiver, counts as the length after the edge;
- a ray in the plane of a face is neither before nor behind it, and rounding in float32 says one or the other:
  the wedge is then taken for its mirror image, the angle 0 for 2π, or a face for one in the shadow;

and the terms that make up for the reflected wave where it ends have its opposite sign.

Here legs are those of the path, faces and corners those of the mesh, angles those of the exterior, and what
lies in a plane to within `IN_PLANE` counts as lying in it. The two faces may be of different materials.

The diffraction coefficient is that of the uniform theory of diffraction (R. G. Kouyoumjian and P. H. Pathak,
"A uniform geometrical theory of diffraction for an edge in a perfectly conducting surface", Proc. IEEE
62(11), 1974) for a wedge of reflection matrices R0 and Rn, in the ray tracer's heuristic form: exact for a
conductor and a field along the edge, else where light and reflection end,

D = R0·(D1 − D4) + Rn·(D2 − D3), Di = −exp(−jπ/4) / (2n·sqrt(2πk)·sin β0) · cot(ψi)·F(kL·ai),

with Rn = −1 for a face in the shadow.

Each Di changes its sign at one boundary: D1 and D2 where the wave that passes the edge ends, D4 and D3 where
the waves end that the first and the second face reflect. `Bends.margins` says how far off these are. Where
it is known otherwise which of these waves there are, ``lit`` says so, and the sum of all waves is continuous.

That sum is continuous only if lines of sight, reflections and diffracted fields go by one decision. A ray
tracer in float32 decides about lines of sight to some micrometres, and about reflections to a millimetre. So
the diffracted field's own angles, in float64, decide about lines of sight that pass an edge within
`_UNSURE`; about other waves there, it goes by what the ray tracer has decided (`waves_beside`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from caviar_protocol.arrays import BoolArray, Complex128Array, Float64Array, Int64Array, UInt8Array
from caviar_protocol.space.coordinates import SPEED_OF_LIGHT
from caviar_protocol.topics import Interaction
from caviar_space.materials import EPSILON_0
from caviar_space.vectors import Rows, cross, unit

# Sine of the angle between two directions below which they are one.
_ALONG = 1e-9


def slab(
    cosine: Float64Array,
    constants: tuple[float, float] | tuple[Float64Array, Float64Array],
    thickness_m: float | Float64Array,
    frequency_hz: float,
) -> tuple[Complex128Array, Complex128Array]:
    """Reflection and transmission coefficients of slabs in air (ITU-R P.2040-3, eqs. 37, 43 and 44).

    Args:
        cosine: Of the angles between rays and the normal, Shape ``[N]``.
        constants: Relative permittivity and conductivity [S/m], of one slab or of each ray's.
        thickness_m: Likewise [m].
        frequency_hz: Of the wave [Hz].

    Returns:
        Reflection and transmission of fields, TE and TM: Shape ``[2, N]`` each.

    Example:
        >>> back, through = slab(np.array([1.0]), (4.0, 0.0), 0.01, 7.5e9)  # a half of a wavelength in it
        >>> bool(np.allclose(back, 0.0, atol=2e-3)), bool(np.allclose(abs(through), 1.0, atol=1e-3))
        (True, True)
    """
    permittivity, conductivity = constants
    eta = permittivity - 1j * conductivity / (2 * np.pi * frequency_hz * EPSILON_0)
    root = np.sqrt(eta - (1 - cosine**2))
    # Coefficients of one face (eq. 37), then all bounces between both faces (eqs. 43 and 44).
    single = np.stack([(cosine - root) / (cosine + root), (eta * cosine - root) / (eta * cosine + root)])
    through = np.exp(-2j * np.pi * thickness_m * frequency_hz / SPEED_OF_LIGHT * root)
    many = 1 - (single * through) ** 2
    return single * (1 - through**2) / many, (1 - single**2) * through / many


@dataclass(frozen=True, eq=False)
class Media:
    """Materials of the surfaces at the interactions of P paths, on C carriers."""

    permittivity: Float64Array
    """Relative, Shape ``[C, P, D]``."""
    conductivity: Float64Array
    """[S/m], Shape ``[C, P, D]``."""
    thickness: Float64Array
    """[m], Shape ``[P, D]``."""
    scattering: Float64Array
    """Scattering coefficients, Shape ``[P, D]``."""


@dataclass(frozen=True, eq=False)
class Wall(Rows):
    """Slabs that P rays meet, at one wavelength [m]."""

    permittivity: Float64Array
    conductivity: Float64Array
    thickness: Float64Array
    scattering: Float64Array
    wavelength: float

    @classmethod
    def of(cls, media: Media, carrier: int, d: int, wavelength: float) -> Wall:
        """Slabs at interaction ``d`` of paths on a carrier, by its index and wavelength [m]."""
        constants = media.permittivity[carrier, :, d], media.conductivity[carrier, :, d]
        return cls(*constants, media.thickness[:, d], media.scattering[:, d], wavelength)

    def where(self, which: BoolArray, other: Wall) -> Wall:
        """These slabs where ``which`` is true, and those of another elsewhere."""
        return Wall(
            np.where(which, self.permittivity, other.permittivity),
            np.where(which, self.conductivity, other.conductivity),
            np.where(which, self.thickness, other.thickness),
            np.where(which, self.scattering, other.scattering),
            self.wavelength,
        )

    def dyad(self, k: Float64Array, normal: Float64Array, through: BoolArray) -> Complex128Array:
        """Dyads from the incoming field to the reflected one, or to that which goes through.

        Args:
            k: Unit vectors along incoming waves, Shape ``[P, 3]``.
            normal: Unit normals, Shape ``[P, 3]``.
            through: Waves that go through, Shape ``[P]``; the others are reflected, weaker by what scatters.

        Returns:
            Dyads of Shape ``[P, 3, 3]``.
        """
        across = (k * normal).sum(-1)
        frequency = SPEED_OF_LIGHT / self.wavelength
        back, passed = slab(np.abs(across), (self.permittivity, self.conductivity), self.thickness, frequency)
        # What a surface scatters is missing from the reflected field alone.
        te, tm = np.where(through, passed, back * np.sqrt(1 - self.scattering**2))
        s = unit(_perpendicular(k, normal))
        out = np.where(through[:, None], k, k - 2 * across[:, None] * normal)
        return _outer(te[:, None] * s, s) + _outer(tm[:, None] * cross(out, s), cross(k, s))


def reflection_fields(
    corners: Float64Array,
    count: Int64Array,
    normals: Float64Array,
    through: BoolArray,
    media: Media,
    wavelengths: Sequence[float],
) -> Complex128Array:
    """Fields of reflected and transmitted paths.

    Args:
        corners: TX, points of interactions, and RX in all places past the last one [m], ``[P, D + 2, 3]``.
        count: Interactions of each path, Shape ``[P]``.
        normals: Unit normal of the plane at each point, Shape ``[P, D, 3]``.
        through: Which of them let the wave through, Shape ``[P, D]``; the others reflect it.
        media: Materials at each point.
        wavelengths: Of the carriers [m].

    Returns:
        Dyads of `PathTable` with the spreading λ/(4πd) of the paths' lengths, Shape ``[C, P, 3, 3]``.

    Example:
        >>> nothing = np.zeros((1, 1, 0))
        >>> free = Media(nothing, nothing, nothing[0], nothing[0])
        >>> corners, none = np.array([[[0.0, 0, 0], [10.0, 0, 0]]]), np.zeros((1, 0))
        >>> fields = reflection_fields(corners, np.array([0]), np.zeros((1, 0, 3)), none > 0, free, [0.01])
        >>> [round(1e6 * abs(x)) for x in np.diag(fields[0, 0])]  # λ/(4πd), across the path alone
        [0, 80, 80]
    """
    steps = np.diff(corners, axis=1)
    lengths = np.sqrt(np.einsum("pdc,pdc->pd", steps, steps))
    directions = steps / np.where(lengths > 0, lengths, 1.0)[..., None]
    total = lengths.sum(1)
    first = directions[:, 0]
    # A field has no component along its direction.
    transverse = np.eye(3) - first[:, :, None] * first[:, None]
    fields = np.empty((len(wavelengths), len(count), 3, 3), np.complex128)
    for carrier, wavelength in enumerate(wavelengths):
        field = transverse + 0j
        for d in range(normals.shape[1]):
            rows = np.flatnonzero(count > d)
            wall = Wall.of(media, carrier, d, wavelength).take(rows)
            dyad = wall.dyad(directions[rows, d], normals[rows, d], through[rows, d])
            field[rows] = dyad @ field[rows]
        fields[carrier] = field * (wavelength / (4 * np.pi) / total)[:, None, None]
    return fields


def _perpendicular(k: Float64Array, normal: Float64Array) -> Float64Array:
    """Directions across both vectors; any direction across ``k`` where both are parallel."""
    across = cross(k, normal)
    axis = np.eye(3)[np.argmin(np.abs(k), axis=-1)]
    lost = (across**2).sum(-1, keepdims=True) < _ALONG**2
    perpendicular: Float64Array = np.where(lost, cross(k, axis), across)
    return perpendicular


def _outer(one: Complex128Array | Float64Array, other: Float64Array) -> Complex128Array:
    outer: Complex128Array = one.astype(np.complex128)[:, :, None] * other[:, None]
    return outer


IN_PLANE = 1e-8
"""[rad]; a ray this near the plane of a face is in it, and this near a shadow boundary on its lit side."""

# Sine of the angle between faces below which they are one plane, or lie upon one another.
_FLAT = 1e-6

# Of reflection matrices in the bases of diffraction, which turn round from the incoming to the outgoing ray:
# with it the field is continuous where reflection ends, without it, as in the ray tracer, it is not.
_SIGN = -1.0


@dataclass(frozen=True, eq=False)
class Wedges(Rows):
    """Both faces of P wedges; angles are counted from the first one."""

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

    def turned(self, swap: BoolArray) -> Wedges:
        """The same wedges, with the other face first where ``swap`` is true."""
        return Wedges(
            np.where(swap[:, None, None], self.normals[:, ::-1], self.normals),
            np.where(swap[:, None], -self.edge, self.edge),
        )


def wedges_of(ends: Float64Array, apexes: Float64Array) -> tuple[Wedges, BoolArray]:
    """Wedges from points of a mesh.

    Args:
        ends: Both ends of the edges [m], Shape ``[P, 2, 3]``.
        apexes: A point of each face that is not on the edge [m], Shape ``[P, 2, 3]``; of a single face,
            twice.

    Returns:
        The wedges, and which of them are any, Shape ``[P]``: not where an edge has no length or a face no
        width.

    Example:
        >>> edge = np.array([[[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]]])
        >>> wedges, is_edge = wedges_of(edge, np.array([[[-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]]))
        >>> is_edge.tolist(), np.degrees(wedges.exterior).tolist()  # the corner of a house
        ([True], [270.0])
    """
    begin, end = ends[:, 0], ends[:, 1]
    with np.errstate(invalid="ignore", divide="ignore"):  # of what is no wedge
        edge = unit(end - begin)
        inward = [unit(_across(apexes[:, face] - begin, edge)) for face in (0, 1)]
        normals = [np.cross(edge, part) for part in inward]
        for normal, other in zip(normals, inward[::-1], strict=True):
            normal *= np.where((normal * other).sum(-1, keepdims=True) > 0, -1.0, 1.0)
        # One plane is seen from one side, two faces that lie upon one another from both.
        level = (_sine(*inward) < _FLAT)[:, None]
        turned = np.where((inward[0] * inward[1]).sum(-1, keepdims=True) > 0, -normals[0], normals[0])
        normals[1] = np.where(level, turned, normals[1])
        leads_in = (np.cross(normals[0], edge) * inward[0]).sum(-1, keepdims=True) >= 0
    is_edge: BoolArray = np.asarray(np.isfinite(normals).all((0, 2)))
    return Wedges(np.stack(normals, axis=1), np.where(leads_in, edge, -edge)), is_edge


@dataclass(frozen=True, eq=False)
class Bends(Rows):
    """Directions, legs and wedges of P paths at their edges."""

    at: Int64Array
    """Interaction that is the diffraction, Shape ``[P]``."""
    k: Float64Array
    """Unit vectors along incoming waves, Shape ``[P, 3]``."""
    out: Float64Array
    """Unit vectors along outgoing waves, Shape ``[P, 3]``."""
    before: Float64Array
    """Length before the edge [m], Shape ``[P]``; ``behind`` is that after it."""
    behind: Float64Array
    faces: Wedges
    """First the face that waves meet more steeply."""
    swapped: BoolArray
    """Whether that is the second one of the faces as given, Shape ``[P]``."""

    @classmethod
    def of(cls, corners: Float64Array, types: UInt8Array, faces: Wedges) -> Bends:
        """Bends of paths; the arguments are those of `edge_fields`."""
        steps = np.diff(corners, axis=1)
        lengths = np.sqrt((steps**2).sum(-1))
        bent = types == Interaction.DIFFRACTION
        at, rows = np.argmax(bent, axis=1), np.arange(len(types))
        behind = np.cumsum(bent, axis=1) > 0
        legs = lengths[:, 0] + (lengths[:, 1:] * ~behind).sum(1), (lengths[:, 1:] * behind).sum(1)
        k, out = unit(steps[rows, at]), unit(steps[rows, at + 1])
        met = -(faces.normals * k[:, None]).sum(-1)
        # By more than rounding: else a symmetric wedge would be counted from one face or the other by chance.
        swap = met[:, 1] > met[:, 0] + IN_PLANE
        return cls(at, k, out, *legs, faces.turned(swap), swap)

    @property
    def angles(self) -> tuple[Float64Array, Float64Array]:
        """Angles of the incoming and of the outgoing ray from the first face [rad], Shape ``[P]`` each."""
        exterior = self.faces.exterior
        return _angle(-self.k, self.faces, exterior), _angle(self.out, self.faces, exterior)

    @property
    def margins(self) -> Float64Array:
        """Angles [rad] by which the outgoing ray is within the wave that passes the edge, and within those
        that the faces reflect, first and second as they were given; negative where these have ended; ``[P,
        3]``."""
        angle_in, angle_out = self.angles
        # The reflections of both faces end at φ + φ' = π and at φ + φ' = 2nπ − π.
        both = angle_in + angle_out
        first, second = np.pi - both, both - (2 * self.faces.exterior - np.pi)
        first, second = np.where(self.swapped, (second, first), (first, second))
        return np.stack([np.pi - np.abs(angle_out - angle_in), first, second], axis=-1)

    @property
    def spread(self) -> Float64Array:
        """The length L = s'·s/(s' + s) [m] of the coefficients, Shape ``[P]``."""
        spread: Float64Array = self.before * self.behind / (self.before + self.behind)
        return spread


def edge_fields(
    corners: Float64Array,
    types: UInt8Array,
    normals: Float64Array,
    faces: Wedges,
    media: Media,
    second: Media,
    wavelengths: Sequence[float],
    lit: Int64Array | None = None,
) -> Complex128Array:
    """Fields of paths that are diffracted once.

    Args:
        corners: TX, interaction points, and RX in all places past the last one [m], ``[P, D + 2, 3]``.
        types: `Interaction` at each point, Shape ``[P, D]``: reflections, transmissions, one diffraction.
        normals: Of the triangle at each point, of any length, Shape ``[P, D, 3]``.
        faces: Of the wedges.
        media: Materials at each point; at the edge, that of the first face.
        second: Materials of the second face, Shape ``[C, P, 1]`` or ``[P, 1]``.
        wavelengths: Of the carriers [m].
        lit: Whether the waves of `Bends.margins` exist: 1, −1 if not, 0 where angles decide; ``[P, 3]``.
            None: angles decide everywhere.

    Returns:
        Dyads of `PathTable`, Shape ``[C, P, 3, 3]``; not finite where the geometry leaves none.
    """
    steps = np.diff(corners, axis=1)
    bends = Bends.of(corners, types, faces)
    lit = np.zeros((len(types), 3), np.int64) if lit is None else lit
    s_in, s_out = bends.before, bends.behind
    fields = []
    for carrier, wavelength in enumerate(wavelengths):
        k = unit(steps[:, 0])
        field = np.eye(3) - k[:, :, None] * k[:, None] + 0j
        other = Wall.of(second, carrier, 0, wavelength)
        for d in range(types.shape[1]):
            # After the last interaction nothing changes any more.
            going = types[:, d] != 0
            out = np.where(going[:, None], unit(steps[:, d + 1]), k)
            wall = Wall.of(media, carrier, d, wavelength)
            flat = wall.dyad(k, unit(normals[:, d]), types[:, d] == Interaction.TRANSMISSION)
            rows = np.flatnonzero(bends.at == d)
            if len(rows):
                walls = wall.take(rows), other.take(rows)
                flat[rows] = _diffracted(bends.take(rows), walls, lit[rows])
            field = np.where(going[:, None, None], flat @ field, field)
            k = out
        # Of a spherical wave at an edge: 1/s' before it, sqrt(s' / (s·(s' + s))) after it.
        spreading = 1 / np.sqrt(s_in * s_out * (s_in + s_out))
        fields.append(field * (wavelength / (4 * np.pi) * spreading)[:, None, None])
    return np.stack(fields)


def _diffracted(bends: Bends, walls: tuple[Wall, Wall], lit: Int64Array) -> Complex128Array:
    """Dyads of diffraction, without spreading; ``walls`` and ``lit`` are those of the faces as given."""
    k, out, edge = bends.k, bends.out, bends.faces.edge
    exterior, (angle_in, angle_out) = bends.faces.exterior, bends.angles
    # ``lit`` and ``walls`` are in the order of the faces as given, angles count from the one met more
    # steeply.
    swap = bends.swapped
    lit = np.where(swap[:, None], lit[:, [0, 2, 1]], lit)
    walls = walls[1].where(swap, walls[0]), walls[0].where(swap, walls[1])
    legs = bends.spread * _sine(k, edge) ** 2
    wavelength = walls[0].wavelength
    d14, d23 = _coefficients(angle_in, angle_out, exterior, _sine(k, edge), legs, wavelength, lit)
    s_in, s_out = unit(np.cross(k, edge)), -unit(np.cross(out, edge))
    # Edge-fixed bases (Kouyoumjian and Pathak, 1974): one vector in the plane of ray and edge, one across it.
    incoming = np.stack([s_in, np.cross(k, s_in)], axis=1)
    outgoing = np.stack([s_out, np.cross(out, s_out)], axis=1)
    no = np.zeros(len(k), np.bool_)
    parts = []
    for normal, wall in zip(np.moveaxis(bends.faces.normals, 1, 0), walls, strict=True):
        sent_back = k - 2 * (k * normal).sum(-1, keepdims=True) * normal
        s_back = -unit(np.cross(sent_back, edge))
        back = np.stack([s_back, np.cross(sent_back, s_back)], axis=1)
        parts.append(_SIGN * back @ wall.dyad(k, normal, no) @ incoming.transpose(0, 2, 1))
    shadowed = exterior >= np.pi + angle_in - IN_PLANE
    r_n = np.where(shadowed[:, None, None], -np.eye(2), parts[1])
    jones = parts[0] * d14[:, None, None] + r_n * d23[:, None, None]
    dyad: Complex128Array = outgoing.transpose(0, 2, 1) @ jones @ incoming
    return dyad


def _angle(direction: Float64Array, faces: Wedges, exterior: Float64Array) -> Float64Array:
    """Angles about the edge from the first face [rad], within the exterior: a direction that rounding puts
    inside of the wedge is at the nearer face."""
    normal = faces.normals[:, 0]
    into = np.cross(normal, faces.edge)
    angle = np.arctan2((direction * normal).sum(-1), (direction * into).sum(-1)) % (2 * np.pi)
    inside = angle > exterior
    nearer = np.where(angle - exterior < 2 * np.pi - angle, exterior, 0.0)
    angle = np.where(inside, nearer, angle)
    angle = np.where(angle < IN_PLANE, 0.0, angle)
    clamped: Float64Array = np.where(exterior - angle < IN_PLANE, exterior, angle)
    return clamped


def _coefficients(
    angle_in: Float64Array,
    angle_out: Float64Array,
    exterior: Float64Array,
    sine: Float64Array,
    length: Float64Array,
    wavelength: float,
    lit: Int64Array,
) -> tuple[Complex128Array, Complex128Array]:
    """D1 − D4 and D2 − D3; ``length`` is L [m], ``lit`` is in the order of the wedge's faces."""
    k, n = 2 * np.pi / wavelength, exterior / np.pi
    factor = -np.exp(-0.25j * np.pi) / (2 * n * np.sqrt(2 * np.pi * k) * sine)
    apart, both = angle_out - angle_in, angle_out + angle_in
    passes = lit[:, 0]
    # The wave that passes the edge ends in D1 or in D2, whichever side the outgoing ray is on.
    terms = (
        (apart, np.where(apart < 0, passes, 0)),
        (-apart, np.where(apart < 0, 0, passes)),
        (both, lit[:, 2]),
        (-both, lit[:, 1]),
    )
    d1, d2, d3, d4 = (factor * _cot_f(beta, exterior, k * length, wave) for beta, wave in terms)
    return d1 - d4, d2 - d3


def _cot_f(beta: Float64Array, exterior: Float64Array, kl: Float64Array, lit: Int64Array) -> Complex128Array:
    """cot(ψ)·F(kL·a) with ψ = (π + β)/2n and a = 2·cos²(nπN − β/2), N the nearest integer to (π + β)/2nπ.

    ψ is off a multiple of π by a 2n-th of the angle to the shadow boundary, which is positive where the
    boundary's wave is there; where ``lit`` is ±1 that says it instead. At the boundary cot is infinite and
    F is 0: with F(x) = 2·sqrt(πx)·exp(jπ/4)·K(sqrt(x)), K the modified Fresnel integral, what remains is
    sqrt(a)·cot(ψ), which is ±sqrt(2)·n there.
    """
    from scipy.special import modfresnelm  # type: ignore[import-untyped]

    n = exterior / np.pi
    off = np.pi + beta - 2 * exterior * np.round((np.pi + beta) / (2 * exterior))
    on = np.abs(off) < IN_PLANE
    side = np.where(lit != 0, lit, np.where(on | (off > 0), 1, -1))
    root = np.sqrt(2.0) * np.abs(np.sin(off / 2))
    tangent = np.abs(np.tan(off / (2 * n)))
    ratio = side * np.where(on, np.sqrt(2.0) * n, root / np.where(on, 1.0, tangent))
    _, k_minus = modfresnelm(np.sqrt(kl) * root)
    product: Complex128Array = 2 * np.sqrt(np.pi * kl) * np.exp(0.25j * np.pi) * ratio * k_minus
    return product


def _sine(one: Float64Array, other: Float64Array) -> Float64Array:
    sine: Float64Array = np.sqrt((np.cross(one, other) ** 2).sum(-1))
    return sine


def _across(vectors: Float64Array, axis: Float64Array) -> Float64Array:
    """Components of vectors across unit vectors."""
    across: Float64Array = vectors - (vectors * axis).sum(-1, keepdims=True) * axis
    return across


# [m]; farther from an edge, a wave is there or not as the ray tracer says.
_UNSURE = 2e-3

# Sine of the angle to a face below which no reflection is traced that could end.
_GRAZING = 1e-3


@dataclass(frozen=True, eq=False)
class Chains:
    """Interactions and planes of P paths."""

    pair: Int64Array
    """Shape ``[P]``."""
    types: UInt8Array
    """`Interaction` of each point, Shape ``[P, D]``."""
    planes: Int64Array
    """Plane at each point, Shape ``[P, D]``; undefined at an edge."""

    def key(self, path: int) -> tuple[tuple[int, int], ...]:
        """Type and plane of each interaction of a path."""
        met = zip(self.types[path].tolist(), self.planes[path].tolist(), strict=True)
        return tuple((kind, plane) for kind, plane in met if kind)


@dataclass(frozen=True)
class Sight:
    """A line of sight that passes edges closely."""

    lit: bool
    """Whether it passes on the lit side of each edge."""
    passed: frozenset[int]
    """Planes of the edges' faces."""


def waves_beside(
    bends: Bends, faces: Int64Array, bent: Int64Array, chains: Chains
) -> tuple[Int64Array, dict[int, Sight]]:
    """Test whether the waves exist that end near diffracted paths.

    Args:
        bends: Of B diffracted paths.
        faces: Planes of both faces of the edge of each, Shape ``[B, 2]``.
        bent: Index of each among all paths, Shape ``[B]``.
        chains: Of all paths; a path of pair −1 is left out.

    Returns:
        ``lit`` of `edge_fields`, Shape ``[B, 3]``, and the lines of sight that pass edges closely, by pair.
    """
    margins = bends.margins
    lit = np.zeros(margins.shape, np.int64)
    sights: dict[int, Sight] = {}
    # An angle times the spreading length is how far the path passes from the boundary.
    near = np.abs(margins) * bends.spread[:, None] < _UNSURE
    # No reflection that could end is traced at a face that rays meet at too small an angle.
    steep = np.abs((bends.faces.normals * bends.k[:, None]).sum(-1)) > _GRAZING
    near[:, 1:] &= np.where(bends.swapped[:, None], steep[:, ::-1], steep)
    rows, waves = np.nonzero(near)
    if not len(rows):
        return lit, sights
    same = np.flatnonzero(np.isin(chains.pair, chains.pair[bent[rows]]))
    # The wave exists if the same pair has a path of the same chain without the edge.
    there = {(int(chains.pair[path]), chains.key(path)) for path in same.tolist()}
    for row, wave in zip(rows.tolist(), waves.tolist(), strict=True):
        path = int(bent[row])
        pair = int(chains.pair[path])
        key = _without_edge(chains.key(path), None if wave == 0 else int(faces[row, wave - 1]))
        if key:
            lit[row, wave] = 1 if (pair, key) in there else -1
        elif pair >= 0:
            before = sights.get(pair, Sight(True, frozenset()))
            passes = before.lit and bool(margins[row, 0] > -IN_PLANE)
            sights[pair] = Sight(passes, before.passed | set(faces[row].tolist()))
    return lit, sights


def _without_edge(key: Sequence[tuple[int, int]], face: int | None) -> tuple[tuple[int, int], ...]:
    """The chain with a reflection at a face in place of the diffraction, or, for None, without it."""
    instead = [] if face is None else [(int(Interaction.REFLECTION), face)]
    bent = next(d for d, (kind, _) in enumerate(key) if kind == Interaction.DIFFRACTION)
    return (*key[:bent], *instead, *key[bent + 1 :])


def beyond_edges(points: Float64Array, ends: Float64Array) -> BoolArray:
    """Points on the lines of edges that are beyond the edges' ends.

    The first end belongs to an edge and the last one does not, so that of two edges in one line one has the
    point between them.

    Args:
        points: Points [m], Shape ``[B, 3]``.
        ends: Both ends of the edges [m], Shape ``[B, 2, 3]``.

    Example:
        >>> edge = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 2.0]])
        >>> beyond_edges(np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 2.0]]), np.array([edge, edge])).tolist()
        [False, True]
    """
    line = ends[:, 1] - ends[:, 0]
    along = ((points - ends[:, 0]) * line).sum(1)
    beyond: BoolArray = (along < 0) | (along >= (line**2).sum(1))
    return beyond
