"""Sionna RT's path solver, stage by stage, as a function from arrays to arrays.

`sionna.rt.PathSolver` ends in a `Paths` object, whose tensors are padded to the largest number of paths
of a pair. That number stands as a constant in the kernels, so each new one compiles anew and memory
grows as objects move. The stages before it do not have this defect; they are called here directly,
with positions as arrays instead of one device object each, and their flat buffer is read.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array
from caviar_protocol.topics import Interaction
from caviar_services.channel.arrays.element_paths import Look
from caviar_services.channel.propagation.image_method import image_points, refined_points
from caviar_services.channel.sionna import dr, mi
from caviar_services.channel.sionna.candidates import (
    MANY_RAYS,
    Candidates,
    Corners,
    Faces,
    Met,
    Offer,
    Planes,
    at_corners,
    met_by,
    reflected,
    united,
)
from caviar_services.channel.sionna.diffracting_edges import edge_generator
from caviar_services.channel.sionna.path_table import Traced, edge_numbers, geometry, joined, nothing, read
from caviar_services.channel.sionna.ray_launcher import (
    SCATTERED,
    ChosenPoints,
    Element,
    Launch,
    LaunchOptions,
    PartedLauncher,
    Thinning,
)
from caviar_services.channel.sionna.scene import SionnaScene
from caviar_services.channel.sionna.tracking import Followed, FollowedOffer, TableState
from caviar_services.drjit_setup import aligned_columns, aligned_indices, positions, several

# Transmitters whose last launch is kept, in case nothing moves.
_REMEMBERED = 4

# Candidates to be looked at together at most.
_LANES = 8_000_000

LANE_BYTES = 40
"""[B] of memory for one candidate, or for one interaction of one ray."""


@dataclass(frozen=True, eq=False)
class _Last:
    """Last trace from a position."""

    version: int
    """Of the scene."""
    offer: Offer
    receivers: Float64Array
    """[m], Shape ``[R, 3]``."""
    traced: Traced


class Tracer:
    """The stages of the solver, bound to a scene and a set of options.

    Everything that a kernel depends on is fixed here: options and wavelengths. So the first call compiles
    and the others do not.

    Where paths run does not depend on the carrier: they are found once, and only their fields are computed
    for each one. Rays that could be reflected, refracted or scattered choose by the materials at the
    first carrier.

    Args:
        scene: The scene, tuned to the first carrier. Its ray tracer counts relative to ``scene.centre``.
        wavelengths: Of the carriers [m].
        options: What is traced.
    """

    def __init__(self, scene: SionnaScene, wavelengths: Sequence[float], options: LaunchOptions) -> None:
        from sionna.rt.antenna_pattern import antenna_pattern_registry
        from sionna.rt.path_solvers.field_calculator import FieldCalculator
        from sionna.rt.path_solvers.image_method import ImageMethod

        self._scene = scene
        self._options = options
        self._wavelengths = [dr.opaque(mi.Float, wavelength) for wavelength in wavelengths]
        # The two orthogonal isotropic fields at both ends give the whole polarisation transfer, to
        # which any element pattern in any orientation is applied afterwards.
        self._patterns = antenna_pattern_registry.get("iso")(polarization="VH").patterns
        self._faces = Faces(scene)
        generator = edge_generator(scene.edges) if scene.edges and options.diffraction else None
        self._launcher = PartedLauncher(scene, options, generator)
        self._thinning: Thinning | None = None
        if options.diffuse_paths is not None:
            self._thinning = Thinning(scene.mi_scene, options.diffuse_paths, options.seed)
        self._images = ImageMethod()
        self._fields = FieldCalculator()
        self._last: dict[bytes, _Last] = {}

    def forget(self) -> None:
        """Trace anew, also where nothing has moved."""
        self._last.clear()

    def offers(self) -> tuple[tuple[bytes, TableState], ...]:
        """Offers of followed transmitters, which hold as long as nothing moves, and their positions."""
        return tuple(
            (position, last.offer.state)
            for position, last in self._last.items()
            if last.version == self._scene.version and isinstance(last.offer, FollowedOffer)
        )

    def offer_again(self, offers: Sequence[tuple[bytes, TableState]]) -> None:
        """Continue with what was on offer, the scene being as it was then.

        Args:
            offers: Of `offers`.
        """
        for position, state in offers:
            offer = FollowedOffer.again(state, np.frombuffer(position), self._scene, self._options)
            self._last[position] = _Last(self._scene.version, offer, np.zeros((0, 3)), self.nothing)

    def missed_by_half(self, transmitter: Float64Array, traced: Traced) -> Float64Array:
        """Probability that half of the rays would not have found a path, Shape ``[P]``.

        A path whose chain n rays went along is missing from one half, over all ways to halve the launch, with
        probability 2⁻ⁿ. So the power of paths times this is the expected error of half of the rays against
        all of them: what a launch in two halves would show, without a second one. Straight and diffuse paths
        have 0.

        Args:
            transmitter: Where the last `trace` was from [m], Shape ``[3]``.
            traced: What it returned, or some of it.
        """
        last = self._last.get((transmitter - self._scene.centre).tobytes())
        depth = (traced.types != 0).sum(1)
        if last is None or last.version != self._scene.version:
            return np.zeros(len(depth))
        triangles = self._scene.triangle_numbers(traced.shapes, traced.primitives)
        reflected = traced.types == Interaction.REFLECTION
        planes = np.where(reflected, self._scene.surface_of[triangles], -1)
        rays = last.offer.rays_of(planes, depth)
        rays[(depth == 0) | (traced.types == Interaction.SCATTERING).any(1)] = MANY_RAYS
        missed: Float64Array = np.ldexp(1.0, -rays)
        return missed

    @property
    def look(self) -> Look:
        """Questions that the scene as it is answers, in world coordinates."""
        table, centre = self._scene.plane_table, self._scene.centre
        return Look(
            nearest=lambda start, end: self._faces.nearest(start - centre, end - centre),
            reflected=lambda chains, start, end: reflected(
                self._faces, Planes(table), chains, start - centre, end - centre
            ),
        )

    @property
    def nothing(self) -> Traced:
        """No paths."""
        return nothing(len(self._wavelengths), self._options.max_depth, 0)

    def trace(
        self,
        transmitter: Float64Array,
        receivers: Float64Array,
        at_once: int | None = None,
        followed: Followed | None = None,
        names: tuple[str, ...] = (),
        lanes: int = _LANES,
        corners: Corners | None = None,
        element: Element | None = None,
    ) -> Traced:
        """Find the paths from one transmitter to all receivers.

        Args:
            transmitter: In the world [m], Shape ``[3]``.
            receivers: In the world [m], Shape ``[R, 3]``.
            at_once: Receivers that are looked at together; None: as many as fit ``lanes``. The paths are the
                same.
            followed: What the transmitter's last launches met: a part of the rays is launched. None: all are.
            names: What `SionnaScene.place` returned; for ``followed``.
            lanes: Candidates that are looked at together at most.
            corners: Asks also for paths that only a part of the arrays has; nothing is then taken from an
                earlier trace. None: the centres alone count.
            element: The transmitter's, by whose gain diffuse paths are chosen; None: by no gain.
        """
        if not len(receivers):
            return self.nothing
        centre = self._scene.centre
        transmitter, receivers = transmitter - centre, receivers - centre
        corners = corners and corners.relative_to(centre)
        key = transmitter.tobytes() + (element.key if element else b"")
        # Launches into the scene as it was match no frame any more.
        version = self._scene.version
        self._last = {key: last for key, last in self._last.items() if last.version == version}
        # What is found for the corners of arrays is of these arrays alone, and not kept.
        last = None if corners else self._last.get(key)
        if last is None:
            if followed is None:
                offer = self._launched(transmitter, element)
            else:
                offer = followed.offer(self._launcher, transmitter, self._scene, names, self._options)
            offer.everywhere = corners is not None
            traced = self._offered(offer, transmitter, receivers, at_once, lanes, corners)
        else:
            offer = last.offer
            traced = self._since(last, transmitter, receivers, at_once)
        if corners:
            return traced
        self._last[key] = _Last(self._scene.version, offer, receivers, traced)
        while len(self._last) > _REMEMBERED:
            # Dictionaries keep their order: the oldest goes.
            del self._last[next(iter(self._last))]
        return traced

    def _launched(self, transmitter: Float64Array, element: Element | None) -> Offer:
        """Offer of a launch of all rays."""
        source = positions(transmitter[None])

        def look(_: Int64Array, launch: Launch) -> Met:
            scattered = None
            if self._thinning is not None:
                scattered = self._thinning.points(launch, transmitter, element)
            return met_by(
                launch, self._scene, self._options.max_depth, scattered, part=self._launcher.in_parts
            )

        met = united(self._launcher.each(look, source), self._scene)
        points = None if self._thinning is None else ChosenPoints(self._thinning, met.scattered)
        return Offer(self._scene, met, source, self._options, points)

    def _since(
        self, last: _Last, transmitter: Float64Array, receivers: Float64Array, at_once: int | None
    ) -> Traced:
        """Paths where nothing but receivers has moved: those of the others are what they were."""
        known = {position.tobytes(): index for index, position in enumerate(last.receivers)}
        before = np.array([known.get(position.tobytes(), -1) for position in receivers], np.int64)
        new = np.flatnonzero(before < 0)
        parts = [self._offered(last.offer, transmitter, receivers[new], at_once)] if len(new) else []
        parts = [replace(part, receiver=new[part.receiver]) for part in parts]
        for receiver in np.flatnonzero(before >= 0).tolist():
            same = last.traced.take(last.traced.receiver == before[receiver])
            parts.append(replace(same, receiver=np.full(len(same.receiver), receiver), lost=0))
        return joined(parts, len(self._wavelengths), self._options.max_depth)

    def _offered(
        self,
        offer: Offer,
        transmitter: Float64Array,
        receivers: Float64Array,
        at_once: int | None,
        lanes: int = _LANES,
        corners: Corners | None = None,
    ) -> Traced:
        if at_once is None:
            # A lane for each candidate of each receiver.
            at_once = max(1, lanes // max(offer.size, 1))
        parts = [
            self._batch(
                offer,
                transmitter,
                begin,
                receivers[begin : begin + at_once],
                corners and corners.take(slice(begin, begin + at_once)),
            )
            for begin in range(0, len(receivers), at_once)
        ]
        found = joined(parts, len(self._wavelengths), self._options.max_depth)
        centre = self._scene.centre
        return replace(found, points=found.points + centre)

    def _batch(
        self,
        offer: Offer,
        transmitter: Float64Array,
        begin: int,
        receivers: Float64Array,
        corners: Corners | None,
    ) -> Traced:
        source, targets = positions(transmitter[None]), positions(receivers[several(len(receivers))])
        candidates, launch, lost = offer.candidates(targets, len(receivers))
        if not len(candidates.ray):
            return nothing(len(self._wavelengths), self._options.max_depth, lost)
        buffer = self._buffer(launch, candidates.take(several(len(candidates.ray))))
        if self._options.max_depth:  # from 0 its unsigned loops count on below: 2^32 turns
            buffer = self._images(
                scene=self._scene.mi_scene,
                paths=buffer,
                src_positions=source,
                tgt_positions=targets,
                diffraction=self._options.diffraction,
                diffraction_lit_region=True,
            )
        at_centres = buffer.valid.numpy()[: len(candidates.ray)]
        chains, depth, receiver = candidates.planes, candidates.depth, candidates.receiver
        hidden, settled = at_corners(self._faces, offer.planes, chains, depth, receiver, at_centres, corners)
        valid = np.flatnonzero(at_centres | hidden)
        if not len(valid):
            return nothing(len(self._wavelengths), self._options.max_depth, lost)
        kept = valid[several(len(valid))]
        buffer = buffer.gather(mi.UInt(aligned_indices(kept)))
        self._settle(buffer, candidates.take(kept), hidden[kept], transmitter, receivers)
        self._compute_fields(buffer, source, targets)
        traced = read(buffer, len(self._wavelengths), transmitter, receivers, lost)
        traced = self._named_by_edge(replace(traced, hidden=hidden[kept], settled=settled[kept]))
        found = buffer.valid.numpy() & (np.arange(len(kept)) < len(valid))
        return traced.take(found).seen_from(begin)

    def _buffer(self, launch: Launch, candidates: Candidates) -> Any:
        """The solver's buffer with these candidates."""
        from sionna.rt.path_solvers.paths_buffer import PathsBuffer
        from sionna.rt.utils import WedgeGeometry

        count, depth = len(candidates.ray), max(self._options.max_depth, 1)
        # Sionna RT's stages fill the private fields of the buffer; so does this one.
        buffer = PathsBuffer(count, self._options.max_depth, self._options.diffraction)
        ray = mi.UInt(aligned_indices(candidates.ray))
        interactions = mi.UInt(aligned_indices(candidates.depth))
        buffer._tgt_indices = mi.UInt(aligned_indices(candidates.receiver))
        buffer._valid = mi.UInt(aligned_indices(candidates.found)) != 0
        place = dr.arange(mi.UInt, count) * depth
        for d, bounce in enumerate(launch.bounces):
            used = interactions > d
            for tensor, of_rays in (
                (buffer._interaction_types, bounce.kind),
                (buffer._shapes, bounce.shape),
                (buffer._primitives, bounce.primitive),
                (buffer._probs, bounce.probability),
                (buffer._vertices_x, bounce.point.x),
                (buffer._vertices_y, bounce.point.y),
                (buffer._vertices_z, bounce.point.z),
            ):
                dr.scatter(tensor.array, dr.gather(type(of_rays), of_rays, ray, used), place + d, used)
        if self._thinning is not None:
            chosen = mi.Float(aligned_columns(candidates.chosen[None])[0])
            is_chosen = chosen > 0.0
            dr.scatter(
                buffer._interaction_types.array, mi.UInt(SCATTERED), place + interactions - 1, is_chosen
            )
            dr.scatter(buffer._probs.array, chosen, place + interactions - 1, is_chosen)
        # A path has one edge at most: it is that of the whole ray.
        if self._options.diffraction and launch.wedges is not None:
            buffer._diffracting_wedges = dr.gather(WedgeGeometry, launch.wedges, ray, interactions > 0)
        buffer.schedule()
        dr.eval()
        return buffer

    def _settle(
        self,
        buffer: Any,
        candidates: Candidates,
        hidden: BoolArray,
        transmitter: Float64Array,
        receivers: Float64Array,
    ) -> None:
        """Make what the buffer holds the same whichever rays were beside: of faces that coincide, the first
        was met, and specular points are where the planes say. Mark paths that met other planes than
        those of their chain: they belong to another chain.
        """
        types, shapes, primitives, points = geometry(buffer)
        wanted = candidates.planes
        triangles = self._scene.triangle_numbers(shapes, primitives)
        own = ((wanted < 0) | (wanted == self._scene.surface_of[triangles])).all(1)
        start = np.broadcast_to(transmitter, (len(types), 3))
        end = receivers[candidates.receiver]
        if hidden.any():  # no ray of the centre's has been at their points
            origin, normal = self._scene.planes(shapes[hidden], primitives[hidden])
            surfaces = origin - self._scene.centre, normal
            points[hidden] = image_points(start[hidden], end[hidden], types[hidden], *surfaces)
            own[hidden] &= _first_of_equals(end[hidden], points[hidden])
            own[hidden] &= np.isfinite(points[hidden]).all((1, 2))
        buffer.valid = mi.UInt(aligned_indices(own)) != 0
        met = (types == Interaction.REFLECTION) | (types == Interaction.TRANSMISSION)
        met &= (own & ~candidates.found & ~hidden)[:, None]
        if not (met.any() or (hidden.any() and types.size)):
            return
        first = self._scene.plane_table.first_holding(triangles[met], points[met])
        shapes[met], primitives[met] = self._scene.shapes_of(first)
        buffer._shapes = _tensor(mi.TensorXu, mi.UInt(aligned_indices(shapes.ravel())), shapes)
        buffer._primitives = _tensor(mi.TensorXu, mi.UInt(aligned_indices(primitives.ravel())), shapes)
        centre = self._scene.centre
        ends = None
        if self._scene.edges is not None:
            ends = self._scene.edges.ends(edge_numbers(buffer, types)) - centre
        exact = refined_points(
            start, points, end, types, self._scene.triangles(shapes, primitives) - centre, ends
        )
        for axis, column in zip("xyz", aligned_columns(exact.reshape(-1, 3).T), strict=True):
            setattr(buffer, f"_vertices_{axis}", _tensor(mi.TensorXf, mi.Float(column), shapes))

    def _named_by_edge(self, traced: Traced) -> Traced:
        """The same, diffracted at the first face of an edge, whichever of both a ray has hit."""
        edges = self._scene.edges
        if edges is None:
            return traced
        shapes, primitives = traced.shapes.copy(), traced.primitives.copy()
        path, at = np.nonzero(traced.types == Interaction.DIFFRACTION)
        first = edges.triangles[traced.edge[path], 0]
        shapes[path, at], primitives[path, at] = self._scene.shapes_of(first)
        return replace(traced, shapes=shapes, primitives=primitives)

    def _compute_fields(self, buffer: Any, source: Any, targets: Any) -> None:
        """Give the buffer the amplitudes of all carriers, in their order; valid is what any of them has."""
        # Isotropic patterns at both ends: arrays and orientations are applied afterwards.
        upright = positions(np.zeros((1, 3))), positions(np.zeros((dr.width(targets), 3)))
        geometric, carried = dr.copy(buffer.valid), mi.Bool(False)
        amplitudes: list[Any] = []
        for carrier, wavelength in enumerate(self._wavelengths):
            # The scene is tuned to the first carrier as it comes, and again when this is through.
            if carrier:
                self._scene.tune(carrier)
                buffer.valid = dr.copy(geometric)
            self._fields(
                wavelength=wavelength,
                paths=buffer,
                samples_per_src=self._options.samples,
                diffraction=self._options.diffraction,
                src_positions=source,
                tgt_positions=targets,
                src_orientations=upright[0],
                tgt_orientations=upright[1],
                src_antenna_patterns=self._patterns,
                tgt_antenna_patterns=self._patterns,
            )
            amplitudes += buffer.a
            carried |= buffer.valid
        if len(self._wavelengths) > 1:
            dr.eval(amplitudes, carried)  # before the materials change again
            self._scene.tune(0)
            buffer.valid, buffer.a = carried, amplitudes


def _first_of_equals(ends: Float64Array, points: Float64Array) -> BoolArray:
    """Mask of the first of paths with the same points to 1 mm: planes of two objects may be one."""
    places = np.round(np.concatenate([ends[:, None], points], axis=1).reshape(len(ends), -1), 3)
    first = np.zeros(len(ends), np.bool_)
    first[np.unique(places, axis=0, return_index=True)[1]] = True
    return first


def _tensor(kind: Any, values: Any, like: Int64Array) -> Any:
    return kind(values, like.shape)
