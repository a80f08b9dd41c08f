"""One scene for several models of a process that ask for the same."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path

from caviar_services.channel.sionna.scene import SceneSettings, SionnaScene

_Made = list[tuple[dict[str, Path], dict[str, int], SceneSettings, SionnaScene]]

_made: ContextVar[_Made | None] = ContextVar("made", default=None)


@contextmanager
def shared_scenes() -> Iterator[None]:
    """Within, whoever asks `scene_of` for the same gets the same scene.

    Who shares a scene must not use it at one time: each frame places the bodies anew.
    """
    token = _made.set([])
    try:
        yield
    finally:
        _made.reset(token)


def scene_of(assets: Mapping[str, Path], pool: Mapping[str, int], settings: SceneSettings) -> SionnaScene:
    """A scene of this scenery; one that was made before, within `shared_scenes`."""
    made = _made.get()
    if made is None:
        return SionnaScene(assets, pool, settings)
    wanted = dict(assets), dict(pool), settings
    for *known, scene in made:
        if tuple(known) == wanted:
            return scene
    scene = SionnaScene(assets, pool, settings)
    made.append((*wanted, scene))
    return scene
