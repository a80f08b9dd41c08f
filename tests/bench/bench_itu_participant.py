"""A participant's public code of the ITU challenge ML5G-PHY, unmodified, on exports of CAVIAR's datasets;
beside it policies and nearest users, on the same users.

    git clone https://github.com/galidor/ITU_Beam_Selection_TF
    python3.11 -m venv tf && tf/bin/pip install tensorflow-cpu==2.15.1
    python tests/bench/bench_itu_participant.py TRAIN TEST… --code ITU_Beam_Selection_TF \\
        --python tf/bin/python --policies FOLDER [--passes 1 20] [--seeds 3] [--markdown FILE]

TRAIN and each TEST are datasets of ``s008`` whose station has the challenge's 32 elements; the policies below
FOLDER were trained on TRAIN with ``test = 0``. The participant's ``beam_train_model.py`` trains for one
epoch: of ``--passes 20`` it gets the same files 20 times, which it joins as it does for sets that are merged.
Its ``beam_test_model.py`` writes predictions in the form of a submission, which are judged here.
"""

# ruff: noqa: T201 - a command that prints what it measured

from __future__ import annotations

import argparse
import csv
import os
import subprocess
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from caviar_clients.datasets.reader import Dataset
from caviar_clients.learning.dataset_evaluation import method_name
from caviar_clients.learning.ranking_methods import ranked_by_neighbours, ranked_by_policy
from caviar_clients.learning.rankings import Terms, interval, terms_of
from caviar_clients.learning.samples import Samples, read_samples
from caviar_formats.base import export_users, find_format
from caviar_protocol.arrays import BoolArray, Int64Array
from caviar_protocol.spec import table
from caviar_services.agent.policy import PolicyModel

PARTS = ("train", "validation")
PAIRS = (np.arange(32)[:, None] * 8 + -np.arange(8) % 8).reshape(-1)
"""Our index of each of the challenge's pairs tx·8 + rx: its RX beams count in the other direction."""
FIGURES = ("top_1", "top_5", "top_10")


def exported(location: str, folder: Path) -> Path:
    """Export a dataset as ``itu``, ready for training.

    Returns:
        Folder ``baseline_data``.
    """
    out = folder / "-".join(Path(location).resolve().parts[1:])
    export_users(Dataset(location).users(), find_format("itu", "baseline"), out)
    return out / "baseline_data"


def arguments(sets: Sequence[Path], kind: str, passes: int = 1) -> list[str]:
    """Options of the participant's scripts for both parts of exported sets, each given so many times."""
    found = []
    for option, name in (("lidar", "lidar_input/lidar_{}.npz"), ("beam", "beam_output/beams_output_{}.npz")):
        files = [str(data / name.format(part)) for data in sets for part in PARTS]
        found += [f"--{option}_{kind}_data", *(files * passes)]
    return found


def judged_users(samples: Samples, data: Path) -> Int64Array:
    """Positions in the samples of the users that an export has, in its order; their |y| is compared."""
    (file,) = data.parent.glob("raw_data/*.csv")
    valid = [row for row in csv.DictReader(file.open(encoding="utf-8")) if row["Val"] == "V"]
    keys = zip(
        samples.episode[samples.scene].tolist(), samples.position[:, :2].round(6).tolist(), strict=True
    )
    user = {(episode, *xy): n for n, (episode, xy) in enumerate(keys)}
    at = np.array(
        [user[int(row["EpisodeID"]), *(round(float(row[axis]), 6) for axis in "xy")] for row in valid]
    )
    outputs = [np.load(data / f"beam_output/beams_output_{part}.npz") for part in PARTS]
    y = np.abs(np.concatenate([output["output_classification"] for output in outputs]))
    y = y.swapaxes(1, 2).reshape(len(at), -1)
    ours = np.sqrt(y.shape[1]) * samples.abs_y[at][:, PAIRS]
    if not np.allclose(y, ours, rtol=1e-3, atol=1e-3 * y.max()):
        raise SystemExit(f"{data}: |y| differs from the dataset's by {np.abs(y - ours).max():.3g}")
    return at


def main() -> None:
    """Export, train, test, print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("train")
    parser.add_argument("test", nargs="+")
    parser.add_argument("--code", type=Path, required=True, help="checkout of ITU_Beam_Selection_TF")
    parser.add_argument("--python", type=Path, required=True, help="interpreter with TensorFlow")
    parser.add_argument("--policies", type=Path, required=True, help="folder of trainings")
    parser.add_argument("--passes", type=int, nargs="+", default=[1, 20])
    parser.add_argument("--seeds", type=int, default=3, help="trainings of the participant's code")
    parser.add_argument("--markdown", type=Path)
    args = parser.parse_args()
    files = sorted(args.policies.glob("*/seed-*/policy.onnx"))
    models = [PolicyModel(file, str(file)) for file in files]
    observe = tuple(dict.fromkeys(name for model in models for name in model.inputs))
    learnt = read_samples(Dataset(args.train), ())
    rows = list[list[str]]()
    with TemporaryDirectory(prefix="caviar-itu-") as name:
        folder = Path(name)
        sets = {location: exported(location, folder) for location in {args.train, *args.test}}

        def call(script: str, *words: str) -> None:
            # Their generators have no seed: each call is another training.
            command = [str(args.python.absolute()), script, *words]
            subprocess.run(command, cwd=args.code, check=True, env=os.environ | {"TF_CPP_MIN_LOG_LEVEL": "2"})

        for passes in args.passes:
            for seed in range(args.seeds):
                weights = str(folder / f"model-{passes}-{seed}")
                training = arguments([sets[args.train]], "training", passes)
                validation = arguments([sets[args.test[0]]], "validation")
                call("beam_train_model.py", *training, *validation, "--model_path", weights)
                for location in args.test:
                    predicted = str(sets[location] / f"predictions-{passes}-{seed}.csv")
                    tested = arguments([sets[location]], "test")
                    call(
                        "beam_test_model.py", *tested, "--model_path", weights, "--preds_csv_path", predicted
                    )
        for location in args.test:
            samples = read_samples(Dataset(location), observe)
            at = judged_users(samples, sets[location])
            mask: BoolArray = np.isin(np.arange(len(samples)), at)
            judged, found = samples.where(mask), dict[str, list[Terms]]()
            for passes in args.passes:
                for seed in range(args.seeds):
                    scores = np.loadtxt(sets[location] / f"predictions-{passes}-{seed}.csv", delimiter=",")
                    order = PAIRS[np.argsort(-scores[np.argsort(at)], axis=1, kind="stable")]
                    called = f"`beam_train_model.py`, {passes} pass" + "es" * (passes > 1)
                    found.setdefault(called, []).append(terms_of(judged, order))
            for file, model in zip(files, models, strict=True):
                ranking = ranked_by_policy(model, samples, str(file))
                found.setdefault(f"`{method_name(file)}`", []).append(terms_of(judged, ranking.order[mask]))
            found["nearest users"] = [terms_of(judged, ranked_by_neighbours(learnt, judged).order)]
            print(f"{location}: {len(at)} users of {int(samples.has_path.sum())} with a path are valid")
            for method, runs in found.items():
                figures = [interval(runs, figure) for figure in (*FIGURES, "throughput_10")]
                cells = [f"{100 * f.mean:.1f} ± {100 * f.half_width:.1f}" for f in figures[:-1]]
                rows.append([Path(location).name, method, *cells, f"{figures[-1].mean:.3f}"])
    text = table(("judged on", "", "top-1 %", "top-5 %", "top-10 %", "ratio of 10"), rows)
    print(text)
    if args.markdown:
        args.markdown.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
