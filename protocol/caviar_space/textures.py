"""Pictures on the surfaces of imported models; cameras show them, waves do not meet them."""

from __future__ import annotations

import hashlib
import io
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from caviar_protocol.arrays import Float64Array, Int64Array, UInt8Array
from caviar_protocol.errors import AssetError, SetupError
from caviar_protocol.host import install_command

WRAPS: dict[str, Callable[[Float64Array], Float64Array]] = {
    "repeat": lambda place: place % 1.0,
    "clamp": lambda place: place.clip(0.0, 1.0),
    "mirror": lambda place: 1.0 - np.abs(place % 2.0 - 1.0),
}
"""Place in a picture, 0…1, of a place that may be beyond its border."""


@dataclass(frozen=True, eq=False)
class Texture:
    """A picture, and the places in it of the corners of triangles."""

    image: bytes
    """PNG or JPEG."""
    uv: Float64Array
    """Right and down from the upper left corner of the picture, 1 at its borders, Shape ``[F, 3, 2]``."""
    wrap: tuple[str, str] = ("repeat", "repeat")
    """What is right of and below the picture: a key of `WRAPS`."""
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Linear sRGB, 0…1, which the picture is multiplied with."""

    @property
    def path(self) -> str:
        """File of the picture in the folder of a scene, by its content."""
        end = "png" if self.image.startswith(b"\x89PNG") else "jpg"
        return f"textures/{hashlib.sha256(self.image).hexdigest()[:16]}.{end}"

    def part(self, faces: Int64Array) -> Texture:
        """The same of some of the triangles, by their numbers."""
        return replace(self, uv=self.uv[faces])

    def described(self, name: str) -> dict[str, Any]:
        """What ``scene.json`` says of it.

        Args:
            name: Of the piece.
        """
        return {"image": self.path, "uv": f"meshes/{name}.uv", "wrap": self.wrap, "tint": self.tint}

    def texels(self, faces: Int64Array, weights: Float64Array) -> UInt8Array:
        """Colours of points on triangles, sRGB without the tint, Shape ``[N, 3]``.

        Args:
            faces: Numbers of the triangles, Shape ``[N]``.
            weights: Barycentric coordinates in them, Shape ``[N, 3]``.
        """
        rgb = picture(self.image)
        places = np.einsum("nc,ncx->nx", weights, self.uv[faces])
        column, row = (
            np.minimum((WRAPS[wrap](place) * size).astype(np.int64), size - 1)
            for wrap, place, size in zip(self.wrap, places.T, rgb.shape[1::-1], strict=True)
        )
        colours: UInt8Array = rgb[row, column]
        return colours


@lru_cache(maxsize=8)
def picture(image: bytes) -> UInt8Array:
    """Decode a picture, sRGB of Shape ``[H, W, 3]``.

    Args:
        image: PNG or JPEG.

    Raises:
        AssetError: It is damaged, of another format or too large.
        SetupError: Pillow is not installed.
    """
    try:
        from PIL import Image
    except ImportError as error:
        raise SetupError(f"textures need Pillow; run: {install_command('scenes')}") from error
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with Image.open(io.BytesIO(image), formats=("PNG", "JPEG")) as opened:
                return np.array(opened.convert("RGB"))
    # Pillow lets a damaged picture show as any exception.
    except Exception as error:
        raise AssetError(f"{len(image)} bytes are no PNG or JPEG that can be read ({error})") from error
