"""Segmentation of pictures: class probabilities of pixels by a model of the user's, and materials of classes.

A segmenter has classes and one method. That of ONNX runs any model; what goes into it stands in a JSON file
beside it (`Card`). A table says which materials of ITU-R P.2040 a class stands for; those of ADE20K's 150
classes and of Cityscapes' 19 are in the folder ``classes``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal, Protocol

import msgspec
import numpy as np

from caviar_protocol.arrays import Float32Array, Float64Array, UInt8Array
from caviar_protocol.assets import ITU_MATERIALS
from caviar_protocol.errors import AssetError, SetupError, suggestion
from caviar_protocol.host import install_command
from caviar_scenes.views import read_table

TABLES = ("ade20k", "cityscapes")
"""Tables of classes that there are."""


class Segmenter(Protocol):
    """Model that says of which class pixels are."""

    @property
    def classes(self) -> Sequence[str]:
        """Names of the classes."""

    def segment(self, rgb: UInt8Array) -> Float32Array:
        """Segment a picture.

        Args:
            rgb: sRGB, Shape ``[H, W, 3]``.

        Returns:
            Probability of each class, Shape ``[H, W, C]``.
        """


class Card(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Facts of a segmentation model that its file does not have: ``MODEL.json`` beside ``MODEL.onnx``."""

    classes: tuple[str, ...] | Literal["ade20k", "cityscapes"]
    """In the order of the model's output, or the name of a table, whose order is taken."""
    materials: Mapping[str, str] = {}
    """Materials by class, as in a table; classes that are not here have those of the named table, or none."""
    layout: Literal["NCHW", "NHWC"] = "NCHW"
    dtype: Literal["float32", "uint8"] = "float32"
    """``uint8``: the model takes pictures as they are, 0…255."""
    mean: tuple[float, float, float] = (0.485, 0.456, 0.406)
    """Of red, green and blue, 0…1; subtracted first."""
    std: tuple[float, float, float] = (0.229, 0.224, 0.225)
    """What the difference is divided by."""
    width: Annotated[int, msgspec.Meta(ge=0)] = 0
    """To which pictures are scaled [px]; 0: as they are."""
    height: Annotated[int, msgspec.Meta(ge=0)] = 0
    """Likewise; 0: in proportion to the width."""
    multiple: Annotated[int, msgspec.Meta(ge=1)] = 1
    """Of which width and height are multiples [px]."""
    output: Literal["logits", "probabilities"] = "logits"


class OnnxSegmenter:
    """A model in an ONNX file.

    Args:
        file: The model; its card stands beside it, with the ending ``.json``.

    Raises:
        AssetError: The model or its card is missing or wrong.
        SetupError: ONNX Runtime or Pillow is not installed.
    """

    def __init__(self, file: Path) -> None:
        try:
            import onnxruntime
            import PIL  # noqa: F401
        except ImportError as error:
            raise SetupError(
                f"segmentation needs {error.name}; run: {install_command('policy', 'formats')}"
            ) from error
        self._file, beside = file, file.with_suffix(".json")
        try:
            self.card = msgspec.json.decode(beside.read_bytes(), type=Card)
        except OSError as error:
            raise AssetError(
                f"{beside} cannot be read ({error.strerror}); write what the model takes there: "
                '{"classes": ["road", …], "width": 512, …}'
            ) from error
        except (msgspec.DecodeError, msgspec.ValidationError) as error:
            raise AssetError(f"{beside}: {error}") from error
        if not self.card.classes or min(self.card.std) <= 0:
            raise AssetError(f"{beside}: classes is empty, or a std is not above 0; correct it")
        named = self.card.classes if isinstance(self.card.classes, str) else ""
        known = class_materials(named) if named else {}
        self._classes = tuple(known) if named else tuple(self.card.classes)
        self.materials = {name: known.get(name, {}) for name in self._classes}
        """Shares of materials by class, where the card has them."""
        for name, text in self.card.materials.items():
            if name not in self._classes:
                raise AssetError(f"{beside}: materials.{name}: {suggestion(name, self._classes)}")
            self.materials[name] = _shares(f"{beside}: materials.{name}", text)
        try:
            self._session = onnxruntime.InferenceSession(str(file), providers=["CPUExecutionProvider"])
        except Exception as error:  # ONNX Runtime has several classes of errors, none of them public
            raise AssetError(f"{file} is no ONNX model that can be run: {str(error)[:200]}") from error
        inputs = self._session.get_inputs()
        if len(inputs) != 1:
            raise AssetError(f"{file} takes {len(inputs)} inputs; a segmenter takes one, the picture")
        self._input = inputs[0].name

    @property
    def classes(self) -> Sequence[str]:
        """See `Segmenter.classes`."""
        return self._classes

    def segment(self, rgb: UInt8Array) -> Float32Array:
        """See `Segmenter.segment`; `AssetError` where the model's output is not what the card says."""
        from PIL import Image

        card, (height, width) = self.card, rgb.shape[:2]
        if not rgb.size:
            raise AssetError("a picture without pixels cannot be segmented; leave it out")
        wide = card.width or width
        high = card.height or round(wide * height / width)
        wide, high = (max(1, round(side / card.multiple)) * card.multiple for side in (wide, high))
        size = wide, high
        picture = np.array(Image.fromarray(rgb).resize(size, Image.Resampling.BILINEAR))
        given: Any = picture
        if card.dtype == "float32":
            given = ((picture / 255.0 - card.mean) / card.std).astype(np.float32)
        if card.layout == "NCHW":
            given = np.ascontiguousarray(given.transpose(2, 0, 1))
        try:
            (found, *_) = self._session.run(None, {self._input: given[None]})
        except Exception as error:  # see `__init__`
            raise AssetError(
                f"{self._file} does not take a picture of {size[0]} × {size[1]}: {str(error)[:200]}; correct "
                f"its card {self._file.with_suffix('.json').name}"
            ) from error
        if found.ndim != 4 or found.shape[:2] != (1, len(self._classes)) or not found.size:
            raise AssetError(
                f"{self._file} gives an array of shape {list(found.shape)}, and the card has "
                f"{len(self._classes)} classes; expected is [1, {len(self._classes)}, height, width]"
            )
        found = found[0].astype(np.float32)
        if not np.isfinite(found).all():
            raise AssetError(f"{self._file} gives values that are no number; correct its card or the model")
        if card.output == "logits":
            found = np.exp(found - found.max(0))
        found = np.clip(found, 0.0, None)
        planes = [
            Image.fromarray(plane).resize((width, height), Image.Resampling.BILINEAR) for plane in found
        ]
        share = np.stack([np.array(plane) for plane in planes], axis=-1)
        total = np.maximum(share.sum(-1, keepdims=True), 1e-12)
        result: Float32Array = (share / total).astype(np.float32)
        return result


def class_materials(table: str | Path) -> dict[str, dict[str, float]]:
    """Read a table of classes: share of each material by class, in its order.

    Args:
        table: One of `TABLES`, or a CSV with the columns ``class`` and ``materials``: ``brick``, or
            ``brick 0.6 glass 0.4``; empty for what is of no material, such as the sky.

    Raises:
        AssetError: The table is missing or wrong; names line and value.
    """
    if isinstance(table, str) and table in TABLES:
        text, file = (
            (resources.files(__package__) / "classes" / f"{table}.csv").read_text("utf-8"),
            Path(table),
        )
    else:
        file = Path(table)
        try:
            text = file.read_text("utf-8-sig")
        except (OSError, UnicodeDecodeError) as error:
            raise AssetError(f"cannot read the table of classes {file}: {error}") from error
    found = {}
    for line, row in read_table(file, text, ("class", "materials")):
        if row["class"] in found:
            raise AssetError(f"{file}:{line}: class {row['class']!r} is there twice; leave one out")
        found[row["class"]] = _shares(f"{file}:{line}", row["materials"])
    if not found:
        raise AssetError(f"{file} has no classes; write one a line: brick wall,brick")
    return found


def _shares(place: str, text: str) -> dict[str, float]:
    words = text.split()
    if len(words) == 1:
        words.append("1")
    shares: dict[str, float] = {}
    for material, word in zip(words[::2], [*words[1::2], ""][: len(words[::2])], strict=True):
        try:
            share = float(word)
        except ValueError:
            share = -1.0
        if material not in ITU_MATERIALS:
            raise AssetError(
                f"{place}: ITU-R P.2040 has no material {material!r}; {suggestion(material, ITU_MATERIALS)}"
            )
        if not 0 < share <= 1:
            raise AssetError(f"{place}: share {word!r} of {material}; write pairs: brick 0.6 glass 0.4")
        shares[material] = share
    return shares


def material_matrix(
    classes: Sequence[str], table: Mapping[str, Mapping[str, float]], called: str
) -> tuple[tuple[str, ...], Float64Array]:
    """Shares of materials in classes.

    Args:
        classes: Of a segmenter.
        table: Shares by class.
        called: What errors call the table.

    Returns:
        Names of the materials, sorted, and Shape ``[classes, materials]``; a row of zeros for no material.

    Raises:
        AssetError: A class is not in the table, or no class has a material.
    """
    lacking = [name for name in classes if name not in table]
    if lacking:
        raise AssetError(
            f"{called} has no class {lacking[0]!r} (of {len(lacking)}); {suggestion(lacking[0], table)}"
        )
    names = tuple(sorted({material for name in classes for material in table[name]}))
    if not names:
        raise AssetError(f"{called}: no class stands for a material; give some of them one")
    shares = np.array([[table[name].get(material, 0.0) for material in names] for name in classes])
    return names, shares / np.maximum(shares.sum(1, keepdims=True), 1.0)
