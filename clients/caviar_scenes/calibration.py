"""Calibration: constants of materials, fitted to received powers or channel responses at known places.

The channel of the scenario finds the paths to all places once. Their geometry stays fixed, and their fields
are computed anew, in float64, for other constants: products of Fresnel's coefficients of slabs along paths of
reflections and transmissions (`utd.slab`); of diffuse ones, the last of whose points scatters, the amplitude
follows the scattering coefficient and what the surface reflects there. Paths by way of edges and moving
objects keep their fields. Each path keeps the ratio of the channel's own amplitude to that of the same
constants here, which has foliage, air and antennas in it.

The least squares of residuals over their standard deviation give permittivity, the logarithm of conductivity
(with a weak prior about the scenario's, `DECADES`) and the scattering coefficient, after a search over
permittivities, since slabs reflect more and less by turns. Intervals are of 95 %, from the covariance (JᵀJ)⁻¹
at the optimum, wider where residuals are larger than the noise that was given, or where other optima fit as
well. A parameter whose interval is wider than `WIDEST` is one that the data do not tell.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from caviar_protocol.arrays import BoolArray, Complex128Array, Float64Array, Int64Array
from caviar_protocol.errors import AssetError, RunError, SetupError, suggestion
from caviar_protocol.host import install_command
from caviar_protocol.space.coordinates import SPEED_OF_LIGHT
from caviar_protocol.topics import AntennaDevice, Channel, Interaction
from caviar_scenes.views import read_table

if TYPE_CHECKING:
    from caviar_clients.session.scenes import Scenes
    from caviar_services.channel.sionna.model import SionnaChannel
    from caviar_space.materials import SurfaceMaterial

PARAMETERS = ("relative_permittivity", "conductivity_s_per_m", "scattering_coefficient")
"""Of a material, as in the channel's setting ``materials``."""
BOUNDS = ((1.0, 30.0), (-5.0, 2.0), (0.0, 0.95))
"""Of relative permittivity, logarithm of the conductivity [S/m], and scattering coefficient."""
WIDEST = (10.0, 1.0, 0.6)
"""Width of an interval from which on the data do not tell the parameter."""
DECADES = 0.5
"""Standard deviation of the logarithm of a conductivity about the scenario's: walls of little loss would be
plates in which waves resonate, which fits noise well."""
SEARCHED = np.concatenate([np.arange(1.4, 9.0, 0.2), np.arange(9.0, 20.0, 1.0)])
"""Permittivities from which the fit may start."""
RIPPLE = np.linspace(0.85, 1.15, 241)
"""Parts of a permittivity at which the interval is looked at beyond the optimum."""
FAINT = 1e-3
"""Share of the received power, summed over places, below which a material counts as unseen."""


@dataclass(frozen=True, eq=False)
class Measurements:
    """Measurements at N places of a receiver."""

    position: Float64Array
    """[m], Shape ``[N, 3]``."""
    transmitter: tuple[str, ...]
    """Name of the transmitter of each; empty: the only one."""
    power_dbm: Float64Array | None
    """Received power, sum over paths [dBm], Shape ``[N]``; None: responses were measured."""
    response: Complex128Array | None
    """Channel between single elements [1], Shape ``[N]``; None: powers were measured."""


class Fitted(msgspec.Struct, frozen=True, kw_only=True):
    """A parameter of a material."""

    material: str
    parameter: str
    value: float
    low: float
    """Of the interval of 95 %; of a parameter that is not identified, the value before."""
    high: float
    why: str = ""
    """Why the data do not identify it; empty: they do."""

    @property
    def identified(self) -> bool:
        """Whether the data identify it."""
        return not self.why


@dataclass(frozen=True, kw_only=True, eq=False)
class Calibration:
    """Result of a calibration."""

    service: str
    """Name of the channel in the scenario."""
    parameters: tuple[Fitted, ...]
    before: float
    """Root mean square of the residuals with the scenario's constants: dB, or relative for responses."""
    after: float
    places: int
    """With a path, and used."""
    without: int
    """Without a path."""
    agreement: float
    """Largest relative difference of fields here and in the channel, of the paths that are computed anew."""


def read_measurements(file: Path) -> Measurements:
    """Read measurements: CSV with x_m, y_m, z_m, and power_dbm, or re and im; transmitter where several send.

    Args:
        file: The table.

    Raises:
        AssetError: A line is wrong; names file, line and value.
    """
    try:
        text = file.read_text("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise AssetError(f"cannot read the measurements {file}: {error}") from error
    rows = read_table(file, text, ("x_m", "y_m", "z_m"))
    if not rows:
        raise AssetError(f"{file} has no measurements; write one a line: x_m,y_m,z_m,power_dbm")
    columns = [key for key in ("power_dbm", "re", "im") if key in rows[0][1]]
    if columns not in (["power_dbm"], ["re", "im"]):
        raise AssetError(f"{file}:1: give either the column power_dbm, or re and im")
    numbers = np.empty((len(rows), 3 + len(columns)))
    for number, (line, row) in enumerate(rows):
        for place, key in enumerate(("x_m", "y_m", "z_m", *columns)):
            try:
                numbers[number, place] = float(row[key])
            except ValueError:
                numbers[number, place] = math.nan
            if not math.isfinite(numbers[number, place]):
                raise AssetError(f"{file}:{line}: {key} is {row[key]!r}; write a number")
    powers = columns == ["power_dbm"]
    return Measurements(
        position=numbers[:, :3],
        transmitter=tuple(row.get("transmitter", "") for _, row in rows),
        power_dbm=numbers[:, 3] if powers else None,
        response=None if powers else numbers[:, 3] + 1j * numbers[:, 4],
    )


class FixedPaths:
    """Paths of a scenario's channel to places, whose fields follow the constants of materials.

    Args:
        scenes: The scenario, with one instant.
        position: Of receivers [m], Shape ``[N, 3]``.
        rough: Materials that scatter by 0.3 at least while paths are sought, so that there are diffuse ones.
        carrier: Index of the carrier.

    Raises:
        RunError: The scenario has no channel that traces rays, or no transmitter.
    """

    def __init__(
        self, scenes: Scenes, position: Float64Array, rough: Sequence[str] = (), carrier: int = 0
    ) -> None:
        from caviar_services.channel.paths import Antenna, antenna_fields

        scene = scenes.instants[0].scene
        model = _model(scenes, rough)
        tx = [d for d in scene.devices if isinstance(d, AntennaDevice) and d.role != "rx"]
        if not tx:
            raise RunError(f"{scenes.origin} has no transmitter; give it a device of the role tx")
        # Receivers have the element and the turn of the scenario's first one.
        like = next((d for d in scene.devices if isinstance(d, AntennaDevice) and d.role == "rx"), None)
        like = like or AntennaDevice(name="", role="rx")
        one = msgspec.structs.replace(like.array, rows=1, columns=1)
        receivers = [
            msgspec.structs.replace(
                like, name=f"calibration-{n:05d}", parent="", position=tuple(place), array=one
            )
            for n, place in enumerate(position.tolist())
        ]
        tx = sorted(tx, key=lambda device: device.name)
        self.transmitters = tuple(device.name for device in tx)
        self.power_dbm = tuple(device.power_dbm for device in tx)
        channel = _channel(model, scene, tx, receivers)
        sent = [Antenna.of(scene, device, model.patterns) for device in tx]
        taken = [Antenna.of(scene, device, model.patterns) for device in receivers]
        self.pair = np.repeat(np.arange(len(channel.offsets) - 1), np.diff(channel.offsets))
        self.places = len(receivers)
        self.amplitude: Complex128Array = channel.a[carrier]
        self.service = model.run.name
        named = {surface.name: surface for surface in model.scene.used_surfaces().materials}
        self.surfaces = tuple(named.values())
        frequency = scenes.carriers[carrier].frequency_hz
        self._carrier, self._frequency = carrier, frequency
        self._thickness = np.array([surface.thickness_m for surface in self.surfaces])
        t, r = np.divmod(self.pair, len(receivers))
        start = np.array([antenna.position for antenna in sent])[t]
        end = np.array([antenna.position for antenna in taken])[r]
        types = channel.interactions
        count = (types != 0).sum(1)
        points = np.where((types != 0)[..., None], channel.points, end[:, None])
        self._corners = np.concatenate([start[:, None], points, end[:, None]], axis=1)
        self._count, self._types = count, types
        self._material, self._normals = _met(channel, scenes, model, self._corners, self.surfaces)
        known = ((self._material >= 0) | (types == 0)).all(1) & np.isfinite(self._normals).all((1, 2))
        scattered = types == Interaction.SCATTERING
        # Of a diffuse path the last point scatters; what is by way of an edge keeps its field.
        rows = np.arange(len(types))
        last = scattered[rows, np.maximum(count - 1, 0)] & (count > 0) if types.shape[1] else count > 0
        other = (types == Interaction.DIFFRACTION).any(1) | (scattered.sum(1) > last)
        self.anew: BoolArray = known & ~other & (count > 0)
        self.diffuse: BoolArray = last
        """Which paths are scattered, at their last point."""
        if types.shape[1]:
            arrival = _unit(self._corners[rows, count] - end)
            self._prepare(
                antenna_fields(sent, t, _unit(self._corners[:, 1] - start)).astype(np.complex128),
                antenna_fields(taken, r, arrival, arrival=True).astype(np.complex128),
            )
        own = self._own(self.constants())
        self.anew &= np.abs(own) > 1e-12
        self._ratio = np.ones(len(own), np.complex128)
        self._ratio[self.anew] = self.amplitude[self.anew] / own[self.anew]
        # Phases and spreading are in the ratio; magnitudes are to agree, of paths that are not diffuse.
        length = np.linalg.norm(np.diff(self._corners, axis=1), axis=-1).sum(-1)
        spread = SPEED_OF_LIGHT / self._frequency / (4 * np.pi * np.maximum(length, 1e-9))
        strong = self.anew & ~self.diffuse & (np.abs(own) > 1e-2)
        self.agreement = float(np.abs(np.abs(self._ratio[strong]) / spread[strong] - 1).max(initial=0.0))

    def constants(self) -> Float64Array:
        """Constants of all surfaces as the channel has them: `PARAMETERS`, Shape ``[materials, 3]``."""
        return np.array(
            [[*surface.constants[self._carrier], surface.scattering_coefficient] for surface in self.surfaces]
        ).reshape(-1, 3)

    def fields(self, constants: Float64Array) -> Complex128Array:
        """Amplitudes of all paths, Shape ``[P]``.

        Args:
            constants: Of each surface, as `constants` returns them.
        """
        return np.where(self.anew, self._own(constants) * self._ratio, self.amplitude)

    def power(self, amplitude: Complex128Array) -> Float64Array:
        """Sum of the powers of the paths of each pair, Shape ``[T·N]``."""
        pairs = len(self.transmitters) * self.places
        found: Float64Array = np.bincount(self.pair, np.abs(amplitude) ** 2, pairs).astype(np.float64)
        return found

    def response(self, amplitude: Complex128Array) -> Complex128Array:
        """Sum of the amplitudes of the paths of each pair, Shape ``[T·N]``."""
        pairs = len(self.transmitters) * self.places
        real, imaginary = (np.bincount(self.pair, part, pairs) for part in (amplitude.real, amplitude.imag))
        found: Complex128Array = real + 1j * imaginary
        return found

    def share(self, material: int) -> float:
        """Share of paths that meet a surface in the power at all places, in the mean over them."""
        amplitude = self.amplitude
        met = self.anew & (self._material == material).any(1)
        power = self.power(amplitude)
        of_it = self.power(np.where(met, amplitude, 0.0))
        reached = power > 0
        return float((of_it[reached] / power[reached]).mean()) if reached.any() else 0.0

    def _prepare(self, start: Complex128Array, end: Complex128Array) -> None:
        """Work out what fields of antennas become between the points, in the bases TE and TM of each.

        A path's amplitude is then a product of matrices 2 × 2, of which those of the points are diagonal.
        """
        steps = _unit(np.diff(self._corners, axis=1))
        into, out = steps[:, :-1], steps[:, 1:]
        te = np.cross(into, self._normals)
        lost = np.linalg.norm(te, axis=-1) < 1e-9  # along the normal: any direction across will do
        te[lost] = np.cross(into[lost], np.eye(3)[np.argmin(np.abs(into[lost]), axis=-1)])
        te = _unit(te)
        before, after = np.cross(into, te), np.cross(out, te)
        self._cosine = np.abs((into * self._normals).sum(-1))
        self._first = np.stack([(te[:, 0] * start).sum(-1), (before[:, 0] * start).sum(-1)], -1)
        there, here = np.stack([te, before], -2)[:, 1:], np.stack([te, after], -2)[:, :-1]
        self._between = np.einsum("pdic,pdjc->pdij", there, here)
        rows, last = np.arange(len(end)), np.maximum(self._count - 1, 0)
        ends = np.stack([te[rows, last], after[rows, last]], -2)
        self._last = np.einsum("pjc,pc->pj", ends, end)

    def _own(self, constants: Float64Array) -> Complex128Array:
        """Amplitudes of the paths that are computed anew, without what does not depend on constants; [P]."""
        from caviar_services.channel.propagation.utd import slab

        own = np.zeros(len(self.anew), np.complex128)
        if not self._material.shape[1]:
            return own
        of = np.maximum(self._material, 0)
        permittivity, conductivity, scattering = np.moveaxis(constants[of], -1, 0)
        back, through = slab(self._cosine, (permittivity, conductivity), self._thickness[of], self._frequency)
        back = np.moveaxis(back, 0, -1)
        specular = back * np.sqrt(1 - scattering**2)[..., None]
        passed = (self._types == Interaction.TRANSMISSION)[..., None]
        specular = np.where(passed, np.moveaxis(through, 0, -1), specular)
        field = self._first
        for d in range(of.shape[1]):
            last = self._count == d + 1
            end = last & ~self.diffuse
            own[end] = (self._last[end] * specular[end, d] * field[end]).sum(1)
            # What arrives at a rough point is reflected by so much of it, whichever way it is scattered.
            end = last & self.diffuse
            own[end] = scattering[end, d] * np.linalg.norm(back[end, d] * field[end], axis=1)
            if d + 1 < of.shape[1]:
                field = np.einsum("pij,pj->pi", self._between[:, d], specular[:, d] * field)
        return own


def _model(scenes: Scenes, rough: Sequence[str]) -> SionnaChannel:
    from caviar_protocol.scenario.conversion import Place, convert_settings
    from caviar_services.channel.sionna.model import SionnaChannel
    from caviar_services.channel.sionna.settings import SionnaSettings
    from caviar_services.registry import load
    from caviar_services.service import Preparation, RunInfo
    from caviar_space.materials import MaterialSettings

    for name, spec in scenes.services.items():
        if spec.role != "channel" or not issubclass(load("channel", spec.use), SionnaChannel):
            continue
        place = Place("services").at(name).at("settings")
        settings = convert_settings(SionnaSettings, spec.settings, place)
        given = settings.materials
        rougher = {}
        for key in rough if settings.scattering else ():
            known = given.get(key, MaterialSettings())
            some = max(0.3, known.scattering_coefficient or 0.0)
            rougher[key] = msgspec.structs.replace(known, scattering_coefficient=some)
        settings = msgspec.structs.replace(settings, materials={**given, **rougher}, rung="siso-rt")
        run = RunInfo(
            name=name,
            seed=scenes.seed,
            sampling_period_ns=scenes.sampling_period_ns,
            carriers=scenes.carriers,
            devices=scenes.devices,
        )
        model = SionnaChannel(settings, run)
        model.prepare(Preparation(demand={"channel": frozenset()}, assets=scenes.assets))
        return model
    raise RunError(f'{scenes.origin} has no channel with use = "sionna-rt"; calibrate one that traces rays')


def _channel(
    model: SionnaChannel, scene: Any, tx: Sequence[AntennaDevice], receivers: Sequence[AntennaDevice]
) -> Channel:
    from caviar_services.service import Frame

    kept = tuple(d for d in scene.devices if not isinstance(d, AntennaDevice) or d.role != "rx")
    devices = tuple(sorted([*kept, *receivers], key=lambda device: device.name))
    scene = msgspec.structs.replace(scene, devices=devices)
    frame = Frame(episode=0, number=0, t_ns=0)
    return model.model(frame, scene, tx, receivers).channel


def _met(
    channel: Channel,
    scenes: Scenes,
    model: SionnaChannel,
    corners: Float64Array,
    surfaces: Sequence[SurfaceMaterial],
) -> tuple[Int64Array, Float64Array]:
    """Number of the surface material at each point, −1 where it is none of scenery, and unit normals."""
    from caviar_space.materials import ObjectMaterials
    from caviar_space.mitsuba_xml import find_scenery, read_scenery, world_mesh

    description = find_scenery(scenes.assets)
    shapes = {s.name: s for s in read_scenery(description).shapes} if description else {}
    own = ObjectMaterials(model.settings.object_materials)
    names = [surface.name for surface in surfaces]
    of_object = []
    for name in channel.object_names:
        shape = shapes.get(name)
        called = own.material_for(name) or (shape.radio.name if shape and shape.radio else "")
        of_object.append(names.index(called) if shape and called in names else -1)
    material = np.array([*of_object, -1], np.int64)[channel.objects]
    # A mirror's normal lies along the change of direction; one that lets waves through does not show.
    steps = _unit(np.diff(corners, axis=1))
    normals = _unit(steps[:, 1:] - steps[:, :-1])
    for index, name in enumerate(channel.object_names):
        kind = (Interaction.SCATTERING, Interaction.TRANSMISSION)
        at = (channel.objects == index) & np.isin(channel.interactions, kind)
        if at.any() and name in shapes:
            normals[at] = _nearest_normals(world_mesh(shapes[name]), channel.points[at])
    return material, normals


def _nearest_normals(mesh: Any, points: Float64Array) -> Float64Array:
    """Unit normals of the triangles that points lie in."""
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    normal = _unit(np.cross(b - a, c - a))
    found = np.full(points.shape, np.nan)
    best = np.full(len(points), 0.01)
    for face in range(len(a)):
        off = np.abs((points - a[face]) @ normal[face])
        rows = np.flatnonzero(off < best)
        inside = np.ones(len(rows), bool)
        for p, q in ((a, b), (b, c), (c, a)):
            side = np.cross(q[face] - p[face], points[rows] - p[face]) @ normal[face]
            inside &= side > -1e-3 * np.linalg.norm(q[face] - p[face])
        found[rows[inside]], best[rows[inside]] = normal[face], off[rows[inside]]
    return found


def _unit(vectors: Float64Array) -> Float64Array:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    units: Float64Array = vectors / np.where(length > 0, length, 1.0)
    return units


def calibrate(
    scenes: Scenes,
    measured: Measurements,
    materials: Sequence[str],
    noise_db: float = 1.0,
    carrier: int = 0,
) -> Calibration:
    """Fit the constants of materials.

    Args:
        scenes: The scenario, with one instant.
        measured: At known places.
        materials: Names, as the channel's setting ``materials`` has them; all others stay as they are.
        noise_db: Standard deviation of powers [dB]; of responses the same part of the root mean square one.
        carrier: Index of the carrier.

    Raises:
        AssetError: A material or transmitter is not there, or no place has a path.
        RunError: The scenario has no channel that traces rays, or its fields are not those computed here.
        SetupError: SciPy is not installed.
    """
    try:
        from scipy.optimize import least_squares  # type: ignore[import-untyped]
    except ImportError as error:
        raise SetupError(f"calibration needs SciPy; run: {install_command('scenes')}") from error
    paths = FixedPaths(scenes, measured.position, materials, carrier)
    names = [surface.name for surface in paths.surfaces]
    for name in materials:
        if name not in names:
            raise AssetError(f"no surface is of {name!r}; {suggestion(name, names)}")
    if paths.agreement > 0.02:
        raise RunError(
            f"fields of paths differ by up to {100 * paths.agreement:.1f} % from those of the channel; "
            "calibrate on scenery with walls of one layer"
        )
    pairs = _pairs(paths, measured)
    start = paths.constants()
    reached = paths.power(paths.amplitude)[pairs] > 0
    if not reached.any():
        raise AssetError(f"none of the {len(pairs)} places has a path; check their coordinates and axes")
    shares = {name: paths.share(names.index(name)) for name in materials}
    seen = [name for name in materials if shares[name] >= FAINT]
    count = 3 if paths.diffuse.any() else 2
    low, high = (np.tile([bound[side] for bound in BOUNDS[:count]], len(seen)) for side in (0, 1))

    def constants(x: Float64Array) -> Float64Array:
        found = start.copy()
        for k, name in enumerate(seen):
            values = x[count * k : count * (k + 1)]
            found[names.index(name), :count] = values
            found[names.index(name), 1] = 10.0 ** values[1]
        return found

    powers = None if measured.power_dbm is None else measured.power_dbm[reached]
    sending = np.array(paths.power_dbm)[pairs // paths.places][reached]
    scale = noise_db
    if measured.response is not None:
        scale = (10 ** (noise_db / 20) - 1) * float(np.sqrt(np.mean(np.abs(measured.response) ** 2)))

    def misfit(x: Float64Array) -> Float64Array:
        amplitude = paths.fields(constants(x))
        if measured.response is not None:
            off = (paths.response(amplitude)[pairs] - measured.response)[reached] / scale
            return np.concatenate([off.real, off.imag])
        found = sending + 10 * np.log10(np.maximum(paths.power(amplitude)[pairs][reached], 1e-40))
        return np.asarray((found - powers) / scale)

    x = np.array([v for name in seen for v in _scaled(start[names.index(name)])[:count]])
    x = np.clip(x, low + 1e-6, high - 1e-6)
    known = x[1::count].copy()

    def residuals(x: Float64Array) -> Float64Array:
        return np.concatenate([misfit(x), (x[1::count] - known) / DECADES])

    before = float(np.sqrt(np.mean(misfit(x) ** 2)))
    after, deviation = before, np.zeros(0)
    if seen:

        def cost(x: Float64Array) -> float:
            return 0.5 * float((residuals(x) ** 2).sum())

        def refined(x: Float64Array) -> Any:
            return least_squares(residuals, x, jac="3-point", bounds=(low, high), x_scale="jac")

        def varied(x: Float64Array, k: int, values: Float64Array) -> Float64Array:
            tried = np.tile(x, (len(values), 1))
            tried[:, count * k] = np.clip(values, *BOUNDS[0])
            return tried

        fits = []
        for more in (0.0, -DECADES, DECADES):
            begin = x.copy()
            begin[1::count] += more
            begin = np.clip(begin, low + 1e-6, high - 1e-6)
            for _ in range(2):
                for k in range(len(seen)):
                    begin = min(varied(begin, k, np.append(SEARCHED, begin[count * k])), key=cost)
            fits.append(refined(begin))
        # What a slab reflects has a ripple over its permittivity: its neighbours may fit as well, or better.
        best = min(fits, key=lambda one: float(one.cost)).x
        for k in range(len(seen)):
            tried = varied(best, k, RIPPLE * best[count * k])
            costs = np.array([cost(one) for one in tried])
            dips = 1 + np.flatnonzero((costs[1:-1] <= costs[:-2]) & (costs[1:-1] <= costs[2:]))
            fits += [refined(tried[dip]) for dip in dips[np.argsort(costs[dips])][:6]]
        fit = min(fits, key=lambda one: float(one.cost))
        x, left = fit.x, misfit(fit.x)
        after = float(np.sqrt(np.mean(left**2)))
        # Noise larger than what was given widens the intervals; less of it may be chance.
        larger = max(1.0, float((left**2).sum()) / max(1, len(left) - len(x)))
        deviation = np.sqrt(np.diag(np.linalg.pinv(fit.jac.T @ fit.jac, rcond=1e-14)) * larger)
        deviation[(fit.jac**2).sum(0) < 1e-12] = math.inf
        # Of other optima, those are not ruled out that are as likely as the ends of the interval.
        rivals = np.array([one.x for one in fits if one.cost < fit.cost + 1.92])
        deviation += np.abs(rivals - x).max(0) / 1.96
    found = [
        fitted
        for name in materials
        for fitted in _fitted(name, seen, count, x, deviation, start[names.index(name)], shares[name])
    ]
    return Calibration(
        service=paths.service,
        parameters=tuple(found),
        before=before * scale,
        after=after * scale,
        places=int(reached.sum()),
        without=int((~reached).sum()),
        agreement=paths.agreement,
    )


def _pairs(paths: FixedPaths, measured: Measurements) -> Int64Array:
    known = paths.transmitters
    for name in measured.transmitter:
        if name not in known and (name or len(known) > 1):
            raise AssetError(f"the scenario has no transmitter {name!r}; {suggestion(name, known)}")
    which = [known.index(name) if name else 0 for name in measured.transmitter]
    pairs: Int64Array = np.array(which, np.int64) * paths.places + np.arange(paths.places)
    return pairs


def _scaled(constants: Float64Array) -> tuple[float, float, float]:
    return float(constants[0]), math.log10(max(float(constants[1]), 1e-5)), float(constants[2])


def _fitted(
    name: str,
    seen: Sequence[str],
    count: int,
    x: Float64Array,
    deviation: Float64Array,
    start: Float64Array,
    share: float,
) -> list[Fitted]:
    found = []
    for p, parameter in enumerate(PARAMETERS):
        value = float(start[p])
        low = high = value
        if name not in seen:
            part = f"{100 * share:.2g} % of the power" if share else "no path"
            why = f"unseen: {part} at these places is by way of it"
        elif p >= count:
            why = "the channel has no diffuse paths (scattering = false)"
        else:
            k = count * seen.index(name) + p
            half = 1.96 * float(deviation[k])
            ends = [float(np.clip(x[k] + sign * half, *BOUNDS[p])) for sign in (-1, 1)]
            narrow = 2 * half < WIDEST[p] and BOUNDS[p][0] + 1e-3 < x[k] < BOUNDS[p][1] - 1e-3
            value, low, high = (10.0**v if p == 1 else v for v in (float(x[k]), *ends))
            why = "" if narrow else "its interval is as wide as its range"
        found.append(Fitted(material=name, parameter=parameter, value=value, low=low, high=high, why=why))
    return found


def settings_text(found: Calibration) -> str:
    """Write identified parameters as tables of a scenario, with intervals, and the others as remarks.

    Args:
        found: The result.
    """
    lines: list[str] = []
    by_material: dict[str, list[Fitted]] = {}
    for fitted in found.parameters:
        by_material.setdefault(fitted.material, []).append(fitted)
    for material, parameters in by_material.items():
        identified = [fitted for fitted in parameters if fitted.identified]
        if identified:
            lines.append(
                f"[services.{found.service}.settings.materials.{msgspec.json.encode(material).decode()}]"
            )
        lines += [
            f"{one.parameter} = {one.value:.6g}  # {one.low:.4g} to {one.high:.4g}" for one in identified
        ]
        lines += [
            f"# {material}: {one.parameter} is not identified: {one.why}" for one in parameters if one.why
        ]
        lines.append("")
    return "\n".join(lines)
