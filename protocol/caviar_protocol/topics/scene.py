"""Topic ``scene``: where everything is, and what is mounted on it."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

import msgspec

from caviar_protocol.arrays import Float64Array, Payload, Quaternion, Vector3, array, quantity

DUAL_POLARIZATIONS = {"VH": ("V", "H"), "cross": ("-45", "+45"), "circular": ("RHCP", "LHCP")}
"""Polarizations of two elements at one place."""


class Panel(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Where one panel of an array stands, and how it is turned.

    Angles are in degrees, as their names say: a world copies the map of the scenario as it is.

    Example:
        >>> AntennaArray(panels=(Panel(yaw_deg=90.0), Panel(yaw_deg=-90.0))).size  # to the left, to the right
        2
    """

    position_m: Annotated[Vector3, quantity("m", "centre of the panel, in the device's axes")] = (
        0.0,
        0.0,
        0.0,
    )
    yaw_deg: Annotated[float, quantity("°", "counter-clockwise from the device's +x")] = 0.0
    pitch_deg: Annotated[float, quantity("°", "positive lowers the nose")] = 0.0
    roll_deg: Annotated[float, quantity("°", "about +x")] = 0.0


# The hash is kept: codebooks, subarrays and transforms are looked up by array in every frame.
class AntennaArray(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True, cache_hash=True):
    """A uniform linear (one row or one column) or planar antenna array, of one or several panels.

    The antennas of a panel stand in its y–z plane, boresight +x. Their order is column-major: down
    a column from +z to −z, columns from −y to +y, as in Sionna RT. So antenna ``i`` is row
    ``i % rows`` of column ``i // rows``. An antenna of dual polarization has two elements at one place.
    Elements are in order of panels, then polarizations, then antennas: element
    ``(panel·ports + port)·rows·columns + i``, as in Sionna RT for one panel.

    Example:
        >>> AntennaArray(rows=4, columns=8, polarization="VH").size  # an antenna has two elements
        64
    """

    rows: Annotated[int, quantity("1", "elements along z", ge=1, le=1024)] = 1
    columns: Annotated[int, quantity("1", "elements along y", ge=1, le=1024)] = 1
    vertical_spacing: Annotated[float, quantity("wavelengths", "between rows", gt=0)] = 0.5
    horizontal_spacing: Annotated[float, quantity("wavelengths", "between columns", gt=0)] = 0.5
    # Names of Sionna RT, so that a pattern is looked up and not translated.
    pattern: Literal["iso", "dipole", "hw_dipole", "tr38901"] = "iso"
    """Of each element: isotropic, short dipole, half-wave dipole, 3GPP TR 38.901."""
    polarization: Literal["V", "H", "-45", "+45", "RHCP", "LHCP", "VH", "cross", "circular"] = "V"
    """Of each element: vertical (along the device's z), horizontal (along its y), slanted by ±45°, right- or
    left-handed circular (IEEE); dual: ``VH``, ``cross`` (−45° and +45°), ``circular`` (RHCP and LHCP)."""
    pattern_file: str = ""
    """Asset with the pattern of each element, in place of ``pattern``; in a scenario ``file:`` and a path."""
    panels: tuple[Panel, ...] = ()
    """Panels, each with all rows and columns; empty: one, at the device's own position and orientation."""
    codebook: str = "dft"
    """Beams of each panel and polarization: ``dft``; ``quantized:BITS``, these with phase shifters of so many
    bits; ``file:#SHA-256``, those of the asset ``codebooks/SHA-256``, in a scenario ``file:`` and a path; or
    another name that all services of the run know, with what follows a colon."""

    @property
    def polarizations(self) -> tuple[str, ...]:
        """Polarizations of the elements at one place, first port first: one, or the two of a dual
        polarization."""
        return DUAL_POLARIZATIONS.get(self.polarization) or (self.polarization,)

    @property
    def is_uniform(self) -> bool:
        """True if the array is one panel of one polarization, where the device itself is."""
        return not self.panels and self.polarization not in DUAL_POLARIZATIONS

    @property
    def size(self) -> int:
        """Number of elements."""
        if self.is_uniform:
            return self.rows * self.columns
        return self.rows * self.columns * len(self.polarizations) * max(1, len(self.panels))


# A private base: devices are distinguished by their tag on the wire, never by inheritance.
class _Device(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Fields that all devices share.

    The pose is relative to the parent's pose (centre of its bounding box, body axes), or to
    the world where ``parent`` is empty. `caviar_protocol.space.scene.device_pose` composes the two.
    """

    name: str
    """Unique among objects and devices: ``<object>/<name>`` where it is mounted."""
    parent: str = ""
    """Object that it is mounted on; empty: fixed in the world."""
    position: Vector3 = (0.0, 0.0, 0.0)
    """Relative to the parent: x forward, y left, z up."""
    orientation: Quaternion = (1.0, 0.0, 0.0, 0.0)
    """Relative to the parent: rotates the device's axes into the parent's."""


class AntennaDevice(_Device, frozen=True, kw_only=True, omit_defaults=True, tag="antenna"):
    """A radio transmitter, receiver, or both, with one antenna array.

    Example:
        >>> bs = AntennaDevice(name="bs", role="tx", array=AntennaArray(columns=32))
        >>> bs.parent  # it stands in the world
        ''
    """

    role: Literal["tx", "rx", "both"]
    """Transmits, receives, or both."""
    array: AntennaArray = AntennaArray()
    """Its elements."""
    power_dbm: Annotated[float, quantity("dBm", "transmit power; unused by a receiver")] = 0.0
    carriers: tuple[str, ...] = ()
    """Names of the carriers that it sends and receives on; empty: all of the run."""

    def uses(self, carrier: str) -> bool:
        """Return whether it sends or receives on a carrier.

        Args:
            carrier: Name of the carrier.
        """
        return not self.carriers or carrier in self.carriers


class LidarDevice(_Device, frozen=True, kw_only=True, omit_defaults=True, tag="lidar"):
    """A spinning LIDAR. Beams fan over elevation, each turns once around the device's z axis.

    Example:
        >>> lidar = LidarDevice(name="car/top", parent="car", position=(0.0, 0.0, 1.0), beams=32)
        >>> lidar.beams * lidar.azimuth_steps  # rays of a turn
        57600
    """

    beams: Annotated[int, quantity("1", "beams (rows)", ge=1, le=1024)] = 64
    azimuth_steps: Annotated[int, quantity("1", "rays of a beam in a turn", ge=1, le=36000)] = 1800
    # −25° and 3°, about the field of view of a Velodyne HDL-64E (−24.8° to 2°).
    elevation_min: Annotated[float, quantity("rad", "lowest beam")] = -0.4363323129985824
    elevation_max: Annotated[float, quantity("rad", "highest beam")] = 0.05235987755982989
    max_range: Annotated[float, quantity("m", "farther hits are dropped", gt=0)] = 100.0
    min_range: Annotated[float, quantity("m", "nearer hits are dropped", ge=0)] = 0.0


class CameraDevice(_Device, frozen=True, kw_only=True, omit_defaults=True, tag="camera"):
    """A pinhole camera that looks along the device's +x axis, +z up.

    Example:
        >>> CameraDevice(name="pole/eye", position=(0.0, 0.0, 5.0), width=1280, height=720).field_of_view
        1.5707963267948966
    """

    width: Annotated[int, quantity("px", "image width", ge=1, le=8192)] = 640
    height: Annotated[int, quantity("px", "image height", ge=1, le=8192)] = 480
    field_of_view: Annotated[float, quantity("rad", "horizontal field of view", gt=0)] = 1.5707963267948966


Device = AntennaDevice | LidarDevice | CameraDevice


class Scene(Payload, frozen=True, kw_only=True, omit_defaults=True, dict=True):
    """State of the virtual world at one instant, as one world knows it.

    Objects are sorted by name, devices too. A position is the centre of the object's bounding
    box; the box's axes are the body axes (x forward, y left, z up).

    Example:
        >>> import numpy as np
        >>> scene = Scene(
        ...     names=("car",),
        ...     classes=("car",),
        ...     assets=("",),
        ...     position=np.array([[10.0, 0.0, 0.75]]),
        ...     orientation=np.array([[1.0, 0.0, 0.0, 0.0]]),
        ...     velocity=np.zeros((1, 3)),
        ...     dimensions=np.array([[4.5, 1.8, 1.5]]),
        ...     devices=(AntennaDevice(name="car/rx", role="rx", parent="car", position=(0.0, 0.0, 0.75)),),
        ... )
        >>> scene.position[scene.names.index("car")].tolist()
        [10.0, 0.0, 0.75]
    """

    sizes_from: ClassVar[dict[str, tuple[str, ...]]] = {"N": ("names", "classes", "assets")}

    names: tuple[str, ...]
    """Unique names, each with a prefix that the world declared at READY."""
    classes: tuple[str, ...]
    """Class of each object: ``car``, ``truck``, ``bus``, ``uav``, ``pedestrian``, …"""
    assets: tuple[str, ...]
    """Name of each object's mesh in the asset manifest (unit box −½…½, scaled by
    ``dimensions``); empty: the box itself."""
    position: Annotated[Float64Array, array("<f8", "N", 3, unit="m", doc="bounding-box centre")]
    orientation: Annotated[Float64Array, array("<f8", "N", 4, unit="1", doc="(w, x, y, z), body into world")]
    velocity: Annotated[Float64Array, array("<f8", "N", 3, unit="m/s", doc="in world axes")]
    dimensions: Annotated[
        Float64Array, array("<f8", "N", 3, unit="m", doc="length (x), width (y), height (z)")
    ]
    # In every scene and not once a run: vehicles bring and take devices while it lasts.
    devices: tuple[Device, ...] = ()
    """Devices that exist in this frame. A device whose parent left is not listed."""
    # Optional: it came with 1.4, and worlds of earlier versions do not send it.
    angular_velocity: (
        Annotated[
            Float64Array,
            array("<f8", "N", 3, unit="rad/s", doc="about the bounding-box centre, in world axes"),
        ]
        | None
    ) = None
    """How objects turn [rad/s, world axes]: what is at r from an object's position moves with velocity +
    angular_velocity × r; absent: no object turns, or the world does not know."""


WITHOUT_OBJECT_PREFIX = "device-without-object/"
"""Before the name of a device in the counts of a world's report: there was no object for it to stand on."""
MESH_REFUSED_PREFIX = "mesh-refused/"
"""Before the name of a mesh in the counts of a world's report: it is not used, its objects are boxes."""
LEFT_GEOFENCE_PREFIX = "left-geofence/"
"""Before the name of an object in the counts of a world's report: it drifted out of its geofence."""
OUTSIDE_GEOFENCE_PREFIX = "commanded-outside-geofence/"
"""Before the name of an object in the counts of a world's report: a place outside of its geofence was
commanded."""
SIMULATOR_SAYS_PREFIX = "simulator-says/"
"""Before a kind of warning in the counts of a world's report: what the simulator behind it printed."""
BESIDE_ROAD_PREFIX = "beside-road/"
"""Before the name of a vehicle in the counts of a world's report: it is one rigid box, and too long for the
bend that it is in."""
