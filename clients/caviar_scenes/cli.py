"""``caviar scene``: scenes are imported, checked, repaired, simplified, and looked at with their traffic."""

from __future__ import annotations

import math
import re
import shlex
import sys
from dataclasses import astuple
from importlib import resources
from pathlib import Path
from string import Template
from typing import TYPE_CHECKING, Annotated
from xml.etree import ElementTree

import msgspec
import typer
from rich.console import Console

from caviar_clients.cli.shared import print_line, progress_bar
from caviar_protocol.errors import AssetError
from caviar_scenes.materials_cli import app as materials_app
from caviar_scenes.materials_cli import calibrate_command

if TYPE_CHECKING:
    from caviar_space.imported_scenes import ImportedScene
    from caviar_space.mitsuba_xml import SceneryShape

app = typer.Typer()
app.add_typer(materials_app, name="materials")
app.command("calibrate")(calibrate_command)
TEMPLATE = "new/imported.toml"
"""The scenarios of an imported scene, in the package of scenarios."""


@app.callback()
def scenes() -> None:
    """Scenes: import, look, check, repair, simplify, picture."""


@app.command("import")
def import_command(
    path: Annotated[
        Path,
        typer.Argument(
            help="file or folder of another program; docs/howto/scenes has the formats",
            show_default=False,
        ),
    ],
    out: Annotated[Path, typer.Option(help="folder of the scene, which is made")],
    box: Annotated[
        str, typer.Option(help="W,S,E,N of what is taken, longitudes and latitudes [°]; by default all")
    ] = "",
    box_m: Annotated[
        str, typer.Option("--box-m", help="X0,Y0,X1,Y1 of what is taken, in the scene, in m; by default all")
    ] = "",
    form: Annotated[
        str, typer.Option("--format", help="format of the source; by default by the names of files")
    ] = "",
    material: Annotated[
        str, typer.Option(help="material of ITU-R P.2040 of what the source gives none")
    ] = "concrete",
    materials: Annotated[
        list[str] | None,
        typer.Option(help="NAME=MATERIAL: that of ITU-R P.2040 for a name of the source; several times"),
    ] = None,
    up: Annotated[
        str, typer.Option(help="y or z: axis that points up in meshes that do not say; by default z")
    ] = "z",
    lod: Annotated[
        str, typer.Option(help="level of detail, where there are several; by default the finest")
    ] = "",
    error_m: Annotated[
        float,
        typer.Option("--error-m", min=0.0, help="largest geometric error of tiles, in m; 0: the finest"),
    ] = 0.0,
    heights: Annotated[
        Path | None,
        typer.Option(help="heights of the ground, GeoTIFF or DTED; by default the ground of a map is level"),
    ] = None,
    origin: Annotated[
        str, typer.Option(help="LAT,LON of the scene's origin [°]; by default the source's, or its middle")
    ] = "",
    sumo: Annotated[
        Path | None,
        typer.Option(help="SUMO configuration, .sumocfg; by default the one in the project's folder"),
    ] = None,
    lidar: Annotated[
        str,
        typer.Option(
            help="X0,Y0,X1,Y1 of the grid of LIDARs beside the receivers, in m; by default no LIDAR"
        ),
    ] = "",
) -> None:
    """Import a scene: meshes, materials, roads of a map, or scenarios with a project's transmitters."""
    from rich.progress import TimeRemainingColumn

    from caviar_space.imported_scenes import Georeference, write_scene
    from caviar_space.sources import Request, read_source
    from caviar_space.sources.road_network import NET

    console = Console()
    with progress_bar(Console(stderr=True), TimeRemainingColumn(), transient=True) as bar:
        task = bar.add_task(path.name, total=1.0)
        latitude, longitude = _numbers("--origin", origin, 2, "LAT,LON [°]: 60.17,24.94") or (0.0, 0.0)
        if not (abs(latitude) <= 90 and abs(longitude) <= 180):
            raise AssetError(f"--origin {origin}: beyond 90° and 180°; write LAT,LON [°]: 60.17,24.94")
        request = Request(
            box_deg=_box("--box", box, "W,S,E,N [°]: 24.93,60.16,24.95,60.18"),
            box_m=_box("--box-m", box_m, "X0,Y0,X1,Y1 [m]: -300,-300,300,300"),
            origin=Georeference(latitude_deg=latitude, longitude_deg=longitude) if origin else None,
            heights=heights,
            material=material,
            materials=_named_materials(materials or [], material),
            up="y" if up == "y" else "z",
            lod=lod,
            error_m=error_m,
            progress=lambda name, share: bar.update(task, description=name, completed=share),
        )
        if up not in ("y", "z"):
            raise AssetError(f"--up {up}: write y or z")
        if box and box_m:
            raise AssetError("--box and --box-m both say what is taken; write one of them")
        scene = read_source(path, request, form)
    of_project = scene.transmitters_m or scene.receivers_m or scene.frequencies_hz or sumo
    more = _scenarios(scene, path, sumo, lidar) if of_project else {}
    write_scene(scene, out, more)
    for note in scene.notes:
        print_line(console, f"note: {note}")
    kinds = [piece.kind for piece in scene.pieces.values()]
    counted = ", ".join(f"{kinds.count(kind)} {kind}" for kind in dict.fromkeys(kinds))
    print_line(console, f"{out}: {counted}; {len(scene.transmitters_m)} TX, {len(scene.receivers_m)} RX")
    for name in more:
        if name.endswith(".toml"):
            print_line(
                console, f"{out / name} is a scenario; run it with: caviar run {shlex.quote(str(out / name))}"
            )
    if NET in scene.files:
        print_line(
            console,
            f"{out / NET} has its roads; a scenario on them: caviar new NAME --scene {shlex.quote(str(out))}",
        )


def _numbers(option: str, text: str, count: int, example: str) -> tuple[float, ...]:
    """Numbers of an option with commas between them; none: it is empty."""
    if not text:
        return ()
    try:
        found = tuple(float(word) for word in text.split(","))
    except ValueError:
        found = ()
    if len(found) != count or not all(map(math.isfinite, found)):
        raise AssetError(f"{option} {text}: write {example}")
    return found


def _box(option: str, text: str, example: str) -> tuple[float, float, float, float] | None:
    if not text:
        return None
    x0, y0, x1, y1 = _numbers(option, text, 4, example)
    if not (x0 < x1 and y0 < y1):
        raise AssetError(f"{option} {text}: the lower corner comes first; write {example}")
    if "°" in example and not (x0 >= -180 and x1 <= 180 and y0 >= -90 and y1 <= 90):
        raise AssetError(f"{option} {text}: beyond 180° and 90°; write {example}")
    return x0, y0, x1, y1


def _named_materials(given: list[str], default: str) -> dict[str, str]:
    """Materials of ITU-R P.2040 by the source's names for them; each is looked up, and the default."""
    from caviar_protocol.errors import suggestion
    from caviar_space.mitsuba_xml import ITU_MATERIALS

    pairs = [text.partition("=") for text in given]
    for name, sign, value in [("", "=", default), *pairs]:
        if not sign or value not in ITU_MATERIALS:
            raise AssetError(
                f"{f'--materials {name}{sign}' if name else '--material '}{value}: ITU-R P.2040 has no "
                f"material {value!r}; write NAME=MATERIAL; {suggestion(value, ITU_MATERIALS)}"
            )
    return {name: value for name, _, value in pairs}


SceneArgument = Annotated[
    str,
    typer.Argument(help="folder of an imported scene, XML, sionna:NAME, or scenario", show_default=False),
]


@app.command("check")
def check_command(
    scene: SceneArgument,
    thin_m: Annotated[
        float, typer.Option("--thin-m", min=0.0, help="closed bodies up to this thickness are walls, in m")
    ] = 0.5,
    as_json: Annotated[bool, typer.Option("--json", help="print all faults, each with its place")] = False,
) -> None:
    """Check a scene for faults that rays meet; status 1 where received powers are wrong by one."""
    from collections import Counter

    from rich.table import Column, Table

    from caviar_scenes.checks import KINDS, check
    from caviar_scenes.opened import open_scene

    opened = open_scene(scene)
    faults = check(opened, thin_m)
    counts = Counter(fault.kind for fault in faults)
    wrong = [kind for kind in counts if KINDS[kind].wrong]
    if as_json:
        sys.stdout.write(
            msgspec.json.encode({"scene": opened.name, "wrong": wrong, "faults": faults}).decode()
        )
        sys.stdout.write("\n")
        raise typer.Exit(bool(wrong))
    console = Console()
    table = Table(
        "fault", "count", Column("where (first three), in m", overflow="fold"), "effect on rays", "remedy"
    )
    for kind, count in counts.items():
        where = [
            f"{fault.piece} {fault.place}{f': {fault.note}' if fault.note else ''}"
            for fault in [fault for fault in faults if fault.kind == kind][:3]
        ]
        table.add_row(kind, str(count), "\n".join(where), KINDS[kind].effect, KINDS[kind].remedy)
    triangles = sum(len(mesh.faces) for mesh in opened.meshes.values())
    print_line(console, f"{opened.name}: {len(opened.meshes)} pieces, {triangles} triangles")
    if counts:
        console.print(table)
    print_line(
        console,
        f"received powers are wrong by: {', '.join(wrong)}"
        if wrong
        else f"{len(faults)} faults, none of which makes received powers wrong",
    )
    raise typer.Exit(bool(wrong))


@app.command("repair")
def repair_command(
    scene: SceneArgument,
    out: Annotated[Path, typer.Option(help="folder of the repaired scene, which is made")],
    thin_m: Annotated[
        float,
        typer.Option("--thin-m", min=0.0, help="closed plates up to this become sheets, in m; 0: none"),
    ] = 0.5,
    union: Annotated[
        bool, typer.Option("--union", help="unite closed bodies of one material that overlap")
    ] = False,
) -> None:
    """Repair a scene: weld, drop slivers and duplicates, turn bodies, fold walls; print what changed."""
    from rich.table import Column, Table

    from caviar_scenes.opened import open_scene, write_changed
    from caviar_scenes.repairs import repair

    opened, console = open_scene(scene), Console()
    done, changes = repair(opened, thin_m, union)
    said = f"repaired by caviar scene repair: {len(changes)} pieces changed"
    write_changed(opened, done, out, {}, said)
    table = Table(Column("piece", overflow="fold"), "triangles", "area m²", "volume m³", "what")
    for change in changes:
        before, after = change.before, change.after
        pairs = zip(astuple(before), astuple(after), strict=True)
        table.add_row(change.piece, *(f"{a:.6g} → {b:.6g}" for a, b in pairs), ", ".join(change.what))
    if changes:
        console.print(table)
    print_line(
        console, f"{out}: {len(changes)} of {len(opened.meshes)} pieces changed; materials as they were"
    )


@app.command("simplify")
def simplify_command(
    scenario: Annotated[
        str, typer.Argument(help="scenario with a ray-traced channel, by name or file", show_default=False)
    ],
    out: Annotated[Path, typer.Option(help="folder of the simplified scene, which is made")],
    error_db: Annotated[
        float,
        typer.Option("--error-db", min=0.0, help="error of received power at 9 of 10 positions, in dB"),
    ] = 0.5,
    positions: Annotated[
        int, typer.Option(min=4, help="frames at which devices are looked at; half choose, half are held out")
    ] = 100,
) -> None:
    """Simplify a scenario's scenery: fewer triangles, at a stated error of the power its devices receive."""
    from rich.progress import TimeRemainingColumn

    from caviar_scenes.simplification import simplify

    console = Console()
    with progress_bar(Console(stderr=True), TimeRemainingColumn(), transient=True) as bar:
        task = bar.add_task("world", total=1.0)
        found = simplify(
            scenario,
            error_db,
            out,
            positions,
            lambda name, share: bar.update(task, description=name, completed=share),
        )
    error, left = found.held_out, found.reduction
    (triangles, fewer), (pieces, kept), (ms, faster) = found.triangles, found.pieces, found.frame_ms
    print_line(console, f"triangles: {triangles} → {fewer}, pieces: {pieces} → {kept}")
    print_line(console, f"left out: what only detours above {left.detour_m:.0f} m meet, parts below "
               f"{left.smallest_m:g} m; triangles merged within {left.tolerance_m:g} m")  # fmt: skip
    print_line(console, f"error at {error.users} users of {found.positions[1]} frames held out: median "
               f"{error.median_db:.3f}, 90 % {error.p90_db:.3f}, most {error.max_db:.3f} dB")  # fmt: skip
    print_line(console, f"frame of the channel: {ms:.0f} → {faster:.0f} ms of processor time")
    print_line(console, f'{out}: simplified.json, and a scene to use: scenery = "file:{out}/scene.xml"')


@app.command("look")
def look_command(
    scene: SceneArgument,
    out: Annotated[Path | None, typer.Option(help="PNG that is written; by default none")] = None,
) -> None:
    """Look at a scene: extent, place on the Earth, materials with their frequencies, faults; a picture."""
    from collections import Counter

    from rich.table import Table

    from caviar_scenes.checks import check
    from caviar_scenes.look import draw, look
    from caviar_scenes.opened import open_scene

    opened, console = open_scene(scene), Console()
    seen = look(opened)
    for line in seen.lines:
        print_line(console, line)
    table = Table("material", "pieces", "triangles", "area m²", "thickness m", "ITU-R P.2040 defines it for")
    for row in seen.materials:
        table.add_row(*row)
    console.print(table)
    counts = Counter(fault.kind for fault in check(opened))
    said = ", ".join(f"{count} {kind}" for kind, count in counts.items())
    print_line(console, f"faults: {said or 'none'}" + "; see caviar scene check" * bool(said))
    if out is not None:
        draw(opened, out)
        print_line(console, f"picture: {out}")


@app.command("picture")
def picture_command(
    scenario: Annotated[Path, typer.Argument(help="scenario with traffic by SUMO, by name or file")],
    out: Annotated[Path, typer.Option(help="PNG that is written")] = Path("scene.png"),
    frames: Annotated[int, typer.Option(min=1, help="frames of traffic, of which the last is drawn")] = 100,
) -> None:
    """Draw a scene from above: materials, lanes and traffic; count vehicles below roofs over all frames."""
    from caviar_clients.plots.map import MapData, draw_site
    from caviar_clients.plots.rays import covered_objects, footprints, lanes_of
    from caviar_clients.session.prepared import prepare
    from caviar_clients.session.scenes import simulated_scenes
    from caviar_protocol.scenario import load_scenario
    from caviar_protocol.scenario.rules import with_overrides
    from caviar_space.materials import ObjectMaterials
    from caviar_space.mitsuba_xml import find_scenery, read_scenery

    found = simulated_scenes(scenario, prepare(with_overrides(load_scenario(scenario), frames=frames)))
    description = find_scenery(found.assets)
    channel = next((spec.settings for spec in found.services.values() if spec.role == "channel"), {})
    foliage = ObjectMaterials({key: key for key in channel.get("foliage", {})})
    by_label: dict[str, list[SceneryShape]] = {}
    for shape in read_scenery(description).shapes if description else ():
        what = "foliage" if foliage.material_for(shape.name) else _material_label(shape)
        by_label.setdefault(what, []).append(shape)
    drawn = {
        label: footprints((shape.file, shape.to_world) for shape in shapes)
        for label, shapes in by_label.items()
    }
    traffic = next(
        (s.settings for s in found.services.values() if s.role == "world" and "net" in s.settings), {}
    )
    lanes = (
        lanes_of(Path(traffic["net"]), traffic.get("offset_m", (0, 0, 0)), traffic.get("yaw_deg", 0.0))
        if traffic
        else []
    )
    last = found.instants[-1].scene
    draw_site(
        MapData(last, None, None, None, None, None, f"{found.name}, frame {frames - 1}"), drawn, lanes, out
    )
    names: set[str] = set()
    seen, below = 0, dict[str, int]()
    for instant in found.instants:
        for name, count in covered_objects(
            instant.scene, [d for label, d in drawn.items() if label != "foliage"]
        ):
            names.add(name)
            seen += 1
            if count:
                below[name] = below.get(name, 0) + 1
    console = Console()
    print_line(console, f"{out}: {len(drawn)} materials, {len(lanes)} lanes, {len(last.names)} objects")
    print_line(
        console,
        f"{len(names)} objects in {len(found.instants)} frames, {seen} positions: "
        f"{sum(below.values())} below a roof{': ' + ', '.join(sorted(below)[:5]) if below else ''}",
    )


def _material_label(shape: SceneryShape) -> str:
    """Name of a material with its constants for radio waves."""
    given = dict(re.findall(r'name="(\w+)" value="([^"]+)"', shape.radio.xml)) if shape.radio else {}
    known = {
        "relative_permittivity": "ε {}",
        "conductivity": "σ {} S/m",
        "thickness": "{} m",
        "type": "ITU {}",
    }
    said = ", ".join(text.format(given[key]) for key, text in known.items() if key in given)
    return f"{shape.material or 'no material'} ({said})" if said else shape.material


def _scenarios(scene: ImportedScene, path: Path, sumo: Path | None, lidar: str) -> dict[str, bytes]:
    """Content of the scenarios ``mobile.toml`` and ``fixed.toml``, and of SUMO's files, by path.

    Raises:
        AssetError: A file of SUMO is missing or wrong.
    """
    folder = path if path.is_dir() else path.parent
    found = [sumo] if sumo else sorted(folder.rglob("*.sumocfg"))
    if len(found) > 1:
        raise AssetError(f"{folder} has {len(found)} .sumocfg; name one with --sumo {found[0]}")
    if not found or not scene.transmitters_m or not scene.frequencies_hz:
        lacking = [
            what
            for what, there in (
                ("a SUMO configuration (--sumo)", found),
                ("transmitters (.txrx)", scene.transmitters_m),
                ("frequencies (.study.xml)", scene.frequencies_hz),
            )
            if not there
        ]
        scene.notes.append(f"no scenario is written: the project lacks {', '.join(lacking)}")
        return {}
    files, settings = _traffic(found[0])
    carriers = [f"{frequency / 1e9:g}GHz" for frequency in scene.frequencies_hz]
    grid = _grid(lidar)
    foliage = ""
    if any(piece.kind == "foliage" for piece in scene.pieces.values()):
        if scene.without_foliage_loss:
            values = 'attenuation_db_per_m = { "*" = 0.0 }\nsource = "FoliageModel None of the study"\n'
        else:
            values = (
                '# attenuation_db_per_m = { … }, source = "…": see the Foliage section of topics/channel\n'
            )
        foliage = f'[services.channel.settings.foliage."foliage-*"]\n{values}\n'
    common = {
        **settings,
        "command": " ".join(shlex.join(["caviar", *sys.argv[1:]]).split()),
        "carriers": "".join(
            f'[[carriers]]\nname = "{name}"\nfrequency_hz = {frequency:.15g}\nbandwidth_hz = 100e6\n\n'
            for name, frequency in zip(carriers, scene.frequencies_hz, strict=True)
        ),
        "foliage": foliage,
    }
    mounted = {"on": "vehicle.*", "count": 10, "mount": "roof"}
    transmitters = [
        {
            "name": f"tx{number or ''}",
            "role": "tx",
            "position_m": list(place),
            "yaw_deg": 90.0,
            "power_dbm": 0.0,
        }
        for number, place in enumerate(scene.transmitters_m)
    ]
    # The row of elements lies along the vehicle.
    on_vehicles = {"name": "rx", "role": "rx", **mounted, "position_m": [0.0, 0.0, 0.1], "yaw_deg": -90.0}
    standing = [
        {"name": f"rx{number}", "role": "rx", "position_m": list(place)}
        for number, place in enumerate(scene.receivers_m)
    ]
    rx_elements = {"array": {"columns": 8}}
    made: dict[str, bytes] = {f"sumo/{name}": content for name, content in files.items()}
    for name, elements, receivers in (("mobile", 32, [on_vehicles]), ("fixed", 64, standing)):
        if not receivers:
            continue
        devices = [{**tx, "kind": "antenna", "array": {"columns": elements}} for tx in transmitters]
        devices += [{**rx, "kind": "antenna", **rx_elements} for rx in receivers]
        with_lidar = grid and name == "mobile"
        if with_lidar:
            scanner = {
                "beams": 32,
                "azimuth_steps": 900,
                "elevation_deg": [-25.0, 3.0],
                "range_m": [0.5, 100.0],
            }
            devices.append(
                {"name": "lidar", "kind": "lidar", **mounted, "position_m": [0.0, 0.0, 0.5], **scanner}
            )
        what = "ten vehicles with receivers" if name == "mobile" else f"{len(standing)} receivers that stand"
        made[f"{name}.toml"] = _filled(
            {
                **common,
                "title": f"Scene {scene.name} with SUMO's traffic and {what}",
                "name": f"{scene.name}-{name}",
                "frames": "1" if name == "mobile" else "20",
                "period": "1_000_000_000" if name == "mobile" else "500_000_000",
                "lidar_topic": '"lidar.grid", ' if with_lidar else "",
                "lidar_service": grid if with_lidar else "",
                "devices": "\n".join(
                    "[[devices]]\n" + "".join(f"{key} = {_toml(value)}\n" for key, value in device.items())
                    for device in devices
                ),
            }
        )
    return made


def _filled(values: dict[str, str]) -> bytes:
    text = (resources.files("caviar_scenarios") / TEMPLATE).read_text()
    return Template(text).substitute(values).encode()


def _toml(value: object) -> str:
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {_toml(item)}" for key, item in value.items()) + " }"
    return msgspec.json.encode(value).decode()


def _grid(lidar: str) -> str:
    """Service of LIDARs with a grid of 20 by 200 by 10 cells, the longer axis with more; empty: none."""
    area = _box("--lidar", lidar, "X0,Y0,X1,Y1 [m], the lower corner first: 744,429,767,679")
    if area is None:
        return ""
    x0, y0, x1, y1 = area
    cells = [20, 200, 10] if x1 - x0 < y1 - y0 else [200, 20, 10]
    grid = f"{{ minimum_m = [{x0}, {y0}, 0.0], maximum_m = [{x1}, {y1}, 10.0], cells = {cells} }}"
    return (
        '[services.lidar]\nrole = "sensors"\nuse = "lidar"\nbudget_ms = 150\n\n'
        f"[services.lidar.settings]\npoints_every = 0  # the grid alone\ngrid = {grid}\n"
    )


def _traffic(config: Path) -> tuple[dict[str, bytes], dict[str, str]]:
    """SUMO's files by name, and the settings of the world, of a configuration."""
    from caviar_space.meshes import SHAPES

    def parsed(file: Path) -> tuple[bytes, ElementTree.Element]:
        try:
            data = file.read_bytes()
            return data, ElementTree.fromstring(data)  # noqa: S314 - expat bounds what entities expand to
        except OSError as error:
            raise AssetError(f"cannot read {file}: {error.strerror}; named by {config}") from error
        except ElementTree.ParseError as error:
            raise AssetError(f"{file}:{error.position[0]}: {error}; mend the XML") from error

    files: dict[str, bytes] = {}
    roots: dict[str, list[ElementTree.Element]] = {}
    names: dict[str, list[str]] = {"net-file": [], "route-files": [], "additional-files": []}
    _, root = parsed(config)
    for key, found in names.items():
        for name in (part.strip() for each in root.iter(key) for part in each.get("value", "").split(",")):
            if name:
                files[Path(name).name], element = parsed(config.parent / name)
                roots.setdefault(key, []).append(element)
                found.append(f"file:sumo/{Path(name).name}")
    if len(names["net-file"]) != 1 or not names["route-files"]:
        raise AssetError(f"{config} names {len(names['net-file'])} net-file and {len(names['route-files'])} "
                         "route-files; write one net-file, and route-files")  # fmt: skip
    location = roots["net-file"][0].find("location")
    offset = "" if location is None else location.get("netOffset", "")
    try:
        x, y = (-float(word) + 0.0 for word in offset.split(","))
    except ValueError:
        x = y = math.nan
    if not math.isfinite(x + y):
        net = config.parent / names["net-file"][0].removeprefix("file:sumo/")
        raise AssetError(f"{net}: <location> has the netOffset {offset!r}; write x,y in metres")
    kinds = {
        kind.get("id", ""): kind.get("id", "").lower()
        for element in roots["route-files"] + roots.get("additional-files", [])
        for kind in element.iter("vType")
        if kind.get("id", "").lower() in SHAPES
    }
    additional, classes = names["additional-files"], ", ".join(f'"{k}" = "{v}"' for k, v in kinds.items())
    return files, {
        "net": _toml(names["net-file"][0]),
        "routes": _toml(names["route-files"]),
        "additional": f"additional = {_toml(additional)}\n" if additional else "",
        "classes": f"classes = {{ {classes} }}" if classes else "",
        "offset": f"{x!r}, {y!r}",
    }
