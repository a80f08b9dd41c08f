"""Train a small network that names materials in pictures of streets, for `caviar scene materials`.

    python examples/train_segmentation.py CAMVID [--streets 24] [--minutes 20] [--out segmentation.onnx]

Needs the extras ``learning``, ``sensors``, ``plot`` and ``formats``. CAMVID is a folder with ``train``,
``trainannot``, ``test`` and ``testannot``, as the CamVid data set in eleven classes is handed around:
pictures, and labels by number, under the same names. Pictures of one's own need only be put there. Beside
them the network learns from renderings of streets with known materials: a building in a photograph may be of
any material of walls, so its loss is of their sum. The exported network takes pictures as they are; the
file beside it has its classes, and the materials that they stand for.
"""

import argparse
import itertools
import json
import math
import time
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from caviar_scenes.streets import MATERIALS, street
from caviar_scenes.views import viewpoints

SIZE = 320, 240
PHOTOS = (
    "sky", "building", "pole", "road", "pavement", "tree", "sign", "fence", "car", "pedestrian", "bicyclist",
)  # fmt: skip
WALLS = ("concrete", "brick", "glass", "wood", "metal")
CLASSES = (*(name for name in PHOTOS if name != "building"), *WALLS, "grass")
MEANT = {"road": "asphalt_concrete", "pavement": "concrete", "grass": "medium_dry_ground"}
MEANT |= {name: name for name in WALLS}
# Which classes a label may be: of photographs, then of renderings.
LABELS = [(name,) if name != "building" else WALLS for name in PHOTOS]
LABELS += [
    ({"asphalt_concrete": "road", "medium_dry_ground": "grass"}.get(name, name),) for name in MATERIALS
] + [("sky",)]
NOTHING = 255


def layer(inputs: int, outputs: int, stride: int = 1) -> torch.nn.Sequential:
    convolution = torch.nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False)
    return torch.nn.Sequential(convolution, torch.nn.BatchNorm2d(outputs), torch.nn.ReLU(inplace=True))


class UNet(torch.nn.Module):
    """Encoder and decoder with shortcuts between equal sizes; logits at half the size, enlarged."""

    def __init__(self, widths: tuple[int, ...] = (16, 32, 48, 64)) -> None:
        super().__init__()
        self.stem = layer(3, widths[0], 2)
        sizes = itertools.pairwise(widths)
        self.down = torch.nn.ModuleList([torch.nn.Sequential(layer(a, b, 2), layer(b, b)) for a, b in sizes])
        sizes = zip(reversed(widths[:-1]), reversed(widths[1:]), strict=True)
        self.up = torch.nn.ModuleList([layer(a + b, a) for a, b in sizes])
        self.out = torch.nn.Conv2d(widths[0], len(CLASSES), 1)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        kept = [self.stem(x)]
        for step in self.down:
            kept.append(step(kept[-1]))
        x = kept.pop()
        for step in self.up:
            other = kept.pop()
            x = torch.nn.functional.interpolate(x, other.shape[2:], mode="bilinear", align_corners=False)
            x = step(torch.cat([x, other], 1))
        return torch.nn.functional.interpolate(
            self.out(x), scale_factor=2.0, mode="bilinear", align_corners=False
        )


class Exported(torch.nn.Module):
    """Probabilities of classes, ``[1, C, H, W]``, of a picture as it is: uint8, ``[1, H, W, 3]``."""

    def __init__(self, net: UNet) -> None:
        super().__init__()
        self.net = net

    def forward(self, picture: torch.Tensor) -> torch.Tensor:
        return torch.softmax(self.net(picture.permute(0, 3, 1, 2).float() / 127.5 - 1.0), 1)


def photographs(folder: Path, part: str) -> list[tuple[np.ndarray, np.ndarray]]:
    """Pictures and labels of a part, ``train`` or ``test``."""
    found = []
    for file in sorted((folder / part).glob("*.png")):
        picture = Image.open(file).convert("RGB").resize(SIZE, Image.Resampling.BOX)
        label = np.array(
            Image.open(folder / f"{part}annot" / file.name).resize(SIZE, Image.Resampling.NEAREST)
        )
        found.append((np.array(picture), np.where(label < len(PHOTOS), label, NOTHING).astype(np.uint8)))
    if not found:
        raise SystemExit(
            f"{folder / part} has no *.png; give a folder with train, trainannot, test, testannot"
        )
    return found


def renderings(seeds: range) -> list[tuple[np.ndarray, np.ndarray]]:
    """Pictures and labels of procedural streets."""
    found = []
    for seed in seeds:
        made = street(seed)
        for device in viewpoints(made.eye, 8, SIZE, 75.0, seed):
            rgb, material = made.picture(device)
            found.append((rgb, (len(PHOTOS) + material).astype(np.uint8)))
    return found


ALLOWED = torch.tensor([[name in label for name in CLASSES] for label in LABELS])


def crop(rng: np.random.Generator, picture: np.ndarray, label: np.ndarray, size: int = 160) -> tuple:
    """A square of a picture, of another size and brightness, and mirrored at times."""
    scale = math.exp(rng.uniform(math.log(0.7), math.log(1.6)))
    shape = [max(size, round(side * scale)) for side in SIZE]
    picture = np.array(Image.fromarray(picture).resize(shape, Image.Resampling.BILINEAR))
    label = np.array(Image.fromarray(label).resize(shape, Image.Resampling.NEAREST))
    x, y = rng.integers(0, shape[0] - size + 1), rng.integers(0, shape[1] - size + 1)
    picture, label = picture[y : y + size, x : x + size], label[y : y + size, x : x + size]
    if rng.random() < 0.5:
        picture, label = picture[:, ::-1], label[:, ::-1]
    light = picture / 127.5 * rng.uniform(0.7, 1.3) * rng.uniform(0.9, 1.1, 3) + rng.uniform(-0.1, 0.1) - 1.0
    return np.clip(light, -1, 1).astype(np.float32), np.ascontiguousarray(label)


def score(net: UNet, pictures: list, labels: range) -> tuple[float, list[float], float]:
    """Mean intersection over union of labels, that of each, and the share of pixels that are right."""
    net.eval()
    hits, either = np.zeros((2, len(labels)))
    right = total = 0
    with torch.no_grad():
        for picture, label in pictures:
            x = torch.from_numpy(picture / 127.5 - 1.0).float().permute(2, 0, 1)[None]
            share = torch.softmax(net(x), 1)[0]
            # Of a building's materials the sum counts.
            of_label = torch.einsum("lc,chw->lhw", ALLOWED[labels.start : labels.stop].float(), share)
            guess = of_label.argmax(0).numpy() + labels.start
            known = label != NOTHING
            right, total = right + (guess == label)[known].sum(), total + known.sum()
            for n, number in enumerate(labels):
                hits[n] += ((guess == number) & (label == number)).sum()
                either[n] += (((guess == number) | (label == number)) & known).sum()
    net.train()
    iou = [hit / one if one else math.nan for hit, one in zip(hits, either, strict=True)]
    return float(np.nanmean(iou)), iou, right / total


parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
parser.add_argument("camvid", type=Path, help="folder with train, trainannot, test and testannot")
parser.add_argument("--streets", type=int, default=24, help="procedural streets, of eight pictures each")
parser.add_argument("--minutes", type=float, default=20.0, help="of training")
parser.add_argument("--out", type=Path, default=Path("segmentation.onnx"))
options = parser.parse_args()

torch.manual_seed(1)
torch.set_num_threads(1)
rng = np.random.default_rng(1)
tests = photographs(options.camvid, "test")
photos, drawn = photographs(options.camvid, "train"), renderings(range(1000, 1000 + options.streets))
held_out = renderings(range(1, 3))  # the first of those that `caviar paper materials` takes
counts = np.bincount(np.concatenate([label.ravel() for _, label in photos + drawn]), minlength=256)[
    : len(LABELS)
]
weights = torch.tensor(1 / np.sqrt(np.maximum(counts, counts.sum() * 1e-4)), dtype=torch.float32)
weights *= (counts.sum()) / float((weights * torch.tensor(counts)).sum())
net = UNet()
size = sum(parameters.numel() for parameters in net.parameters())
print(f"{len(photos)} photographs, {len(drawn)} renderings, {size} parameters")

optimiser = torch.optim.AdamW(net.parameters(), lr=4e-3, weight_decay=1e-4)
begin, curve, losses, next_score = time.monotonic(), [], [], 0.1
step = 0
while (share := (time.monotonic() - begin) / (60 * options.minutes)) < 1:
    for group in optimiser.param_groups:
        group["lr"] = 4e-3 * min(1.0, (step + 1) / 50) * (0.5 + 0.5 * math.cos(math.pi * share)) + 1e-5
    batch = [crop(rng, *source[rng.integers(len(source))]) for source in (photos, drawn) for _ in range(4)]
    x = torch.from_numpy(np.stack([one for one, _ in batch])).permute(0, 3, 1, 2)
    label = torch.from_numpy(np.stack([one for _, one in batch])).long()
    logits = net(x).permute(0, 2, 3, 1)
    known = label != NOTHING
    log_share = torch.log_softmax(logits[known], 1)
    allowed = ALLOWED[label[known]]
    right = torch.logsumexp(log_share.masked_fill(~allowed, -1e9), 1)
    of_pixel = weights[label[known]]
    loss = -(right * of_pixel).sum() / of_pixel.sum()
    optimiser.zero_grad()
    loss.backward()
    optimiser.step()
    losses.append(loss.item())
    step += 1
    if share > next_score:
        next_score += 0.1
        found = (
            score(net, tests[::4], range(len(PHOTOS)))[0],
            score(net, held_out[::2], range(len(PHOTOS), len(LABELS)))[0],
        )
        curve.append((step, float(np.mean(losses[-50:])), *found))
        of_both = f"mean IoU {found[0]:.3f} photographs, {found[1]:.3f} renderings"
        print(f"step {step}: loss {curve[-1][1]:.3f}, {of_both}", flush=True)

mean, each, right = score(net, tests, range(len(PHOTOS)))
print(f"{len(tests)} held-out photographs: mean IoU {mean:.3f}, pixels right {right:.3f}")
print("  " + ", ".join(f"{name} {value:.2f}" for name, value in zip(PHOTOS, each, strict=True)))
drawn_mean, each, right = score(net, held_out, range(len(PHOTOS), len(LABELS)))
print(f"{len(held_out)} held-out renderings: mean IoU {drawn_mean:.3f}, pixels right {right:.3f}")
print("  " + ", ".join(f"{name} {value:.2f}" for name, value in zip((*MATERIALS, "sky"), each, strict=True)))
curve.append((step, float(np.mean(losses[-50:])), mean, drawn_mean))

net.eval()
torch.onnx.export(
    Exported(net), (torch.zeros((1, SIZE[1], SIZE[0], 3), dtype=torch.uint8),), str(options.out),
    input_names=["picture"], output_names=["probabilities"], dynamo=False, opset_version=17,
    dynamic_axes={"picture": {1: "height", 2: "width"}, "probabilities": {2: "height", 3: "width"}},
)  # fmt: skip
card = {
    "classes": CLASSES, "layout": "NHWC", "dtype": "uint8", "width": SIZE[0], "multiple": 16,
    "output": "probabilities", "materials": MEANT,
}  # fmt: skip
options.out.with_suffix(".json").write_text(json.dumps(card, indent=2) + "\n")

import matplotlib  # noqa: E402 - after the work, which needs none of it

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402

figure, (left, right_axis) = plt.subplots(1, 2, figsize=(9, 3.2))
smooth = np.convolve(losses, np.ones(25) / 25, "valid")
left.plot(np.arange(len(smooth)) + 25, smooth)
left.set(xlabel="step", ylabel="loss, mean of 25 steps")
steps, _, of_photos, of_drawn = zip(*curve, strict=True)
right_axis.plot(steps, of_photos, "o-", label="photographs")
right_axis.plot(steps, of_drawn, "s-", label="renderings")
right_axis.set(xlabel="step", ylabel="mean IoU, held out", ylim=(0, 1))
right_axis.legend()
figure.tight_layout()
figure.savefig(options.out.with_suffix(".png"), dpi=150)
print(f"{options.out}, {options.out.with_suffix('.json')}, {options.out.with_suffix('.png')}")
