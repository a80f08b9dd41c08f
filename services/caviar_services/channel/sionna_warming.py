"""Every kernel that frames need, compiled before the first frame waits for it."""

from __future__ import annotations

import importlib
import itertools
from collections.abc import Sequence

import numpy as np

from caviar_services.channel.sionna_follow import Followed
from caviar_services.channel.sionna_launch import LaunchOptions
from caviar_services.channel.sionna_reach import Corners
from caviar_services.channel.sionna_scene import SionnaScene
from caviar_services.channel.sionna_tracer import Tracer


def compile_kernels(
    scene: SionnaScene,
    launched: LaunchOptions,
    tracers: Sequence[Tracer],
    diffuse: Tracer | None,
    *,
    rung: str,
    followed_parts: int | None,
) -> None:
    """Trace above the scene whatever finds paths in frames.

    Parameters
    ----------
    scene, launched
        What is traced in, and what is modelled there.
    tracers, diffuse
        Whose kernels are compiled: those of all paths, the first of them that of ``rung``, and that of
        diffuse paths where they have a launch of their own.
    rung
        How arrays are treated.
    followed_parts
        Frames in which all rays are launched; None: nothing is followed.
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
    if rung == "spherical":
        look = tracers[0].look
        look.nearest(receivers, receivers - 1.0)
        chains = np.full((len(receivers), launched.max_depth), -1)
        look.reflected(chains, receivers, receivers - 1.0)
