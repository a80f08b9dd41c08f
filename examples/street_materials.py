"""Materials of streets from pictures: a network's labels on the model, and what they do to received power.

    python examples/street_materials.py segmentation.onnx [--streets 20] [--out materials]

Needs the extras ``channel``, ``policy``, ``plot`` and ``formats``. The network is that of
`train_segmentation.py`, or another one with its card. On streets that it was not trained on, with known
materials: share of pixels and faces that are right, and the error of the received power at 28 GHz, against
the model with true materials, of the labelled model, of one that is all of concrete, and of one in which
walls, roofs and grounds are each of the material that most of them have in other streets. Four figures show a
picture, its segmentation, the labels on the model, and the paths of rays in it.
"""

import argparse
import tempfile
from collections import Counter
from pathlib import Path

import numpy as np

from caviar_protocol.topics import AntennaDevice, Carrier, Interaction, Scene
from caviar_scenes.materials import label_faces, with_materials
from caviar_scenes.segmentation import OnnxSegmenter
from caviar_scenes.streets import MATERIALS, SKY, Street, street
from caviar_scenes.views import Picture, camera, viewpoints
from caviar_services.channel.sionna.model import SionnaChannel
from caviar_services.channel.sionna.settings import SionnaSettings
from caviar_services.service import Frame, Preparation, RunInfo
from caviar_space.imported_scenes import write_scene
from caviar_space.scenery import scenery_assets

CARRIER = Carrier(name="28GHz", frequency_hz=28e9)
COLOURS = np.array(
    [[170, 170, 170], [190, 80, 55], [80, 150, 220], [160, 115, 45], [130, 70, 170], [70, 70, 75],
     [95, 165, 60], [205, 225, 250]], np.uint8,
)  # fmt: skip
"""Of `MATERIALS`, and of the sky."""


def kind(normal: np.ndarray, name: str) -> str:
    return name if name in ("ground", "verge") else "roof" if abs(normal[2]) > 0.7 else "wall"


def faces(made: Street) -> list[tuple[str, str]]:
    """Kind and true material of each face."""
    names = [name for name in made.eye.names for _ in made.truth[name]]
    materials = [material for name in made.eye.names for material in made.truth[name]]
    normals = made.eye.normals
    return [(kind(n, name), material) for n, name, material in zip(normals, names, materials, strict=True)]


def usual(seeds: range) -> dict[str, str]:
    """The most frequent material of each kind of face."""
    counts = Counter(face for seed in seeds for face in faces(street(seed)))
    ranked = sorted(counts, key=lambda face: counts[face])
    return dict(ranked)  # of each kind the last, which is the most frequent


def received(made: Street, of_faces: list[str], seed: int) -> tuple[np.ndarray, object, AntennaDevice]:
    """Received power [dBm] along both streets, the channel, and the transmitter."""
    ends = np.cumsum([0, *(len(made.truth[name]) for name in made.eye.names)])
    named = {name: of_faces[a:b] for name, a, b in zip(made.eye.names, ends, ends[1:], strict=False)}
    scene, _ = with_materials(made.scene, named)
    rng = np.random.default_rng(seed)
    wx, wy = made.half_width_m
    sender = AntennaDevice(name="bs", role="tx", position=(-45.0, 0.4 * wx, 8.0), power_dbm=30.0)
    along = [(x, rng.uniform(-0.8, 0.8) * wx, 1.5) for x in np.linspace(-30, 60, 30)]
    around = [(rng.uniform(-0.8, 0.8) * wy, s * y, 1.5) for s in (-1, 1) for y in np.linspace(wx + 3, 60, 15)]
    users = [
        AntennaDevice(name=f"ue{n:02d}", role="rx", position=tuple(map(float, place)))
        for n, place in enumerate(along + around)
    ]
    with tempfile.TemporaryDirectory() as folder:
        write_scene(scene, Path(folder) / "scene")
        settings = SionnaSettings(
            max_depth=3, samples=options.samples, candidates="launched", bodies=0, outside_itu_range="nearest"
        )
        model = SionnaChannel(settings, RunInfo(name="channel", seed=1, carriers=(CARRIER,)))
        assets = scenery_assets(str(Path(folder) / "scene" / "scene.xml"))
        model.prepare(Preparation(demand={"channel": frozenset()}, assets=assets))
        empty = np.zeros((0, 3))
        at = Scene(
            names=(), classes=(), assets=(), position=empty, orientation=np.zeros((0, 4)), velocity=empty,
            dimensions=empty, devices=(sender, *users),
        )  # fmt: skip
        channel = model.model(Frame(episode=0, number=0, t_ns=0), at, [sender], users).channel
    power = np.add.reduceat(np.append(np.abs(channel.a[0]) ** 2, 0.0), channel.offsets[:-1])
    power = np.where(np.diff(channel.offsets) > 0, power, 0.0)
    with np.errstate(divide="ignore"):
        return 30.0 + 10 * np.log10(power), channel, sender


def interval(values: list[float]) -> str:
    half = 1.96 * np.std(values, ddof=1) / np.sqrt(len(values)) if len(values) > 1 else 0.0
    return f"{np.mean(values):.3f} ± {half:.3f}"


def segmented(segmenter: OnnxSegmenter, rgb: np.ndarray) -> np.ndarray:
    """Number of the material, or `SKY`, of each pixel; −1 for other classes."""
    number = [
        SKY if name == "sky" else MATERIALS.index(max(shares, key=lambda m: shares[m])) if shares else -1
        for name, shares in segmenter.materials.items()
    ]
    return np.array(number)[segmenter.segment(rgb).argmax(-1)]


def figures(made: Street, best: list[str], segmenter: OnnxSegmenter, seed: int) -> None:
    """Write the four pictures."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt
    from PIL import Image

    wx, _ = made.half_width_m
    device = camera("fig", (-62.0, -0.3 * wx, 4.0), (4.0, -8.0, 0.0), 75.0, (960, 720))
    rgb, _ = made.picture(device)
    Image.fromarray(rgb).save(options.out / "fig4-picture.png")
    numbers = segmented(segmenter, rgb)
    Image.fromarray(np.append(COLOURS, [[0, 0, 0]], axis=0)[numbers].astype(np.uint8)).save(
        options.out / "fig5-segmented.png"
    )
    above = camera("above", (-85.0, -70.0, 75.0), (42.0, 33.0, 0.0), 65.0, (960, 720))
    views = {"fig6-labels": above, "fig7-rays": above}
    _, channel, sender = received(made, best, seed)
    for name, eye in views.items():
        seen = made.eye.look(eye)
        grey = made.eye.paint(eye, np.full((len(made.eye.names), 3), 0.5)) / 188.0
        index = np.array([MATERIALS.index(one) for one in best] + [SKY])[seen.face]
        figure, axes = plt.subplots(figsize=(9.6, 7.2))
        axes.imshow(
            np.clip(COLOURS[index] * np.where(index == SKY, 1, grey.mean(-1))[..., None], 0, 255).astype(
                np.uint8
            )
        )
        if name == "fig7-rays":
            _draw_rays(axes, eye, channel, sender)
        shown = sorted(set(best), key=MATERIALS.index)
        patches = [plt.Rectangle((0, 0), 1, 1, color=COLOURS[MATERIALS.index(one)] / 255) for one in shown]
        axes.legend(patches, [one.replace("_", " ") for one in shown], loc="lower right", ncols=3)
        axes.set_axis_off()
        axes.set(xlim=(0, 960), ylim=(720, 0))
        figure.savefig(options.out / f"{name}.png", dpi=100, bbox_inches="tight", pad_inches=0)
        plt.close(figure)


def _draw_rays(axes: object, eye: object, channel: object, sender: AntennaDevice) -> None:
    from caviar_protocol.space.coordinates import rotation_matrix
    from caviar_services.sensors.camera import intrinsics

    optics, turn, place = intrinsics(eye), rotation_matrix(eye.orientation), np.array(eye.position)

    def pixels(points: np.ndarray) -> np.ndarray:
        local = (points - place) @ turn
        return np.stack(
            [
                optics.cx - optics.fx * local[:, 1] / local[:, 0],
                optics.cy - optics.fy * local[:, 2] / local[:, 0],
            ],
            -1,
        )

    pairs = np.repeat(np.arange(len(channel.rx)), np.diff(channel.offsets))
    strong = np.abs(channel.a[0])
    receivers = receiver_places(channel, sender)
    for path in np.flatnonzero(strong > 1e-3 * strong.max()):
        if pairs[path] % 4:
            continue
        count = int((channel.interactions[path] != Interaction.NONE).sum())
        corners = [sender.position, *channel.points[path, :count], receivers[path]]
        level = 20 * np.log10(strong[path] / strong.max())
        line = pixels(np.array(corners))
        axes.plot(*line.T, color=(1.0, max(0.0, -level / 60), 0.0), lw=1.0, alpha=0.8)
        axes.plot(*line[-1], "o", color="white", ms=3)
    axes.plot(*pixels(np.array([sender.position]))[0], "^", color="cyan", ms=9)


def receiver_places(channel: object, sender: AntennaDevice) -> np.ndarray:
    """Where paths end: their last corner, and what is left of their length along the arrival."""
    from caviar_protocol.space.coordinates import SPEED_OF_LIGHT, unit_vectors

    count = (channel.interactions != 0).sum(1)
    corners = np.concatenate([np.tile(sender.position, (len(count), 1, 1)), channel.points], axis=1)
    steps = np.linalg.norm(np.diff(corners, axis=1), axis=-1)
    walked = np.where(np.arange(steps.shape[1]) < count[:, None], steps, 0.0).sum(1)
    left = channel.tau * SPEED_OF_LIGHT - walked
    return corners[np.arange(len(count)), count] - unit_vectors(channel.aoa) * left[:, None]


parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
parser.add_argument("model", type=Path, help="ONNX file; its card stands beside it")
parser.add_argument("--streets", type=int, default=20)
parser.add_argument("--views", type=int, default=12, help="pictures of a street")
parser.add_argument("--samples", type=int, default=300_000, help="rays of a launch")
parser.add_argument("--out", type=Path, default=Path("materials"))
options = parser.parse_args()
options.out.mkdir(parents=True, exist_ok=True)

segmenter = OnnxSegmenter(options.model)
prior = usual(range(1000, 1024))
print("class prior: " + ", ".join(f"{what} {material}" for what, material in prior.items()))
scores: dict[str, list[float]] = {}
for seed in range(1, options.streets + 1):
    made = street(seed)
    pictures, right, total = [], 0, 0
    with tempfile.TemporaryDirectory() as folder:
        from PIL import Image

        for device in viewpoints(made.eye, options.views, (320, 240), 75.0, seed):
            rgb, truth = made.picture(device)
            Image.fromarray(rgb).save(Path(folder) / f"{device.name}.png")
            pictures.append(Picture(Path(folder) / f"{device.name}.png", device))
            right, total = right + int((segmented(segmenter, rgb) == truth).sum()), total + truth.size
        labels = label_faces(made.eye, pictures, segmenter, segmenter.materials)
    known = faces(made)
    guessed = [
        one if reached and share >= 0.5 else prior[what]
        for one, reached, share, (what, _) in zip(
            labels.best, labels.reached, labels.share.max(1), known, strict=True
        )
    ]
    true = [material for _, material in known]
    same, seen = np.array([a == b for a, b in zip(guessed, true, strict=True)]), labels.views > 0
    found = {
        "pixels right": right / total,
        "faces seen": seen.mean(),
        "faces right": same.mean(),
        "faces right, of those seen": same[seen].mean(),
    }
    reference = received(made, true, seed)[0]
    for name, variant in (
        ("from pictures", guessed),
        ("all of concrete", ["concrete"] * len(true)),
        ("class prior", [prior[what] for what, _ in known]),
    ):
        power = received(made, variant, seed)[0]
        both = np.isfinite(reference) & np.isfinite(power)
        found[f"error [dB], {name}"] = float(np.abs(power - reference)[both].mean())
    for name, value in found.items():
        scores.setdefault(name, []).append(float(value))
    print(f"street {seed}: " + ", ".join(f"{name} {value:.3f}" for name, value in found.items()), flush=True)
    if seed == 1:
        figures(made, guessed, segmenter, seed)

rows = [f"| {name} | {interval(values)} |" for name, values in scores.items()]
head = [f"| {options.streets} streets | mean and 95 % interval |", "| --- | ---: |"]
(options.out / "materials.md").write_text("\n".join([*head, *rows, ""]))
print("\n".join([*head, *rows]))
