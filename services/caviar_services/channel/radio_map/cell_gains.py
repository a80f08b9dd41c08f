"""Cells of a surface, and the power gain of one transmitter in each of them, for all of its beams at once.

Sionna RT's `RadioMapSolver` shoots rays from a transmitter and adds up the power of those that pass through
each cell (A. Aoudia et al., "Sionna RT: Technical Report", 2025, section 4). It knows one precoding vector
and one polarisation model, so that a codebook of 64 beams would be shot 64 times. Here the field that leaves
is that of the channel engine's own element pattern (`Antenna.radiated`), and each ray that passes
through a cell is counted once for every beam, with the beam's gain in the direction in which it left: a
single-polarised array in the far field is the element times its array factor.

A surface is a grid of cells, level or draped over the ground. The solver intersects rays with a level one by
formula; of another one a mesh with two triangles for each cell stands in the scene while rays are shot.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array
from caviar_services.channel.paths import Antenna
from caviar_services.channel.propagation.patterns import spherical_basis
from caviar_services.channel.sionna.ray_launcher import spread_directions
from caviar_services.channel.sionna.scene import SionnaScene
from caviar_services.channel.sionna.scene_loading import Shape, mi_mesh
from caviar_services.drjit_setup import aligned_columns, aligned_indices
from caviar_space.meshes import Mesh


@dataclass(frozen=True, eq=False)
class MeasurementSurface:
    """Cells that are squares from above: ``nx`` along x, ``ny`` along y."""

    x: Float64Array
    """Edges of the columns [m], ascending, Shape ``[nx + 1]``."""
    y: Float64Array
    """Edges of the rows [m], ascending, Shape ``[ny + 1]``."""
    z: Float64Array
    """Height of the cells' corners [m], Shape ``[ny + 1, nx + 1]``; NaN where there is no ground."""

    @property
    def shape(self) -> tuple[int, int]:
        """``(ny, nx)``."""
        return len(self.y) - 1, len(self.x) - 1

    @property
    def is_level(self) -> bool:
        """Whether it is a horizontal plane without a gap."""
        return bool((self.z == self.z[0, 0]).all())

    @property
    def centres(self) -> Float64Array:
        """Middle of each cell [m], Shape ``[ny, nx, 3]``; NaN heights where a corner has no ground."""
        x, y = np.meshgrid((self.x[:-1] + self.x[1:]) / 2, (self.y[:-1] + self.y[1:]) / 2)
        z = self.z
        return np.stack([x, y, (z[:-1, :-1] + z[:-1, 1:] + z[1:, :-1] + z[1:, 1:]) / 4], axis=-1)

    @property
    def covered(self) -> BoolArray:
        """Cells that have ground at all four corners, Shape ``[ny, nx]``."""
        there: BoolArray = np.isfinite(self.centres[..., 2])
        return there

    def triangles(self) -> tuple[Mesh, Int64Array]:
        """Two triangles for each covered cell, with upward normals, and the flat index of their cells,
        Shape ``[F]``."""
        _, nx = self.shape
        x, y = np.meshgrid(self.x, self.y)
        vertices = np.stack([x, y, self.z], axis=-1).reshape(-1, 3)
        cells = np.flatnonzero(self.covered)
        first = cells // nx * (nx + 1) + cells % nx
        squares = first[:, None] + [0, 1, nx + 2, 0, nx + 2, nx + 1]
        faces = squares.reshape(-1, 3).astype(np.int32)
        used, compact = np.unique(faces, return_inverse=True)
        return Mesh(vertices[used], compact.reshape(-1, 3).astype(np.int32)), np.repeat(cells, 2)


_SURFACE, _SOURCE = "caviar-measurement-surface", "caviar-map-source"

PartDone = Callable[[int, int], None]
"""``done(part, parts)``: called after each part of the rays."""


@dataclass(frozen=True, kw_only=True)
class Shooting:
    """What rays do, and how many there are."""

    samples: int
    """Rays of a transmitter; rounded up to whole parts."""
    max_depth: int
    seed: int
    los: bool = True
    reflection: bool = True
    refraction: bool = False
    diffraction: bool = False
    free_edges: bool = False
    """Whether edges at which one face ends and no other begins diffract, too."""
    scattering: bool = False


@dataclass(frozen=True, kw_only=True, eq=False)
class CellGains:
    """Mean power gains over each cell of a surface, towards one isotropic element of both polarisations."""

    element: Float64Array
    """Of one element without beamforming, Shape ``[ny, nx]``. It is also the mean over all beams of a
    unitary codebook, by Parseval's theorem."""
    beams: Float64Array
    """Of each beam, Shape ``[B, ny, nx]``."""
    rays: Int64Array
    """That passed through each cell, Shape ``[ny, nx]``."""


def cell_gains(
    scene: SionnaScene,
    surface: MeasurementSurface,
    transmitter: Antenna,
    beams: range,
    shooting: Shooting,
    part: int,
    done: PartDone,
) -> CellGains:
    """Shoot the rays of one transmitter, at the carrier that the scene is tuned to.

    Args:
        scene: Loaded, with its bodies in place.
        surface: Whose cells are counted.
        transmitter: Where it is traced from.
        beams: Numbers of beams of the transmitter's codebook, B of them; none: only the element's gain.
        shooting: What rays do, and how many there are.
        part: Rays that are shot together.
        done: Called after each part.
    """
    from sionna.rt import Transmitter

    ny, nx = surface.shape
    parts = math.ceil(shooting.samples / part)
    total, rays = np.zeros((len(beams) + 1, ny * nx)), np.zeros(ny * nx, np.int64)
    rt_scene = scene.rt_scene
    place = (transmitter.position - scene.centre).tolist()
    rt_scene.add(Transmitter(_SOURCE, position=place))
    try:
        rt_scene.tx_array = _one_element(transmitter)
        solver: Any = _solver(rt_scene, surface, scene.centre, transmitter, beams)
        for number in range(parts):
            with _launched(spread_directions(part * parts, number, parts)):
                sums, passed = solver.shoot(part, shooting, shooting.seed + number)
            total += sums
            rays += passed
            done(number + 1, parts)
    finally:
        rt_scene.remove(_SOURCE)
    # Each part is an estimate of its own, with as many rays.
    total /= parts
    grids = total.reshape(-1, ny, nx)
    return CellGains(element=grids[0], beams=grids[1:], rays=rays.reshape(ny, nx))


def beam_gains(antenna: Antenna, beams: range, directions: Any) -> Any:
    """Power gain of beams of the DFT codebook over one element, towards R directions of the world.

    ``|atᵀ f|²`` with the steering vector at: N at the most, and 1 in the mean over the whole codebook. For a
    uniform planar array it is the product of two Dirichlet kernels, one along the columns and one along the
    rows (C. A. Balanis, Antenna Theory, 3rd ed., eq. 6-10c and section 6.10.1); beams are those of
    `caviar_protocol.space.antenna_arrays.dft_codebook`.

    Args:
        directions: Unit vectors, a `mitsuba.Vector3f` of width R.

    Returns:
        Of each beam the gains in all directions, one beam after the other, width ``len(beams)·R``.
    """
    import drjit as dr
    import mitsuba as mi

    array, count = antenna.array, dr.width(directions)
    index = dr.arange(mi.UInt, len(beams) * count)
    beam = dr.opaque(mi.UInt, beams.start) + index // dr.opaque(mi.UInt, count)
    towards = dr.gather(mi.Vector3f, directions, index % dr.opaque(mi.UInt, count))
    y_axis, z_axis = (dr.opaque(mi.Vector3f, antenna.rotation[:, axis].tolist()) for axis in (1, 2))
    across = dr.opaque(mi.Float, array.horizontal_spacing) * dr.dot(towards, y_axis)
    up = dr.opaque(mi.Float, array.vertical_spacing) * dr.dot(towards, z_axis)
    rows = dr.opaque(mi.UInt, array.rows)
    column, row = mi.Float(beam // rows), mi.Float(beam % rows)
    gains = _kernel_power(across - column / mi.Float(dr.opaque(mi.UInt, array.columns)), array.columns)
    gains *= _kernel_power(up + row / mi.Float(rows), array.rows)
    dr.eval(gains)
    return gains


def _kernel_power(x: Any, size: int) -> Any:
    """``|Σ_n exp(j2πnx)|² / size`` over ``size`` elements."""
    import drjit as dr
    import mitsuba as mi

    # The kernel has period 1; near 0 both sines vanish and the quotient is the number of elements.
    turned, count = x - dr.round(x), dr.opaque(mi.Float, size)
    sine = dr.sin(dr.pi * turned)
    power = dr.square(dr.sin(count * dr.pi * turned) / sine) / count
    return dr.select(dr.abs(turned) < 1e-7, count, power)


def _one_element(antenna: Antenna) -> Any:
    """A `sionna.rt.AntennaArray` of one element, which radiates what the channel engine's does.

    The device itself stands unturned in the ray tracer: angles are those of the world.
    """
    import mitsuba as mi
    from sionna.rt import AntennaArray, AntennaPattern

    def pattern(theta: Any, phi: Any) -> tuple[Any, Any]:
        zenith, azimuth = np.array(theta, np.float64), np.array(phi, np.float64)
        sine = np.sin(zenith)
        towards = np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), np.cos(zenith)], axis=-1)
        field = antenna.radiated(towards)
        theta_hat, phi_hat = spherical_basis(towards)
        along = np.stack([(field * theta_hat).sum(-1), (field * phi_hat).sum(-1)])
        real, imaginary = aligned_columns(along.real), aligned_columns(along.imag)
        complex_of: Any = mi.Complex2f
        c_theta, c_phi = (complex_of(mi.Float(a), mi.Float(b)) for a, b in zip(real, imaginary, strict=True))
        return c_theta, c_phi

    radiated: Any = AntennaPattern()
    radiated.patterns = [pattern]
    return AntennaArray(radiated, mi.Point3f(0.0, 0.0, 0.0))


@contextmanager
def _launched(directions: Any) -> Iterator[None]:
    """While rays are shot, they leave in these directions, a `mitsuba.Vector3f`.

    Sionna RT's solver takes all points of a lattice at once, and the same ones in every call, so that parts
    would repeat each other. The function that it calls is replaced in its module and put back.
    """
    import drjit as dr
    import mitsuba as mi
    from sionna.rt.radio_map_solvers import radio_map_solver as module

    def spawn(_lattice: object, samples: int, sources: Any) -> Any:
        ray: Any = mi.Ray3f(o=dr.repeat(sources, samples), d=directions)
        ray.time = dr.zeros(mi.Float, samples)
        return ray

    before = module.spawn_ray_from_sources
    module.spawn_ray_from_sources = spawn
    try:
        yield
    finally:
        module.spawn_ray_from_sources = before


def _solver(
    rt_scene: Any, surface: MeasurementSurface, centre: Float64Array, antenna: Antenna, beams: range
) -> Any:
    """A solver for one transmitter, with the surface in the scene.

    Its ``shoot(samples, shooting, seed)`` returns sums, Shape ``[B + 1, cells]``, the element first, and how
    many rays passed through each cell.
    """
    import drjit as dr
    import mitsuba as mi
    from sionna.rt import RadioMapSolver

    cells = surface.shape[0] * surface.shape[1]
    geometry = _level(surface, centre) if surface.is_level else _draped(rt_scene, surface, centre)

    class Sums(geometry.map_class):  # type: ignore[misc,name-defined]
        """Adds up what passes through each cell, for one element and for every beam."""

        def __init__(self, samples: int) -> None:
            super().__init__(rt_scene, **geometry.map_arguments)
            # Opaque: as literals, each number of cells and beams would be another kernel to compile.
            self._samples, self._cells, self._beams = (
                dr.opaque(mi.UInt, count) for count in (samples, cells, len(beams))
            )
            self._ray = dr.arange(mi.UInt, samples)
            self.power = dr.zeros(mi.Float, (len(beams) + 1) * cells)
            self.rays = dr.zeros(mi.UInt, cells)
            self._beam_gains: Any = None

        def leave_towards(self, directions: Any) -> None:
            """Beam gains of the rays, which leave in these directions."""
            if len(beams):
                self._beam_gains = beam_gains(antenna, beams, mi.Vector3f(directions))

        def add_paths(
            self, e_fields: Any, array_w: Any, si: Any, k_world: Any, tx_indices: Any, active: Any,
            diffracted_paths: bool, solid_angle: Any = None, tx_positions: Any = None, wedges: Any = None,
            diff_point: Any = None, wedges_samples_cnt: Any = None, diffraction_angular_measure: Any = None,
        ) -> None:  # fmt: skip
            """What `RadioMap.add_paths` does, for every beam."""
            # Width of the tube of a ray on the surface: of a diffracted one along the edge, else of its solid
            # angle.
            if diffracted_paths:
                source = dr.gather(mi.Point3f, tx_positions, tx_indices, active=active)
                width = self._diffraction_integration_weight(wedges, source, diff_point, k_world, si)
                width *= wedges.length * diffraction_angular_measure / wedges_samples_cnt
            else:
                width = solid_angle * dr.rcp(dr.abs(dr.dot(si.n, k_world)))
            cell, weight = geometry.cell(self, si, active)
            width *= weight * self._normalization_factor
            # Rays of one launch add up in single precision; parts are added in double precision outside.
            power = dr.squared_norm(e_fields[0]) * width
            dr.scatter_add(self.power, power, cell, active)
            dr.scatter_add(self.rays, mi.UInt(1), cell, active)
            self._add_beams(power, cell, active)

        def _add_beams(self, power: Any, cell: Any, active: Any) -> None:
            if not len(beams):
                return

            # One lane a ray, a loop over the beams: a lane for each beam would need the ray's field as often.
            def add(beam: Any) -> tuple[Any]:
                gain = dr.gather(mi.Float, self._beam_gains, beam * self._samples + self._ray, active)
                dr.scatter_add(self.power, gain * power, (beam + 1) * self._cells + cell, active)
                return (beam + 1,)

            dr.while_loop((mi.UInt(0),), lambda beam: beam < self._beams, add, labels=("beam",))

    # Sionna RT has no way to count rays otherwise: its steps are replaced, with the library's names and
    # arguments.
    class Solver(RadioMapSolver):  # type: ignore[misc]
        """Sionna RT's solver, whose rays are counted by `Sums`."""

        def shoot(self, samples: int, shooting: Shooting, seed: int) -> tuple[Any, Any]:
            self._sums = Sums(samples)
            self(
                rt_scene,
                **geometry.solver_arguments,
                samples_per_tx=samples,
                max_depth=shooting.max_depth,
                los=shooting.los,
                specular_reflection=shooting.reflection,
                diffuse_reflection=shooting.scattering,
                refraction=shooting.refraction,
                diffraction=shooting.diffraction,
                edge_diffraction=shooting.free_edges,
                seed=seed,
            )
            return np.array(self._sums.power).reshape(-1, cells), np.array(self._sums.rays)

        def _synthetic_array_weighting(self, scene: Any, k_tx: Any, *rest: Any) -> list[Any]:
            self._sums.leave_towards(k_tx)
            return [None]

        def _shoot_and_bounce(self, scene: Any, radio_map: Any, *rest: Any) -> Any:
            return super()._shoot_and_bounce(scene, self._sums, *rest)

        def _evaluate_first_order_diffraction(self, scene: Any, radio_map: Any, *rest: Any) -> None:
            super()._evaluate_first_order_diffraction(scene, self._sums, *rest)

    return Solver()


@dataclass(frozen=True, kw_only=True)
class _Geometry:
    """How a surface is given to the ray tracer's solver."""

    map_class: Any
    """The `sionna.rt.RadioMap` of such surfaces."""
    map_arguments: dict[str, Any]
    """Of its constructor, beside the scene."""
    solver_arguments: dict[str, Any]
    """Of the solver."""
    cell: Callable[[Any, Any, Any], tuple[Any, Any]]
    """From the map, where rays meet the surface and which of them do: the cell, and what its powers are
    weighted with, beside the map's own factor."""


def _level(surface: MeasurementSurface, centre: Float64Array) -> _Geometry:
    """A rectangle, which rays are intersected with by formula."""
    import mitsuba as mi
    from sionna.rt.radio_map_solvers.planar_radio_map import PlanarRadioMap

    low, high = np.array([surface.x[0], surface.y[0]]), np.array([surface.x[-1], surface.y[-1]])
    ny, nx = surface.shape
    middle = np.append((low + high) / 2, surface.z[0, 0]) - centre
    size = high - low
    plane = {
        "center": mi.Point3f(*middle.tolist()),
        "orientation": mi.Point3f(0.0, 0.0, 0.0),
        # A little less: the number of cells is rounded up.
        "size": mi.Point2f(*(size * (1 - 1e-4 / np.array([nx, ny]))).tolist()),
        "cell_size": mi.Point2f(*(size / [nx, ny]).tolist()),
    }
    return _Geometry(
        map_class=PlanarRadioMap,
        map_arguments=plane,
        solver_arguments=plane,
        cell=lambda radio_map, si, active: (mi.UInt(radio_map._local_to_cell_ind(si.uv)), 1.0),
    )


def _draped(rt_scene: Any, surface: MeasurementSurface, centre: Float64Array) -> _Geometry:
    """A mesh in the scene, with two triangles for each cell."""
    import drjit as dr
    import mitsuba as mi
    from sionna.rt.radio_map_solvers.mesh_radio_map import MeshRadioMap
    from sionna.rt.scene_utils import extend_scene_with_mesh

    mesh, cell_of = surface.triangles()
    cells = surface.shape[0] * surface.shape[1]
    material = next(iter(rt_scene.objects.values())).radio_material  # never met: rays pass through
    measured = mi_mesh(Shape(_SURFACE, material, [_SURFACE], [mesh]), centre)
    measured.set_bsdf(material)
    index = mi.UInt(aligned_indices(cell_of))
    per_area = mi.Float(aligned_columns((1 / _areas(mesh, cell_of, cells))[None])[0])

    def cell(_: Any, si: Any, active: Any) -> tuple[Any, Any]:
        found = dr.gather(mi.UInt, index, si.prim_index, active)
        return found, dr.gather(mi.Float, per_area, found, active)

    return _Geometry(
        map_class=MeshRadioMap,
        map_arguments={"meas_surface": measured},
        solver_arguments={
            "measurement_surface": measured,
            "modified_scene": extend_scene_with_mesh(rt_scene.mi_scene, measured),
        },
        cell=cell,
    )


def _areas(mesh: Any, cell_of: Int64Array, cells: int) -> Float64Array:
    """Area [m²] of each cell, Shape ``[cells]``; infinite for a cell without triangles, whose gain is then
    0."""
    corners = mesh.vertices[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.bincount(cell_of, np.linalg.norm(normals, axis=1) / 2, minlength=cells)
    return np.where(areas > 0, areas, np.inf)
