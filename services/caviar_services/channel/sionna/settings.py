"""Settings of the channel ``sionna-rt``, and which of its options can contribute in a scene.

Diffraction doubles the time of a frame, whether or not it finds a path, and a user who asks for an effect
that a scene does not have wants to know. So options that cannot contribute are switched off, with a note. No
path changes by it: an option is switched off only where the ray tracer could find none, which
`tests/physics/test_channel_switched_off.py` checks by comparing both.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import PurePosixPath
from typing import Annotated, Literal

import msgspec
import numpy as np

from caviar_protocol.arrays import quantity
from caviar_protocol.errors import suggestion
from caviar_protocol.messages import WARNING
from caviar_protocol.scenario.conversion import Place
from caviar_services.channel.base import ChannelSettings
from caviar_services.channel.propagation.attenuation import (
    FoliageSettings,
    HumanBlockageSettings,
    check_screens,
)
from caviar_services.channel.propagation.utd import slab
from caviar_services.channel.sionna.ray_launcher import LaunchOptions, rays_within
from caviar_space.materials import (
    DRAWN,
    OTHER_MATERIALS,
    MaterialSettings,
    OutsideRange,
    SurfaceMaterial,
    UsedSurfaces,
)
from caviar_space.mesh_detail import DetailSettings
from caviar_space.meshes import is_object_mesh
from caviar_space.mitsuba_xml import ITU_MATERIALS

# Half of the smallest float32 above 0.
_VANISHED = 2.0**-150

# Options that are on only where the user asked for them.
_ASKED_FOR = frozenset({"refraction", "diffraction", "scattering"})

# Angles [rad] between ray and normal at which slabs are looked at.
_INCIDENCE = np.radians(np.linspace(0.0, 89.9, 900))

# Rays of a launch in each frame.
_SAMPLES = 100_000

# Rays of a launch of scenery, before the first frame.
_SCENERY_SAMPLES = 10_000_000

BodyCount = Annotated[int, quantity("1", "bodies of one mesh for moving objects, at first", ge=0, le=4096)]


class SionnaSettings(ChannelSettings, frozen=True, kw_only=True):
    """Settings of the channel ``sionna-rt``: what is modelled, and how finely.

    Example:
        >>> SionnaSettings(max_depth=2, ray_spacing_deg=1.0).launched_samples()
        41253
    """

    max_depth: Annotated[int, quantity("1", "interactions of a path at most", ge=0, le=16)] = 3
    rung: Literal["siso-rt", "spherical", "mimo-rt"] = "siso-rt"
    """How arrays are treated: plane waves, spherical waves, or every antenna pair traced."""
    h_precision: Literal["double", "single"] = "double"
    """``single``: H is rounded to single precision, 6e-8 of each of its numbers, and takes about 0.6 of the
    space in a compressed recording."""
    candidates: Literal["enumerated", "launched"] | None = None
    """How reflected paths are looked for: ``enumerated``, chains of scenery by launches from where
    transmitters stand, before the first frame, and chains by way of moving objects face by face in each
    frame; ``launched``, all of them by rays in each frame. Absent: enumerated where objects move in the run,
    which is where devices are mounted on them or a world has meshes of them."""
    samples: (
        Annotated[int, quantity("1", "rays of a launch from each transmitter", ge=1, le=100_000_000)] | None
    ) = None
    """Of the scenery's launches where candidates are enumerated, of those in each frame elsewhere. Absent:
    10,000,000 and 100,000."""
    scenery_launches: Annotated[int, quantity("1", "launches of scenery that are united", ge=1, le=100)] = 4
    """Each has its rays turned against the others: what one passes by, another meets."""
    samples_per_frame: Annotated[
        int, quantity("1", "rays launched in each frame where some are needed", ge=1, le=100_000_000)
    ] = 100_000
    """Where candidates are enumerated: from transmitters that move, and for refraction, diffraction,
    scattering and paths longer than ``enumerated_depth``."""
    enumerated_depth: Annotated[int, quantity("1", "interactions of an enumerated path", ge=1, le=5)] = 3
    cache_chains: bool = True
    """Keep the scenery's chains in the user's cache, ``$XDG_CACHE_HOME/caviar/chains``, for the next run."""
    ray_spacing_deg: (
        Annotated[float, quantity("°", "mean angle between rays, in place of samples", ge=0.03, le=90)] | None
    ) = None
    """N rays that share the sphere's 4π sr have a mean spacing Δ [rad] with N = 4π/Δ²."""
    los: bool = True
    """Whether the direct path counts."""
    reflection: bool = True
    """Whether specular reflections count."""
    refraction: bool = False
    """Whether waves pass through walls: each face is a slab of its material's thickness, so that a wall is to
    be one face, not a closed box; see ``solid_walls_m``."""
    solid_walls_m: (
        Annotated[float, quantity("m", "thickness of closed walls that are one slab, at most", gt=0, le=10)]
        | None
    ) = None
    """A closed body of one thickness up to this counts as one slab of that thickness, in its middle. Absent:
    each of its faces is a slab."""
    diffraction: bool = False
    """Whether edges diffract."""
    free_edges: bool = False
    """Whether the rims of open surfaces diffract, too, that of the ground or of a screen without thickness:
    edges at which one face ends and no other begins."""
    edges_within_m: (
        Annotated[float, quantity("m", "from an edge that diffracts to the nearer end of a path", gt=0)]
        | None
    ) = None
    """Edges farther from both ends diffract nothing; where there is none in range of a transmitter and all
    receivers, its rays are launched without diffraction. Absent: all edges count."""
    scattering: bool = False
    """Diffuse reflection; needs a scattering_coefficient above 0 in ``materials``."""
    scattering_samples: (
        Annotated[int, quantity("1", "rays of a launch of its own for diffuse paths", ge=1, le=100_000_000)]
        | None
    ) = None
    """Every point that a ray meets is a path to each receiver that sees it, so diffuse paths take far
    longer than others, and their power converges far sooner. Absent: the rays of ``samples`` scatter too."""
    scattering_paths: (
        Annotated[int, quantity("1", "diffuse paths of a receiver, about", ge=1, le=1_000_000)] | None
    ) = None
    """Of all points at which the rays of ``scattering_samples`` meet something rough, about so many are
    chosen for each receiver, the stronger the likelier, and stand for the others: power is right in the mean.
    Absent: every point at which a ray was drawn to be scattered."""
    launch_seed: Annotated[int | None, quantity("1", "of the ray launch; absent: from the run's seed")] = None
    max_paths: Annotated[
        int, quantity("1", "candidates of a TX/RX pair; more are lost and counted", ge=1)
    ] = 200_000
    follow: (
        Annotated[int, quantity("1", "frames in which all rays are launched, a part in each", ge=2, le=1000)]
        | None
    ) = None
    """Reflections and transmissions are followed from frame to frame, not looked for with all rays in each:
    new ones are found within this many frames, and a channel that is started again in the middle of an
    episode cannot go on unless states are saved. Absent: each frame stands on its own."""
    receivers_at_once: Annotated[
        int | None, quantity("1", "receivers looked at together; absent: as many as fit")
    ] = None
    memory_gib: Annotated[
        float, quantity("GiB", "for rays, and element pairs, looked at or traced together", gt=0, le=1024)
    ] = 4.0
    """Rays are launched in parts of a million at most, and of fewer where this asks for it. The candidates of
    `siso-rt` and of enumeration that are looked at together are bounded by constants, not by this."""
    bodies: BodyCount = 32
    pool: dict[str, BodyCount] = msgspec.field(default_factory=dict)
    """Bodies of single meshes where ``bodies`` does not fit, by file name without ending: ``car = 64``;
    ``box`` for objects without a mesh. A frame with more objects has more bodies made, which takes seconds;
    0 and ``follow`` refuse it."""
    object_faces: Annotated[int, quantity("1", "faces of an object's mesh at most", ge=12)] | None = None
    """A mesh of a moving object with more is decimated, by no more than 1/16 of its sides; a note says by how
    much, of meshes that are there at the beginning. Absent: meshes are as they are."""
    without_body: tuple[str, ...] = ()
    """Classes of objects that the waves pass through."""
    body_material: str = "metal"
    """ITU-R P.2040 material of moving objects."""
    object_materials: dict[str, str] = msgspec.field(default_factory=dict)
    """Materials of moving objects by class, ``pedestrian = "skin"``, and of objects and pieces of scenery by
    name or a pattern of names with ``*``: those of ITU-R P.2040, ``skin``, ``plastic``, and those that
    ``materials`` gives both electric constants. The first of name, pattern and class that fits counts."""
    materials: dict[str, MaterialSettings] = msgspec.field(default_factory=dict)
    """Changes to materials of the scenery, and of ``object_materials``, by name."""
    foliage: dict[str, FoliageSettings] = msgspec.field(default_factory=dict)
    """What is foliage, through which waves pass with a loss: classes of moving objects, and names or patterns
    of names of objects and pieces of scenery, as in ``object_materials``. The volume of a piece of scenery is
    within its mesh, which is to be closed; that of an object is its bounding box."""
    human_blockage: HumanBlockageSettings | None = None
    """People as screens after 3GPP TR 38.901, blockage model B, ``{}`` with the sizes of the objects; their
    class has to stand in ``without_body``, too, so that they do not block twice. Absent: none."""
    detail: DetailSettings = msgspec.field(default_factory=DetailSettings)
    """What of the scenery is left out; absent, nothing is."""
    outside_itu_range: OutsideRange = "error"
    """Where ITU-R P.2040 does not define a material at a carrier: ``error``; ``nearest``, the constants of
    the nearest end of a range; ``extrapolate``, the power law of that range."""

    def __post_init__(self) -> None:
        if self.scattering_samples is not None and not self.scattering:
            raise ValueError("scattering_samples needs scattering = true; write both or neither")
        if self.scattering_paths is not None and self.scattering_samples is None:
            raise ValueError(
                "scattering_paths chooses among the points of a launch of its own; give scattering_samples"
            )
        if self.scattering_samples is not None and self.rung == "mimo-rt":
            raise ValueError(
                'rung = "mimo-rt" traces all paths of an antenna pair at once; leave out scattering_samples'
            )
        if self.human_blockage is not None:
            check_screens(self.human_blockage, {"foliage": self.foliage}, self.without_body)
        if self.free_edges and not self.diffraction:
            raise ValueError("free_edges needs diffraction = true; write both or neither")
        if self.edges_within_m is not None and (not self.diffraction or self.rung == "mimo-rt"):
            raise ValueError(
                'edges_within_m needs diffraction = true and a rung other than "mimo-rt"; leave it out'
            )
        if self.candidates == "enumerated" and (self.follow is not None or self.rung == "mimo-rt"):
            raise ValueError(
                'candidates = "enumerated" goes with neither follow nor rung = "mimo-rt", which launch their '
                "own; leave one out"
            )
        mixed = self.scattering and self.scattering_samples is None
        if self.follow is not None and (self.diffraction or mixed):
            raise ValueError(
                "follow knows reflections and transmissions only; leave it out, or set diffraction to "
                "false and give diffuse paths a launch of their own with scattering_samples"
            )

    def enumerates(self, moving: bool) -> bool:
        """Test whether reflected paths are enumerated.

        Args:
            moving: Whether objects move in the run.
        """
        if self.candidates is not None:
            return self.candidates == "enumerated"
        return moving and self.reflection and self.rung == "siso-rt" and self.follow is None

    def check(self, place: Place) -> None:
        """Check what no single key shows.

        Args:
            place: Where the settings stand.

        Raises:
            ScenarioError: Two keys contradict each other, or a material is not defined.
        """
        if self.ray_spacing_deg is not None and self.samples is not None:
            raise place.at("ray_spacing_deg").error(
                f"is {self.ray_spacing_deg:g}, and samples = {self.samples}: both say how many rays are "
                "launched; leave one out"
            )
        for key, name in self.object_materials.items():
            own = self.materials.get(name, MaterialSettings())
            if name in ITU_MATERIALS or name in OTHER_MATERIALS or own.is_electric:
                continue
            if name not in self.materials:
                known = {*ITU_MATERIALS, *OTHER_MATERIALS, *self.materials}
                raise (
                    place.at("object_materials")
                    .at(key)
                    .error(f"there is no material {name!r}; {suggestion(name, known)}")
                )
            constants = ("relative_permittivity", "conductivity_s_per_m")
            lacking = next(constant for constant in constants if getattr(own, constant) is None)
            raise (
                place.at("materials")
                .at(name)
                .error(
                    f"lacks {lacking}; {name!r} is no material of ITU-R P.2040, so it needs both "
                    f"{' and '.join(constants)}"
                )
            )

    def launched_samples(self, enumerated: bool = False) -> int:
        """Rays of a launch, by ``samples`` or ``ray_spacing_deg``.

        Args:
            enumerated: Whether the launch is one of scenery, of which candidates are enumerated.
        """
        if self.ray_spacing_deg is None:
            absent = _SCENERY_SAMPLES if enumerated else _SAMPLES
            return absent if self.samples is None else self.samples
        # N = 4π/Δ²
        return round(4 * math.pi / math.radians(self.ray_spacing_deg) ** 2)

    def launch_options(self, seed: int) -> LaunchOptions:
        """Options of a launch in each frame.

        Args:
            seed: Of the rays, where there is no ``launch_seed``.
        """
        return LaunchOptions(
            max_depth=self.max_depth,
            samples=self.launched_samples(),
            max_paths=self.max_paths,
            seed=seed if self.launch_seed is None else self.launch_seed,
            reflection=self.reflection,
            refraction=self.refraction,
            diffraction=self.diffraction,
            scattering=self.scattering,
            rays_at_once=rays_within(self.memory_gib, self.max_depth),
        )

    def pool_sizes(self, assets: Iterable[str], place: Place) -> dict[str, int]:
        """Number of bodies of each mesh, by asset: those of the run, and the box, ``""``.

        Args:
            assets: Names of the run's files.
            place: Where the settings stand.

        Raises:
            ScenarioError: ``pool`` names another mesh.
        """
        by_stem = {PurePosixPath(name).stem: name for name in filter(is_object_mesh, assets)}
        by_stem["box"] = ""
        for stem in sorted(self.pool.keys() - by_stem.keys()):
            known = ", ".join(sorted(by_stem))
            # A misspelt mesh would otherwise leave the pool at its default, to be noticed in a late frame.
            raise place.at("pool").at(stem).error(f"the run has no object mesh {stem!r}; it has: {known}")
        return {name: self.pool.get(stem, self.bodies) for stem, name in by_stem.items()}

    def pool_key(self, asset: str, place: Place) -> str:
        """Key that says how many bodies there are of an asset.

        Args:
            asset: Empty for the box.
            place: Where the settings stand.
        """
        stem = PurePosixPath(asset).stem or "box"
        return (place.at("pool").at(stem) if stem in self.pool else place.at("bodies")).key


def contributing(
    options: LaunchOptions, surfaces: UsedSurfaces, frequencies_hz: Sequence[float]
) -> tuple[LaunchOptions, tuple[str, ...]]:
    """Switch off the options that cannot contribute.

    Args:
        options: As the user asked for.
        surfaces: What waves can meet.
        frequencies_hz: Of the carriers [Hz].

    Returns:
        The options that are left, and a note for each that was switched off.
    """
    off: dict[str, str] = {}
    if options.max_depth == 0 or not surfaces.materials:
        nothing = "there is neither scenery nor a body" if options.max_depth else "max_depth is 0"
        off = dict.fromkeys(("reflection", "refraction", "diffraction", "scattering"), nothing)
    else:
        if not any(material.scattering_coefficient > 0 for material in surfaces.materials):
            off["scattering"] = "no material has a scattering_coefficient above 0"
        if options.refraction and not any(
            transmits(material, options, frequencies_hz) for material in surfaces.materials
        ):
            levels = ", ".join(_strongest(material, frequencies_hz) for material in surfaces.materials)
            off["refraction"] = f"no ray is ever sent through a material ({levels} at most)"
        if not surfaces.has_edges:
            off["diffraction"] = "no two faces meet at an edge"
    off = {name: reason for name, reason in off.items() if getattr(options, name)}
    left = replace(options, **dict.fromkeys(off, False))
    # An effect that is on by default, or off by a setting, needs no note: the user did not ask for it.
    asked = frozenset() if options.max_depth == 0 else _ASKED_FOR
    notes = tuple(
        f"{WARNING * (name in asked)}{name} is switched off: {reason}" for name, reason in off.items()
    )
    # Lines of sight are left, for which no ray is launched.
    if not (left.reflection or left.refraction or left.diffraction or left.scattering):
        left = replace(left, max_depth=0)
    return left, notes


def transmits(material: SurfaceMaterial, options: LaunchOptions, frequencies_hz: Sequence[float]) -> bool:
    """Test whether a ray can be sent through a surface on any carrier at any incidence.

    Args:
        material: Of the surface.
        options: What is traced.
        frequencies_hz: Of the carriers [Hz].
    """
    rough = material.scattering_coefficient**2
    returned = options.reflection * (1 - rough) + options.scattering * rough
    for constants, frequency in zip(material.constants, frequencies_hz, strict=True):
        back, through = (
            (np.abs(part) ** 2).sum(0)
            for part in slab(np.cos(_INCIDENCE), constants, material.thickness_m, frequency)
        )
        # Where nothing returns, what passes is not lost beside it: it has to vanish itself.
        smallest = np.where(returned * back > 0, DRAWN * returned * back, _VANISHED)
        if (through >= smallest).any():
            return True
    return False


def _strongest(material: SurfaceMaterial, frequencies_hz: Sequence[float]) -> str:
    """``concrete −93 dB``, of the carrier and incidence at which most passes."""
    most = max(
        float(np.abs(slab(np.cos(_INCIDENCE), constants, material.thickness_m, frequency)[1]).max())
        for constants, frequency in zip(material.constants, frequencies_hz, strict=True)
    )
    # A level below the range of float32 says nothing.
    level = "−∞" if most < 1e-30 else f"−{-20 * np.log10(most):.0f}"
    return f"{material.name} {level} dB"
