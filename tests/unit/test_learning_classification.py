"""Supervised experiments: training that goes on, policies served as they were judged, figures by formula."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from dataset_builders import RX, SCENES, TX, generated, written_scenario
from typer.testing import CliRunner

from caviar_clients.cli.main import app
from caviar_clients.datasets.reader import Dataset
from caviar_clients.learning.classification import Classification, load_any_experiment, parse_classification
from caviar_clients.learning.dataset_evaluation import evaluate_on_dataset
from caviar_clients.learning.networks import AROUND, FINE, LINE, OBSERVED, STEPS, BeamModel, BeamNetwork
from caviar_clients.learning.ranking_methods import ranked_along_the_line, ranked_by_policy
from caviar_clients.learning.rankings import terms_of
from caviar_clients.learning.samples import Samples, read_samples
from caviar_clients.learning.supervised import Rows, export_classifier, make_model, train_classifier
from caviar_clients.learning.training import POLICY, Progress, seed_folder
from caviar_protocol.errors import ScenarioError, SetupError
from caviar_protocol.topics import AntennaArray
from caviar_services.agent.policy import PolicyModel

pytest.importorskip("stable_baselines3", reason="needs the extra `learning`")
torch = pytest.importorskip("torch", reason="needs the extra `learning`")
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("classification")
    return generated(written_scenario(folder), folder / "uavs", 10)


def experiment(data: Path, more: str = "", epochs: int = 6, name: str = "beams") -> Classification:
    return parse_classification(
        f"""
        experiment = {{ kind = "classification", name = "{name}", seeds = [1], epochs = {epochs} }}
        data = {{ dataset = "{data}", test = 0.3, validation = 0.2 }}
        training = {{ batch_size = 32, learning_rate = 5e-3 }}
        {more or 'model = { name = "position" }'}
        """
    )


def trained(made: Classification, root: Path) -> Path:
    folder = root / made.experiment.name
    train_classifier(made, 1, folder)
    return seed_folder(folder, 1) / POLICY


@pytest.fixture(scope="module")
def policy(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return trained(experiment(data), tmp_path_factory.mktemp("trained"))


def test_a_training_that_is_interrupted_leads_to_the_same_policy(
    data: Path, policy: Path, tmp_path: Path
) -> None:
    def stop(progress: Progress) -> None:
        if progress.steps == 3:
            raise KeyboardInterrupt

    made = experiment(data)
    with pytest.raises(KeyboardInterrupt):
        train_classifier(made, 1, tmp_path / "beams", stop)
    steps: list[int] = []
    result = train_classifier(made, 1, tmp_path / "beams", lambda progress: steps.append(progress.steps))
    assert steps[0] == 3
    assert result.steps == 6
    assert (seed_folder(tmp_path / "beams", 1) / POLICY).read_bytes() == policy.read_bytes()


def test_an_agent_chooses_what_was_judged(policy: Path, tmp_path: Path) -> None:
    """Played by the agent `policy`, recorded, and ranked anew from the recording: the same pairs."""
    played = written_scenario(tmp_path, f'use = "policy"\nsettings = {{ file = "file:{policy}" }}')
    dataset = Dataset(generated(played, tmp_path / "served", 3))
    users = dataset.users()
    served = np.stack([users["link.tx_beam"], users["link.rx_beam"]], axis=1)
    samples = read_samples(dataset, OBSERVED["position"])
    order = ranked_by_policy(PolicyModel(policy), samples, "policy").order
    assert len(samples) == 3 * SCENES * 2
    np.testing.assert_array_equal(order[:, 0], served[:, 0] * RX + served[:, 1])
    assert len(np.unique(order[:, 0])) > 3
    assert (np.sort(order, axis=1) == np.arange(TX * RX)).all()


def test_both_orders_of_pairs_are_served_as_one(data: Path, policy: Path, tmp_path: Path) -> None:
    other = trained(experiment(data, 'model = { name = "position" }\nlabel = { order = "rx-tx" }'), tmp_path)
    samples = read_samples(Dataset(data), OBSERVED["position"])
    for file in (policy, other):
        order = ranked_by_policy(PolicyModel(file), samples, "policy").order
        chosen = np.take_along_axis(samples.abs_y, order[:, :4], axis=1).max(1)
        share = (chosen / samples.abs_y.max(1))[samples.los]
        assert share.mean() > 0.75  # a random four of 32 pairs have 0.37


def test_figures_are_those_of_their_formulas(data: Path) -> None:
    samples = read_samples(Dataset(data), ())
    rng = np.random.default_rng(1)
    order = np.stack([rng.permutation(TX * RX) for _ in range(len(samples))])
    order[:, 7:] = -1  # a ranking that ends
    terms = terms_of(samples, order, outage_db=10.0)
    y = samples.abs_y.astype(float) * math.sqrt(TX * RX)
    for k in (1, 5, 10):
        first = [row[row >= 0][:k] for row in order]
        best = np.array([y[n, rows].max() for n, rows in enumerate(first)])
        hits = np.array([y[n].argmax() in rows for n, rows in enumerate(first)])
        snr = samples.power_over_noise * (best / math.sqrt(TX * RX)) ** 2
        for name, over, under in (
            ("top", hits, np.ones(len(y))),
            ("throughput", np.log2(1 + best), np.log2(1 + y.max(1))),
            ("outage", snr < 10.0, np.ones(len(y))),
        ):
            assert terms.over[f"{name}_{k}"].sum() == pytest.approx(over.sum())
            assert terms.under[f"{name}_{k}"].sum() == pytest.approx(under.sum())
            episode = np.flatnonzero(samples.episode[samples.scene] == 4)
            assert terms.over[f"{name}_{k}"][4] == pytest.approx(over[episode].sum())
    np.testing.assert_array_equal(ranked_along_the_line(samples).order[:, 0], samples.straight)


def test_policies_are_judged_on_episodes_that_none_was_trained_on(
    data: Path, policy: Path, tmp_path: Path
) -> None:
    made = evaluate_on_dataset([policy], data)
    train, validation, test = experiment(data).split()
    assert made.episodes == tuple(test)
    assert sorted({*train, *validation, *test}) == list(range(10))
    assert made.users["all"] == made.users["LOS"] + made.users["NLOS"] == len(test) * SCENES * 2
    assert made.figure("exhaustive-sweep", "all", "top_1").mean == 1.0
    assert made.pilots["exhaustive-sweep"] == TX * RX
    assert made.figure("beams", "LOS", "top_1").mean > made.figure("frequent pairs", "LOS", "top_1").mean
    paired = made.difference("beams", "los-beam", "LOS", "top_1")
    means = [made.figure(name, "LOS", "top_1").mean for name in ("beams", "los-beam")]
    assert paired.mean == pytest.approx(means[0] - means[1])
    # By the command, of another dataset: all its episodes, and those who learn have nothing to learn from.
    other = generated(written_scenario(tmp_path, 'use = "random"'), tmp_path / "other", 2)
    report = tmp_path / "found.json"
    arguments = ["policy", "evaluate", str(policy.parents[1]), "--on", str(other), "--json", str(report)]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    assert "--trained-on" in result.output
    found = json.loads(report.read_text())
    assert found["episodes"] == [0, 1]
    assert "nearest users" not in found["methods"]
    assert len(found["methods"]["beams"]["by_episode"]["all"][0]["top_1"]) == 2
    result = CliRunner().invoke(app, [*arguments, "--trained-on", str(data)])
    assert result.exit_code == 0, result.output
    assert {"nearest users", "frequent pairs", "fingerprint"} <= json.loads(report.read_text())[
        "methods"
    ].keys()


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ('model = { name = "lidr" }', ("model.name", "lidr", "lidar")),
        ('model = { name = "lidar" }', ("lidar_grid",)),
        ('model = { name = "position", options = { unit = [3] } }', ("model.options", "unit")),
        ('model = { name = "json:JSONEncoder", observe = ["position"] }', ("json:JSONEncoder", "BeamModel")),
        ('model = { name = "position" }\nlabel = { target = "second" }', ("label.target", "second")),
    ],
)
def test_what_cannot_be_trained_is_refused(
    data: Path, tmp_path: Path, more: str, words: Sequence[str]
) -> None:
    with pytest.raises(ScenarioError) as caught:
        train_classifier(experiment(data, more), 1, tmp_path / "beams")
    assert all(word in str(caught.value) for word in words), caught.value


def test_a_network_that_mixes_users_is_not_exported(data: Path, tmp_path: Path) -> None:
    samples = read_samples(Dataset(data), ("departure",))
    made = experiment(data, 'model = { name = "position", observe = ["departure"] }')

    class Mixed(BeamModel):
        def forward(self, rows: Any) -> Any:
            z = rows["departure"].flip(0)[:, 1:2] * 16 + 16  # of another user
            return -((torch.arange(TX * RX) - z) ** 2)

    class Constant(BeamModel):
        def forward(self, rows: Any) -> Any:
            of_each = rows["departure"].sum(1, keepdim=True).expand(len(rows["departure"]), 1)
            return of_each + torch.zeros(TX * RX)

    for model, words in ((Mixed(), "by itself"), (Constant(), "x.shape[0]")):
        with pytest.raises(SetupError) as caught:
            export_classifier(made, model, samples, tmp_path / "mixed.onnx", 1, 1, {})
        assert words in str(caught.value)


def test_a_network_of_the_users_own_is_trained_from_a_file(data: Path, tmp_path: Path) -> None:
    (tmp_path / "my_network.py").write_text(
        "import torch\n"
        "from caviar_clients.learning.networks import BeamModel\n\n"
        "class Line(BeamModel):\n"
        "    def __init__(self, shapes, beams, units=8):\n"
        "        super().__init__()\n"
        "        self.layers = torch.nn.Sequential(torch.nn.Linear(shapes['departure'][0], units),\n"
        "            torch.nn.ReLU(), torch.nn.Linear(units, beams[0] * beams[1]))\n\n"
        "    def forward(self, rows):\n"
        "        return self.layers(rows['departure'])\n"
    )
    file = tmp_path / "own.toml"
    file.write_text(
        'experiment = { kind = "classification", name = "own", seeds = [1], epochs = 2 }\n'
        f'data = {{ dataset = "file:{data}" }}\n'
        'model = { name = "my_network:Line", observe = ["departure"], options = { units = 12 } }\n'
    )
    made = load_any_experiment(file)
    assert isinstance(made, Classification)
    arguments = ["policy", "train", str(file), "--out", str(tmp_path / "training")]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    model = PolicyModel(tmp_path / "training" / "own" / "seed-1" / POLICY)
    assert model.card is not None
    assert model.card.observe == ("departure",)
    assert model.card.transmitters == ("bs",)  # of the dataset
    # It was trained on all episodes, of which none is left to judge it on.
    judged = CliRunner().invoke(app, ["policy", "evaluate", str(tmp_path / "training"), "--on", str(data)])
    assert judged.exit_code != 0
    assert "test = " in str(judged.exception or judged.output)


def test_pictures_that_users_share_and_a_spectrum_are_observed(data: Path, tmp_path: Path) -> None:
    """Of one carrier the spectrum tells the best pair; the picture is one for all places of a scene."""
    dataset = Dataset(data)
    samples = read_samples(dataset, ("spectrum", "position"))
    spectrum = samples.rows("spectrum", np.arange(len(samples)))
    np.testing.assert_array_equal(spectrum.argmax(1), samples.best)
    pictures = np.random.default_rng(2).integers(0, 256, (len(samples.episode), 90, 130, 3), dtype=np.uint8)
    seen = replace(
        samples,
        observed={"camera": pictures, "position": samples.observed["position"]},
        row_shapes={"camera": None, "position": (3,)},
    )
    made = experiment(data, 'model = { name = "image", observe = ["camera", "position"] }')
    model = make_model(made, seen)
    rows = Rows.read(model, seen, np.arange(len(seen)), made)
    model.fit(rows.reduced)
    export_classifier(made, model.eval(), seen, tmp_path / "image.onnx", 1, 1, {})
    order = ranked_by_policy(PolicyModel(tmp_path / "image.onnx"), seen, "policy").order
    given, _ = rows.batch(torch.arange(len(seen)), "cpu")
    with torch.no_grad():
        wanted = model(given).argmax(1).numpy()
    assert np.mean(order[:, 0] == wanted) > 0.95  # pictures of training are rounded to 16 bits


@pytest.mark.parametrize("shape", [(40, 12, 6), (12, 40, 10)])
def test_a_grid_tells_what_stands_on_the_line_and_around(
    data: Path, tmp_path: Path, shape: tuple[int, int, int]
) -> None:
    """Held against loops over cells; halves are rounded either way, so that a few points may differ."""
    rng = np.random.default_rng(3)
    grid = (rng.random((5, *shape)) < 0.05).astype(np.int8)
    ends: list[Any] = []
    for cells in grid:
        tx, rx = rng.integers(0, cells.shape, (2, 3))
        cells[tuple(tx)], cells[tuple(rx)] = -1, -2
        ends.append((tx, rx))
    model = BeamNetwork({"lidar_grid": shape}, (8, 4), small=True)
    reduced = model.reduce({"lidar_grid": torch.from_numpy(grid)})
    rows = {name.partition("/")[2]: value.numpy() for name, value in reduced.items()}
    np.testing.assert_array_equal(rows["rx"], [rx for _, rx in ends])
    length, width = AROUND
    for n, (tx, rx) in enumerate(ends):
        away, most = rx - tx, np.abs(rx - tx).max()
        fine = LINE * FINE
        back = [*(np.arange(1, fine + 1) / (fine + 1)), *(np.arange(1, STEPS + 1) / most)]
        points = [np.round(rx - away * share).astype(int) for share in back]
        met = [share < 1 and grid[(n, *point)] > 0 for share, point in zip(back, points, strict=True)]
        wanted = [*np.reshape(met[:fine], (LINE, FINE)).any(1), *met[fine:]]
        assert np.count_nonzero((rows["line"][n, :-1] > 0) != wanted) <= 2
        layer = max(1, shape[2] // 5)
        for _ in range(40):
            a, b = rng.integers(-length, length + 1), rng.integers(-width, width + 1)
            k = rng.integers(0, rows["around"].shape[1])
            x, y = (rx[0] + b, rx[1] + a) if shape[1] > shape[0] else (rx[0] + a, rx[1] + b)
            inside = 0 <= x < shape[0] and 0 <= y < shape[1]
            stands = inside and (grid[n, x, y, k * layer : (k + 1) * layer] > 0).any()
            assert rows["around"][n, k, length + a, width + b] == stands
    model.eval()
    given = ("arrays", "places", "observed", "row_shapes")
    scene = Samples(
        arrays=(AntennaArray(columns=8), AntennaArray(columns=4)),
        places=5,
        observed={"lidar_grid": grid[None]},
        row_shapes={"lidar_grid": shape},
        **{field.name: np.zeros(5) for field in fields(Samples) if field.name not in given},
    )
    made = experiment(data, 'model = { name = "lidar" }')
    export_classifier(made, model, scene, tmp_path / "grid.onnx", 1, 1, {})
    with torch.no_grad():
        scores = model(reduced).numpy()
    ranked = PolicyModel(tmp_path / "grid.onnx").ranked({"lidar_grid": grid})
    np.testing.assert_array_equal(ranked[:, 0], scores.argmax(1))
    challenge = BeamNetwork({"lidar_grid": (20, 200, 10)}, (64, 8), small=True)
    assert sum(weights.numel() for weights in challenge.parameters()) <= 10_000
