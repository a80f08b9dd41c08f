"""``caviar scene materials``: views of a scene, materials from pictures, corrections by hand."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from caviar_clients.cli.shared import print_line, progress_bar, require_known
from caviar_protocol.errors import AssetError

if TYPE_CHECKING:
    from caviar_space.imported_scenes import ImportedScene

app = typer.Typer(no_args_is_help=True, help="Materials from pictures: views, label, apply.")

SceneArgument = Annotated[
    str, typer.Argument(help="folder of a scene, its XML, or sionna:NAME", show_default=False)
]
Out = Annotated[Path, typer.Option(help="folder that is made")]


@app.command("views")
def views_command(
    scene: SceneArgument,
    out: Out,
    count: Annotated[int, typer.Option(min=1, max=1000, help="cameras, where none are given")] = 12,
    at: Annotated[
        list[str] | None,
        typer.Option(
            help="X,Y,Z,YAW or X,Y,Z,YAW,PITCH of a camera, in m and °; may be repeated; by default chosen"
        ),
    ] = None,
    size: Annotated[str, typer.Option(help="width and height, in px")] = "640x480",
    fov: Annotated[float, typer.Option(min=1, max=170, help="horizontal field of view [°]")] = 90.0,
) -> None:
    """Draw a scene from its streets and from above: pictures, their table, and faces and depths of pixels."""
    import numpy as np

    from caviar_scenes.materials import read_scene
    from caviar_scenes.views import TABLE, Eye, camera, pictures_table, save_picture, viewpoints
    from caviar_services.sensors.shading import MATERIALS, OTHER, linear

    found = read_scene(scene)
    sides = re.fullmatch(r"(\d{1,4})x(\d{1,4})", size)
    width, height = (int(sides[1]), int(sides[2])) if sides else (0, 0)
    if not (0 < width <= 8192 and 0 < height <= 8192):
        raise AssetError(f"--size {size}: write width and height from 1 to 8192, as 640x480")
    poses = []
    for text in at or ():
        try:
            x, y, z, yaw, pitch = [*(float(word) for word in text.split(",")), 0.0][:5]
        except ValueError as error:
            raise AssetError(f"--at {text}: write X,Y,Z,YAW or X,Y,Z,YAW,PITCH: 10,0,1.7,90") from error
        poses.append(((x, y, z), (yaw, pitch, 0.0)))
    eye = Eye({name: piece.mesh for name, piece in found.pieces.items()})
    cameras = [camera(f"view-{n:02d}", *pose, fov, (width, height)) for n, pose in enumerate(poses)]
    cameras = cameras or viewpoints(eye, count, (width, height), fov)
    colours = [
        material.colour or linear(MATERIALS.get(material.itu_material, OTHER)).tolist()
        for material in (found.materials[piece.material] for piece in found.pieces.values())
    ]
    textures = [piece.texture for piece in found.pieces.values()]
    _make(out)
    for device in cameras:
        seen = eye.look(device)
        drawn = eye.paint(device, np.array(colours), textures=textures)
        save_picture(out / f"{device.name}.png", drawn)
        np.savez_compressed(
            out / f"{device.name}.npz",
            face=seen.face.astype(np.int32),
            piece=seen.owner,
            depth=seen.depth,
            pieces=np.array(eye.names),
        )
    (out / TABLE).write_text(pictures_table({f"{device.name}.png": device for device in cameras}), "utf-8")
    print_line(Console(), f"{out / TABLE}: {len(cameras)} pictures of {len(found.pieces)} pieces")


@app.command("label")
def label_command(
    scene: SceneArgument,
    pictures: Annotated[Path, typer.Argument(help="table of pictures: file, place, turn, field of view")],
    model: Annotated[
        Path, typer.Option(help="ONNX model of segmentation; its card stands beside it (.json)")
    ],
    out: Out,
    table: Annotated[
        str, typer.Option(help="materials of classes: ade20k, cityscapes or a CSV; by default the card's")
    ] = "",
    threshold: Annotated[float, typer.Option(min=0, max=1, help="least confidence of a material")] = 0.5,
    prior: Annotated[
        str,
        typer.Option(
            help="weights of materials where nothing is seen, concrete=0.5,brick=0.3; by default all "
            "alike, and faces that nothing tells about keep their material"
        ),
    ] = "",
) -> None:
    """Find the materials of faces from pictures, and write the scene with them."""
    from caviar_scenes.materials import (
        NAME,
        chosen_materials,
        label_faces,
        read_scene,
        table_of,
        with_materials,
    )
    from caviar_scenes.segmentation import OnnxSegmenter, class_materials
    from caviar_scenes.views import Eye, read_pictures
    from caviar_space.imported_scenes import source_of, write_scene

    found, shots = read_scene(scene), read_pictures(pictures)
    segmenter = OnnxSegmenter(model)
    eye = Eye({name: piece.mesh for name, piece in found.pieces.items()})
    weights = _weights(prior) if prior else None
    with progress_bar(Console(stderr=True), transient=True) as bar:
        task = bar.add_task("pictures", total=len(shots))
        labels = label_faces(
            eye,
            shots,
            segmenter,
            class_materials(table) if table else segmenter.materials,
            prior=weights,
            called=table or f"the card of {model.name}",
            progress=lambda done: bar.update(task, completed=done),
        )
    of_faces, sure = chosen_materials(found, labels, threshold, weights)
    made, parts = with_materials(found, of_faces)
    seen = f"{int(sure.sum())} of {len(sure)} faces have their material from {len(shots)} pictures"
    made.notes.append(f"{seen}, by {model.name}; see {NAME}")
    made.sources = [*made.sources, source_of(model), source_of(pictures), *(source_of(s.file) for s in shots)]
    write_scene(made, out, {NAME: table_of(made, parts, labels, sure).encode()})
    _say(out, made, f"{seen}; {int((labels.views > 0).sum())} are seen")


@app.command("apply")
def apply_command(
    scene: SceneArgument,
    materials: Annotated[Path, typer.Argument(help="table of materials: piece, faces, material")],
    out: Out,
) -> None:
    """Give pieces and faces the materials of a table, and write the scene with them."""
    from caviar_scenes.materials import NAME, read_materials, read_scene, with_materials
    from caviar_space.imported_scenes import source_of, write_scene

    found = read_scene(scene)
    made, _ = with_materials(found, read_materials(found, materials))
    made.notes.append(f"materials of {materials.name} are applied")
    made.sources = [*made.sources, source_of(materials)]
    write_scene(made, out, {f"applied-{NAME}": materials.read_bytes()})
    _say(out, made, "")


def calibrate_command(
    scenario: Annotated[Path, typer.Argument(help="scenario whose channel traces rays, by name or file")],
    measurements: Annotated[
        Path, typer.Argument(help="CSV: x_m,y_m,z_m, and power_dbm, or re,im of the response; transmitter")
    ],
    materials: Annotated[str, typer.Option(help="names of the materials that are fitted: brick,glass")],
    noise_db: Annotated[
        float, typer.Option(min=0.001, help="standard deviation of a measurement, in dB")
    ] = 1.0,
    carrier: Annotated[str, typer.Option(help="name of the carrier; by default the first")] = "",
    out: Annotated[
        Path | None, typer.Option(help="TOML with the settings of the materials, for the scenario")
    ] = None,
) -> None:
    """Fit permittivity, conductivity and scattering of materials to measurements at known places."""
    from caviar_clients.files import write_file
    from caviar_clients.session.scenes import scene_at
    from caviar_scenes.calibration import calibrate, read_measurements, settings_text

    measured = read_measurements(measurements)
    if out:
        write_file(out)
    scenes = scene_at(scenario)
    names = [one.name for one in scenes.carriers]
    if carrier:
        require_known("--carrier", carrier, names)
    wanted = [name.strip() for name in materials.split(",")]
    found = calibrate(scenes, measured, wanted, noise_db, names.index(carrier) if carrier else 0)
    console = Console()
    unit = "dB" if measured.response is None else "of amplitude"
    print_line(
        console,
        f"{found.places} places, {found.without} without a path; residuals {found.before:.3g} before, "
        f"{found.after:.3g} after [{unit}]; fields agree with the channel's to {found.agreement:.1e}",
    )
    for one in found.parameters:
        value = f"{one.value:.4g} ({one.low:.4g} to {one.high:.4g})"
        print_line(
            console,
            f"{one.material}: {one.parameter} {value if one.identified else f'not identified: {one.why}'}",
        )
    if out:
        write_file(out, settings_text(found))
        print_line(console, out)


def _say(out: Path, made: ImportedScene, first: str) -> None:
    counts: dict[str, int] = {}
    for piece in made.pieces.values():
        counts[piece.material] = counts.get(piece.material, 0) + len(piece.mesh.faces)
    console = Console()
    if first:
        print_line(console, first)
    counted = ", ".join(
        f"{material} {count}" for material, count in sorted(counts.items(), key=lambda kv: -kv[1])
    )
    print_line(console, f"{out}: {len(made.pieces)} pieces; faces of {counted}")


def _weights(text: str) -> dict[str, float]:
    from caviar_protocol.assets import ITU_MATERIALS

    found = {}
    for word in text.split(","):
        name, _, value = word.partition("=")
        try:
            found[name.strip()] = float(value)
        except ValueError:
            found[name.strip()] = -1.0
        if name.strip() not in ITU_MATERIALS or not 0 < found[name.strip()] < float("inf"):
            raise AssetError(
                f"--prior {word}: write materials of ITU-R P.2040 with weights: concrete=0.5,brick=0.3"
            )
    return found


def _make(out: Path) -> None:
    if out.exists():
        raise AssetError(f"{out} is there already; name another folder, or remove it")
    try:
        out.mkdir(parents=True)
    except OSError as error:
        raise AssetError(f"cannot make {out}: {error.strerror}; choose another folder") from error
