"""Sionna RT's path solver, stage by stage, as a function from arrays to arrays.

`sionna.rt.PathSolver` ends in a `Paths` object, whose tensors are padded to the largest number of paths
of a pair. That number stands as a constant in the kernels, so each new one compiles anew and memory
grows as objects move. The stages before it do not have this defect; they are called here directly,
with positions as arrays instead of one device object each, and their flat buffer is read.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from caviar_protocol.arrays import (
    BoolArray,
    Complex128Array,
    Float64Array,
    Int64Array,
    UInt8Array,
)
from caviar_protocol.topics import Interaction
from caviar_services.channel.patterns import spherical_basis
from caviar_services.channel.sionna_candidates import candidate_generator
from caviar_services.columns import aligned_columns

_POLE = 1.2e-5
"""Below this horizontal part of a direction Sionna RT sets its azimuth to 0 (100 float32 epsilons)."""

_TYPES = np.zeros(17, np.uint8)
_TYPES[[1, 2, 4, 8]] = (
    Interaction.REFLECTION,
    Interaction.SCATTERING,
    Interaction.TRANSMISSION,
    Interaction.DIFFRACTION,
)
"""Interaction of each flag of `sionna.rt.constants.InteractionType`."""


@dataclass(frozen=True, kw_only=True)
class LaunchOptions:
    """What is traced, and with how many rays."""

    max_depth: int
    samples: int
    max_paths: int
    seed: int
    reflection: bool
    refraction: bool
    diffraction: bool
    scattering: bool


@dataclass(frozen=True, eq=False)
class Wedges:
    """The wedge at which each of P paths is diffracted; anything for paths that are not."""

    ends: Float64Array
    """Both ends [m] of the edge, Shape ``[P, 2, 3]``."""
    outward: Float64Array
    """Unit vector between the normals of both faces, Shape ``[P, 3]``; 0 for the edge of a single face."""


@dataclass(frozen=True, eq=False)
class Traced:
    """P paths from one transmitter, of at most D interactions."""

    receiver: Int64Array
    """Index of the receiver, Shape ``[P]``."""
    transfer: Complex128Array
    """Dyad from the field sent to the field received, world axes, without carrier phase; Shape
    ``[C, P, 3, 3]`` with C carriers."""
    types: UInt8Array
    """`Interaction` of each point, Shape ``[P, D]``."""
    shapes: Int64Array
    """Process-local id of the shape at each point, Shape ``[P, D]``."""
    primitives: Int64Array
    """Triangle of that shape, Shape ``[P, D]``."""
    points: Float64Array
    """Interaction points [m], Shape ``[P, D, 3]``."""
    wedge: Wedges | None
    """Where paths are diffracted; None where diffraction is not modelled."""
    limit_reached: bool
    """Whether more candidates were found than ``max_paths``; the surplus is lost."""

    def take(self, which: BoolArray) -> Traced:
        """These paths."""
        return Traced(
            receiver=self.receiver[which],
            transfer=self.transfer[:, which],
            types=self.types[which],
            shapes=self.shapes[which],
            primitives=self.primitives[which],
            points=self.points[which],
            wedge=self.wedge and Wedges(self.wedge.ends[which], self.wedge.outward[which]),
            limit_reached=self.limit_reached,
        )


class Tracer:
    """The stages of the solver, bound to a scene and a set of options.

    Everything that a kernel depends on is fixed here: options, wavelengths, number of receivers. So the
    first call compiles and the others do not.

    Where paths run does not depend on the carrier: they are found once, and only their fields are computed
    for each one. Rays that could be reflected, refracted or scattered choose by the materials at the
    first carrier.

    Parameters
    ----------
    mi_scene
        The scene, tuned to the first carrier.
    wavelengths
        Of the carriers [m].
    tune
        Called with the index of a carrier: sets the scene's frequency and materials.
    options
        What is traced.
    """

    def __init__(
        self,
        mi_scene: Any,
        wavelengths: Sequence[float],
        tune: Callable[[int], None],
        options: LaunchOptions,
    ) -> None:
        import drjit as dr
        import mitsuba as mi
        from sionna.rt.antenna_pattern import antenna_pattern_registry
        from sionna.rt.path_solvers.field_calculator import FieldCalculator
        from sionna.rt.path_solvers.image_method import ImageMethod

        self.mi_scene = mi_scene
        self._options = options
        self._wavelengths = [dr.opaque(mi.Float, wavelength) for wavelength in wavelengths]
        self._tune = tune
        # The two orthogonal isotropic fields at both ends give the whole polarisation transfer, to
        # which any element pattern in any orientation is applied afterwards.
        self._patterns = antenna_pattern_registry.get("iso")(polarization="VH").patterns
        self._candidates = candidate_generator()
        self._images = ImageMethod()
        self._fields = FieldCalculator()

    def trace(self, transmitter: Float64Array, receivers: Float64Array) -> Traced:
        """Paths from one transmitter [3] to all receivers [R, 3], positions in metres."""
        import drjit as dr

        options = self._options
        source, targets = _points(transmitter[None]), _points(receivers)
        buffer = self._candidates(
            mi_scene=self.mi_scene,
            src_positions=source,
            tgt_positions=targets,
            samples_per_src=options.samples,
            max_num_paths_per_src=options.max_paths,
            max_depth=options.max_depth,
            los=True,
            specular_reflection=options.reflection,
            diffuse_reflection=options.scattering,
            refraction=options.refraction,
            diffraction=options.diffraction,
            edge_diffraction=False,
            seed=options.seed,
        )
        buffer.schedule()
        dr.eval()
        buffer.shrink()
        limit_reached = buffer.buffer_size >= options.max_paths
        if buffer.buffer_size:
            buffer = self._images(
                scene=self.mi_scene,
                paths=buffer,
                src_positions=source,
                tgt_positions=targets,
                diffraction=options.diffraction,
                diffraction_lit_region=True,
            )
            self._compute_fields(buffer, source, targets)
            buffer.discard_invalid()
        return _read(buffer, len(self._wavelengths), options.max_depth, transmitter, receivers, limit_reached)

    def _compute_fields(self, buffer: Any, source: Any, targets: Any) -> None:
        """Give the buffer the amplitudes of all carriers, in their order; valid is what any of them has."""
        import drjit as dr
        import mitsuba as mi

        upright = _points(np.zeros((1, 3))), _points(np.zeros((dr.width(targets), 3)))
        geometric, carried = dr.copy(buffer.valid), mi.Bool(False)
        amplitudes: list[Any] = []
        for carrier, wavelength in enumerate(self._wavelengths):
            if carrier:
                self._tune(carrier)
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
            self._tune(0)
            buffer.valid, buffer.a = carried, amplitudes


def _points(positions: Float64Array) -> Any:
    import mitsuba as mi

    return mi.Point3f(*map(mi.Float, aligned_columns(positions.T)))


def _read(
    buffer: Any,
    carriers: int,
    max_depth: int,
    transmitter: Float64Array,
    receivers: Float64Array,
    limit_reached: bool,
) -> Traced:
    import drjit as dr

    paths = int(buffer.buffer_size)
    if paths == 0:
        return Traced(
            receiver=np.zeros(0, np.int64),
            transfer=np.zeros((carriers, 0, 3, 3), np.complex128),
            types=np.zeros((0, max_depth), np.uint8),
            shapes=np.zeros((0, max_depth), np.int64),
            primitives=np.zeros((0, max_depth), np.int64),
            points=np.zeros((0, max_depth, 3)),
            wedge=None,
            limit_reached=limit_reached,
        )
    vertices = (buffer.vertices_x, buffer.vertices_y, buffer.vertices_z)
    dr.eval(buffer.a, vertices, buffer.interaction_types, buffer.shapes, buffer.primitives)
    receiver = buffer.target_indices.numpy().astype(np.int64)
    types = _TYPES[buffer.interaction_types.numpy()[:, :max_depth]]
    points = np.stack([v.numpy()[:, :max_depth] for v in vertices], axis=-1).astype(np.float64)
    jones = np.empty((carriers, paths, 2, 2), np.complex128)
    for carrier, taken, sent in np.ndindex(carriers, 2, 2):
        amplitude = buffer.a[2 * carrier + taken][sent]
        jones[carrier, :, taken, sent] = dr.real(amplitude).numpy()
        jones[carrier, :, taken, sent] += 1j * dr.imag(amplitude).numpy()
    return Traced(
        receiver=receiver,
        transfer=_dyad(jones, transmitter, receivers[receiver], points, types),
        types=types,
        shapes=buffer.shapes.numpy()[:, :max_depth].astype(np.int64),
        primitives=buffer.primitives.numpy()[:, :max_depth].astype(np.int64),
        points=points,
        wedge=None if buffer.diffracting_wedges is None else _wedges(buffer.diffracting_wedges),
        limit_reached=limit_reached,
    )


def _wedges(wedges: Any) -> Wedges:
    import drjit as dr

    dr.eval(wedges)
    o, e, n0, nn = (v.numpy().T.astype(np.float64) for v in (wedges.o, wedges.e_hat, wedges.n0, wedges.nn))
    single = wedges.prim0.numpy() == wedges.primn.numpy()
    far = o + e * wedges.length.numpy()[:, None]
    return Wedges(np.stack([o, far], axis=1), np.where(single[:, None], 0.0, _unit(n0 + nn)))


def _dyad(
    jones: Complex128Array,
    transmitter: Float64Array,
    receivers: Float64Array,
    points: Float64Array,
    types: UInt8Array,
) -> Complex128Array:
    """World-axes dyads, Shape ``[C, P, 3, 3]``, of Jones matrices between spherical bases.

    The bases are those of the directions that the solver saw, which are of float32 positions.
    """
    count = (types != 0).sum(1)
    rows = np.arange(len(count))
    start = np.broadcast_to(transmitter.astype(np.float32).astype(np.float64), receivers.shape)
    end = receivers.astype(np.float32).astype(np.float64)
    padded = np.concatenate([points, end[:, None]], axis=1) if points.shape[1] else end[:, None]
    direct = count == 0
    first = np.where(direct[:, None], end, padded[:, 0])
    last = np.where(direct[:, None], start, padded[rows, np.maximum(count - 1, 0)])
    sent = np.stack(spherical_basis(_unit(first - start), _POLE), axis=-2)
    taken = np.stack(spherical_basis(_unit(last - end), _POLE), axis=-2)
    return np.stack([np.einsum("pix,pij,pjy->pxy", taken, of_carrier, sent) for of_carrier in jones])


def _unit(vectors: Float64Array) -> Float64Array:
    length = np.sqrt((vectors**2).sum(-1, keepdims=True))
    unit: Float64Array = vectors / np.where(length > 0, length, 1.0)
    return unit
