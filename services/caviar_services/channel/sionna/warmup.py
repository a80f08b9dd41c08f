"""Every kernel that frames need, compiled before the first frame waits for it."""

from __future__ import annotations

import importlib
import itertools
from collections.abc import Sequence

import numpy as np

from caviar_protocol.topics import Scene
from caviar_services.channel.enumeration.path_solver import EnumeratedTracer
from caviar_services.channel.enumeration.scenery_chains import KnownScenery
from caviar_services.channel.sionna.candidate_visibility import Corners
from caviar_services.channel.sionna.path_solver import Tracer
from caviar_services.channel.sionna.ray_launcher import LaunchOptions
from caviar_services.channel.sionna.scene import SionnaScene
from caviar_services.channel.sionna.tracking import Followed


def compile_kernels(
    scene: SionnaScene,
    launched: LaunchOptions,
    tracers: Sequence[Tracer],
    diffuse: Tracer | None,
    *,
    rung: str,
    followed_parts: int | None,
    enumerated: EnumeratedTracer | None = None,
) -> None:
    """Trace above the scene whatever finds paths in frames.

    Args:
        scene, launched: What is traced in, and what is modelled there.
        tracers, diffuse: Whose kernels are compiled: those of all paths, the first of them that of ``rung``,
            and that of diffuse paths where they have a launch of their own.
        rung: How arrays are treated.
        followed_parts: Frames in which all rays are launched; None: nothing is followed.
        enumerated: What enumerates paths by way of bodies; for it some are placed above the scene, and
            parked again.
    """
    if launched.diffraction:
        importlib.import_module("scipy.special")  # which the first diffracted path would wait for
    middle = (scene.low + scene.high) / 2
    above = np.array([middle[0], middle[1], scene.high[2] + 10.0])
    receivers = above + np.arange(1, 9)[:, None] * np.array([1.3, 0.7, -0.1])
    followed = None if followed_parts is None else Followed(followed_parts)
    for shift, tracer in itertools.product((0.0, 0.5, 1.0), tracers):
        tracer.trace(above + shift, receivers + shift / 2, followed=followed, names=scene.names)
    if diffuse is not None:
        for shift in (0.0, 0.5):
            diffuse.trace(above + shift, receivers + shift / 2)
    if rung != "siso-rt":
        corners = Corners(above[None] + [[0, 0, 0.1], [0, 0.1, 0]], receivers[:, None] + np.eye(3)[:2])
        for tracer in tracers:
            tracer.trace(above, receivers, corners=corners)
    if enumerated is not None:
        _enumerate(scene, enumerated, launched.max_depth)
    if rung == "spherical":
        look = tracers[0].look
        look.nearest(receivers, receivers - 1.0)
        chains = np.full((len(receivers), launched.max_depth), -1)
        look.reflected(chains, receivers, receivers - 1.0)


def _enumerate(scene: SionnaScene, tracer: EnumeratedTracer, depth: int) -> None:
    """Enumerate paths among two bodies of each mesh, with a chain of scenery of each length."""
    middle = (scene.low + scene.high) / 2
    above = np.array([middle[0], middle[1], scene.high[2] + 10.0])
    # Kinds are given, and not by names and classes, which the user's patterns may match.
    kinds = dict(enumerate(kind for kind in scene.unit_meshes for _ in scene.bodies_of(kind)[:2]))
    count = len(kinds)
    if not count:
        return
    place = above + np.arange(count)[:, None] * np.array([2.0, 7.0, 0.5])
    objects = Scene(
        names=tuple(f"caviar-warming-{number:04d}" for number in kinds),
        classes=("",) * count,
        assets=("",) * count,
        position=place,
        orientation=np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
        velocity=np.zeros((count, 3)),
        dimensions=np.tile([4.0, 2.0, 1.5], (count, 1)),
    )
    chains = np.full((depth + 1, depth), -1, np.int32)
    for length in range(depth + 1):
        chains[length, :length] = np.arange(length)
    chains = chains[(chains < scene.first_moving_plane).all(1)]
    some = np.arange(depth)
    sights = np.stack(np.meshgrid(some, some), axis=-1).reshape(-1, 2).astype(np.int32)
    scenery = KnownScenery(chains[1:], sights)
    for parked in (0, count // 2, count):
        scene.place_bodies(objects, {number: kind for number, kind in kinds.items() if number >= parked})
        tracer.trace(above + np.array([0.0, 3.0, 4.0]), place + np.array([0.3, 0.2, 1.0]), scenery)
