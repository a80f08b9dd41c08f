"""Materials of a scene's faces from pictures: classes of pixels, taken back to the faces that pixels see.

Class probabilities become those of materials (`segmentation.material_matrix`). The logarithms of what the
pixels of a face say in one view are averaged, with the weight of what of a pixel is of any material, since
neighbouring pixels err together; they count the more, the more pixels there are, at most as one independent
observation. These are summed over views, with a prior. Faces of one wall (coplanar, with a common edge) then
draw each other to their materials by mean-field steps of a Potts model, weighted by the length of the common
edge, so that small or unseen faces follow the wall they are in, and a wall of two materials stays one of two.

The result is a table of text, ``materials.csv``: piece, faces, material, confidence, views and source. It can
be looked at, corrected by hand, and applied again.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array
from caviar_protocol.assets import ITU_MATERIALS
from caviar_protocol.errors import AssetError, suggestion
from caviar_scenes.opened import open_scene, texture_files
from caviar_scenes.segmentation import Segmenter, material_matrix
from caviar_scenes.views import Eye, Picture, read_table
from caviar_space.imported_scenes import ImportedScene, Piece
from caviar_space.meshes import Mesh
from caviar_space.mitsuba_xml import RadioMaterial, SceneryShape
from caviar_space.sources.pieces import beside, contents, reading
from caviar_space.textures import WRAPS, Texture
from caviar_space.textures import picture as decoded

NAME = "materials.csv"
"""Name of the table in the folder of a scene."""
COLUMNS = ("piece", "faces", "material", "confidence", "views", "source")
"""Of the table; ``faces`` are numbers and spans, ``0-11 14``, or ``*``: all that no other line names."""
FLOOR = 0.02
"""Least probability that a pixel gives a material: one wrong pixel does not rule out the right material."""
ENOUGH = 40.0
"""Pixels of a view that count as half of an independent observation."""
TOGETHER = 2.0
"""Weight of the neighbours in a wall, as the logarithm of a probability."""
FLAT = 0.999
"""Cosine of the angle between faces of one wall, at least."""


@dataclass(frozen=True, eq=False)
class Labels:
    """Materials of all faces of a scene, in the order of its pieces."""

    materials: tuple[str, ...]
    """Names that ``share`` is of."""
    share: Float64Array
    """Probability of each material, Shape ``[F, M]``."""
    views: Int64Array
    """Number of pictures that a face is seen in, Shape ``[F]``."""
    reached: BoolArray
    """Whether a picture sees a face, or others of its wall near it, Shape ``[F]``."""

    @property
    def best(self) -> list[str]:
        """Most probable material of each face."""
        return [self.materials[k] for k in self.share.argmax(1)]


def read_scene(given: str) -> ImportedScene:
    """Read a scene that may get other materials, with the other files of its folder.

    Args:
        given: Folder of a scene, Mitsuba XML, ``sionna:NAME``, or a scenario.

    Raises:
        AssetError: There is no such scene, or it is wrong.
        ScenarioError: The scenario is wrong.
    """
    found = open_scene(given)
    file, about = found.scenery.file, found.about
    scene = ImportedScene(name=found.name, origin=found.origin)
    for key in ("transmitters_m", "receivers_m", "frequencies_hz", "notes", "sources"):
        setattr(scene, key, list(about.get(key, ())))
    if about and file.stem == "scene":  # roads and scenarios of an imported scene
        others = [p for p in sorted(file.parent.rglob("*")) if p.is_file() and p.suffix != ".ply"]
        own = {"scene.xml", "scene.json", NAME, f"applied-{NAME}", *texture_files(about)}
        names = {str(path.relative_to(file.parent)): path for path in others}
        scene.files = {name: path.read_bytes() for name, path in names.items() if name not in own}
    for name, shape in found.shapes.items():
        material = shape.material or "none"
        known = about.get("pieces", {}).get(name, {})
        kind = "foliage" if name in found.foliage else str(known.get("kind", "object"))
        where, _, line = str(known.get("source", f"{file.name}:1")).rpartition(":")
        number = int(line) if line.isdigit() else 1
        texture = _texture(file, known.get("texture"), len(found.meshes[name].faces))
        scene.pieces[name] = Piece(found.meshes[name], material, kind, where, number, texture)
        scene.materials[material] = _radio_material(shape)
    return scene


def _texture(file: Path, given: dict[str, Any] | None, faces: int) -> Texture | None:
    """Texture of a piece, as `Texture.described` says it."""
    if given is None:
        return None
    with reading(file.with_suffix(".json"), f"what `caviar scene import` wrote, in {given}"):
        image, uv = (contents(beside(file.parent, given[key], file)) for key in ("image", "uv"))
        places = np.frombuffer(uv, "<f4").reshape(faces, 3, 2).astype(np.float64)
        if not np.isfinite(places).all():
            raise ValueError("a place in the picture is not finite")
        decoded(image)
        (right, down), (red, green, blue) = given["wrap"], map(float, given["tint"])
        _ = WRAPS[right], WRAPS[down]
        return Texture(image, places, (right, down), (red, green, blue))


def _radio_material(shape: SceneryShape) -> RadioMaterial:
    given = dict(re.findall(r'name="(\w+)" value="([^"]+)"', shape.radio.xml)) if shape.radio else {}
    constants = None
    if shape.radio and not shape.itu_material:
        constants = float(given.get("relative_permittivity", 1)), float(given.get("conductivity", 0))
    return RadioMaterial(
        itu_material=shape.itu_material if shape.radio else "",
        thickness_m=float(given.get("thickness", 0.1)),
        colour=shape.colour if shape.radio else shape.colour or (0.5, 0.5, 0.5),
        constants=constants,
        scattering_coefficient=float(given.get("scattering_coefficient", 0)),
        xpd_coefficient=float(given.get("xpd_coefficient", 0)),
    )


def label_faces(
    eye: Eye,
    pictures: Iterable[Picture],
    segmenter: Segmenter,
    table: Mapping[str, Mapping[str, float]],
    *,
    prior: Mapping[str, float] | None = None,
    called: str = "the table of classes",
    progress: Callable[[int], None] = lambda done: None,
) -> Labels:
    """Find the materials of faces.

    Args:
        eye: Sees the scene.
        pictures: Of the scene.
        segmenter: Says of which class pixels are.
        table: Shares of materials by class.
        prior: Weights of materials where nothing is known; by default all alike.
        called: What errors call the table.
        progress: Called with the number of pictures that are done.

    Raises:
        AssetError: A class is not in the table, or a picture cannot be read or segmented.
    """
    of_table, shares = material_matrix(segmenter.classes, table, called)
    names = tuple(sorted({*of_table, *(prior or {})}))
    wide = np.zeros((len(shares), len(names)))
    wide[:, [names.index(name) for name in of_table]] = shares
    weights = np.array([(prior or {}).get(name, 0.0 if prior else 1.0) for name in names]) + 1e-3
    faces = len(eye.mesh.faces)
    total = np.tile(np.log(weights / weights.sum()), (faces, 1))
    views = np.zeros(faces, np.int64)
    for done, picture in enumerate(pictures, 1):
        rgb = picture.rgb()
        share = np.asarray(segmenter.segment(rgb), np.float64)
        if share.shape != (*rgb.shape[:2], len(segmenter.classes)) or not np.isfinite(share).all():
            raise AssetError(
                f"{picture.file}: the segmenter gives {list(share.shape)}, or values that are no number; "
                f"expected is {[*rgb.shape[:2], len(segmenter.classes)]}"
            )
        seen = eye.look(picture.camera)
        met = seen.cosine > 0.05
        face, pixel = seen.face[met], share[met] @ wide
        of_any = pixel.sum(1)
        log = np.log(np.maximum(pixel / np.maximum(of_any, 1e-9)[:, None], FLOOR))
        count = np.bincount(face, of_any, faces)
        mean: Float64Array = np.stack([np.bincount(face, of_any * column, faces) for column in log.T], 1)
        mean = mean / np.maximum(count, 1e-9)[:, None]
        total += (count / (count + ENOUGH))[:, None] * mean * 2.0
        views += count > 1.0
        progress(done)
    one, other, weight = wall_neighbours(eye)
    smoothed, reached = _softmax(total), views > 0
    for _ in range(10):
        drawn = np.zeros_like(total)
        np.add.at(drawn, one, weight[:, None] * smoothed[other] * reached[other, None])
        smoothed = _softmax(total + TOGETHER * drawn)
        reached[one[reached[other]]] = True
    return Labels(names, smoothed, views, reached)


def _softmax(log: Float64Array) -> Float64Array:
    share = np.exp(log - log.max(1, keepdims=True))
    result: Float64Array = share / share.sum(1, keepdims=True)
    return result


def wall_neighbours(eye: Eye) -> tuple[Int64Array, Int64Array, Float64Array]:
    """Pairs of faces of one wall: of one piece, coplanar, with a common edge.

    Args:
        eye: The scene.

    Returns:
        First and second face of each pair, both ways, and the share of the common edge in the longest one of
        the first face; Shape ``[N]`` each.
    """
    faces = eye.mesh.faces.astype(np.int64)
    # Imported meshes repeat the corners of faces: what counts is where they are.
    _, place = np.unique(np.round(eye.mesh.vertices, 3), axis=0, return_inverse=True)
    corners = place.reshape(-1)[faces]
    edges = np.sort(corners[:, [[0, 1], [1, 2], [2, 0]]], axis=2).reshape(-1, 2)
    points = eye.mesh.vertices[faces]
    length = np.linalg.norm(points - np.roll(points, -1, axis=1), axis=2)
    face = np.repeat(np.arange(len(faces)), 3)
    order = np.lexsort((face, edges[:, 1], edges[:, 0]))
    same = (edges[order][1:] == edges[order][:-1]).all(1) & (face[order][1:] != face[order][:-1])
    a, b = order[:-1][same], order[1:][same]
    one, other = face[a], face[b]
    normal = eye.normals.astype(np.float64)
    flat = (np.abs((normal[one] * normal[other]).sum(1)) > FLAT) & (eye.owner[one] == eye.owner[other])
    one, other, shared = one[flat], other[flat], length.reshape(-1)[a[flat]]
    longest = length.max(1)
    both = np.concatenate([one, other]), np.concatenate([other, one])
    return *both, np.concatenate([shared, shared]) / longest[both[0]]


def chosen_materials(
    scene: ImportedScene, labels: Labels, threshold: float, prior: Mapping[str, float] | None = None
) -> tuple[dict[str, list[str]], BoolArray]:
    """Choose materials of faces: from pictures where these are sure, else those of the prior.

    Args:
        scene: In the order of whose pieces the labels are.
        labels: Of all faces.
        threshold: Least confidence; below, and where no picture sees a face or its wall, the prior counts.
        prior: Its most probable material; None: faces keep the material that they have.

    Returns:
        Material of each face by piece, empty where it keeps its own; where pictures decide, Shape ``[F]``.
    """
    sure = labels.reached & (labels.share.max(1) >= threshold)
    kept = max(prior, key=lambda key: prior[key]) if prior else ""
    pieces = scene.pieces.values()
    # Crowns of trees are volumes, whatever pictures show.
    sure &= np.repeat([piece.kind != "foliage" for piece in pieces], [len(p.mesh.faces) for p in pieces])
    of_all = [one if good else kept for one, good in zip(labels.best, sure.tolist(), strict=True)]
    ends = np.cumsum([0, *(len(piece.mesh.faces) for piece in scene.pieces.values())]).tolist()
    found = {name: of_all[a:b] for name, a, b in zip(scene.pieces, ends, ends[1:], strict=False)}
    for name, piece in scene.pieces.items():
        if piece.kind == "foliage":
            found[name] = [""] * len(found[name])
    return found, sure


def table_of(scene: ImportedScene, parts: Mapping[str, Int64Array], labels: Labels, sure: BoolArray) -> str:
    """Write the table of a scene's materials, one line a piece.

    Args:
        scene: With its materials.
        parts: What `with_materials` returned with it.
        labels, sure: Of all faces, as they were numbered before.
    """
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(COLUMNS)
    for name, piece in scene.pieces.items():
        faces = parts[name]
        mine = faces[sure[faces]]
        known = f"{labels.share[mine].max(1).mean():.3f}" if len(mine) else ""
        source = "pictures" if len(mine) == len(faces) else f"pictures {len(mine)} of {len(faces)} faces"
        views = int(np.median(labels.views[faces])) if len(faces) else 0
        writer.writerow([name, "*", piece.material, known, views, source if len(mine) else "prior"])
    return out.getvalue()


def read_materials(scene: ImportedScene, file: Path) -> dict[str, list[str]]:
    """Read the material of each face from a table, by name of the piece; empty: the face keeps its own.

    Args:
        scene: The scene that the table is for.
        file: The table.

    Raises:
        AssetError: A line names a piece, face or material that is not there, or a face twice.
    """
    try:
        text = file.read_text("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise AssetError(f"cannot read the table of materials {file}: {error}") from error
    found = {name: [""] * len(piece.mesh.faces) for name, piece in scene.pieces.items()}
    rest: dict[str, tuple[int, str]] = {}
    for line, row in read_table(file, text, COLUMNS[:3]):
        name, faces, material = row["piece"], row["faces"], row["material"]
        if name not in found:
            raise AssetError(f"{file}:{line}: the scene has no piece {name!r}; {suggestion(name, found)}")
        if material not in ITU_MATERIALS and material not in scene.materials:
            known = sorted({*ITU_MATERIALS, *scene.materials})
            raise AssetError(f"{file}:{line}: no material {material!r}; {suggestion(material, known)}")
        if faces == "*":
            if name in rest:
                raise AssetError(
                    f"{file}:{line}: line {rest[name][0]} has the other faces of {name!r} already"
                )
            rest[name] = line, material
            continue
        for span in faces.split() or [""]:
            match = re.fullmatch(r"(\d{1,9})(?:-(\d{1,9}))?", span)
            low = int(match[1]) if match else 1
            high = int(match[2] or low) if match else 0
            if not low <= high < len(found[name]):
                raise AssetError(
                    f"{file}:{line}: faces {span!r} of {name!r}; write numbers or spans of 0 to "
                    f"{len(found[name]) - 1}, or *"
                )
            for face in range(low, high + 1):
                if found[name][face]:
                    raise AssetError(
                        f"{file}:{line}: face {face} of {name!r} is in a line before; leave one out"
                    )
                found[name][face] = material
    for name, (_, material) in rest.items():
        found[name] = [one or material for one in found[name]]
    return found


def with_materials(
    scene: ImportedScene, of_faces: Mapping[str, Sequence[str]]
) -> tuple[ImportedScene, dict[str, Int64Array]]:
    """Give faces their materials; pieces of several become one piece a material.

    Args:
        scene: The scene; stays as it is.
        of_faces: Material of each face by piece: of the scene, or of ITU-R P.2040; empty: as it is.

    Returns:
        The scene, and by piece the numbers that its faces had among all faces.
    """
    made = replace(scene, pieces={}, materials=dict(scene.materials), notes=list(scene.notes))
    # The scene's own material of an ITU type stands for that, since it has its thickness.
    own = {m.itu_material: key for key, m in reversed(list(scene.materials.items())) if m.itu_material}
    parts: dict[str, Int64Array] = {}
    first = 0
    for name, piece in scene.pieces.items():
        count = len(piece.mesh.faces)
        given = [one or piece.material for one in of_faces.get(name, [""] * count)]
        wanted = np.array([one if one in scene.materials else own.get(one, one) for one in given], object)
        kinds = list(dict.fromkeys(wanted.tolist())) or [piece.material]
        for material in kinds:
            made.materials.setdefault(material, RadioMaterial(material))
            called = name
            while called in made.pieces or (len(kinds) > 1 and called in scene.pieces):
                called = f"{called}-{material}"
            faces = np.flatnonzero(wanted == material)
            mesh = piece.mesh if len(kinds) == 1 else _part(piece.mesh, faces)
            texture = piece.texture and piece.texture.part(faces)
            made.pieces[called] = replace(piece, mesh=mesh, material=material, texture=texture)
            parts[called] = first + faces
        first += count
    return made, parts


def _part(mesh: Mesh, which: Int64Array) -> Mesh:
    faces = mesh.faces[which]
    used, numbers = np.unique(faces, return_inverse=True)
    return Mesh(mesh.vertices[used], numbers.reshape(faces.shape).astype(np.int32))
