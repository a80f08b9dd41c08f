"""A policy of one's own in plain PyTorch: learn from the |y| of the beams that were tried, and export it.

    python examples/own_policy.py [--frames 1000] [--out own.onnx]

Needs the extra ``learning``. A network predicts |y| of all 64 beams from the direction to the user. It is
trained on what was observed of those that were chosen, in 64 environments at once, and serves by choosing the
beam of the greatest prediction.
"""

import argparse
from pathlib import Path

import gymnasium
import numpy as np
import torch

from caviar_clients.envs.base import BeamSelectionEnv
from caviar_clients.learning.evaluate import KINDS, METHODS, evaluate
from caviar_clients.learning.export import card_of, export_module

SCENARIO, OBSERVE = "geometric", ("aod",)
MEMBERS, BEAMS, BATCH, WAVES = 64, 64, 512, 16


class Predictor(torch.nn.Module):
    """|y| of each beam, from the azimuth of departure [rad], Shape ``[B, 1]``."""

    def __init__(self) -> None:
        super().__init__()
        self.net = torch.nn.Sequential(
            torch.nn.Linear(2 * WAVES + 1, 128), torch.nn.ReLU(), torch.nn.Linear(128, BEAMS)
        )

    def forward(self, aod: torch.Tensor) -> torch.Tensor:
        # What the phases along a row of antennas follow, and its harmonics: beams are narrow in it.
        u = torch.sin(aod)
        waves = torch.arange(1, WAVES + 1) * torch.pi * u
        return self.net(torch.cat([u, torch.sin(waves), torch.cos(waves)], dim=1))


class Greedy(torch.nn.Module):
    """The beam of the greatest prediction: what is exported."""

    def __init__(self, predictor: Predictor) -> None:
        super().__init__()
        self.predictor = predictor

    def forward(self, aod: torch.Tensor) -> torch.Tensor:
        return self.predictor(aod).argmax(dim=1)


parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--frames", type=int, default=1000, help="of each of the 64 environments")
parser.add_argument("--out", type=Path, default=Path("own.onnx"))
options = parser.parse_args()

rng = np.random.default_rng(1)
torch.manual_seed(1)
torch.set_num_threads(1)  # the network is small: threads would wait for each other
envs = gymnasium.make_vec(
    "caviar:caviar/BeamSelection-v0", num_envs=MEMBERS, scenario=SCENARIO, observe=OBSERVE
)
predictor = Predictor()
optimizer = torch.optim.Adam(predictor.parameters(), lr=3e-3)
seen: list[np.ndarray] = []
chosen: list[np.ndarray] = []
got: list[np.ndarray] = []

observations, _ = envs.reset(seed=1)
for frame in range(options.frames):
    with torch.no_grad():
        greedy = predictor(torch.from_numpy(observations["aod"])).argmax(dim=1).numpy()
    explores = rng.random(MEMBERS) < max(0.05, 1.0 - 2.0 * frame / options.frames)
    beams = np.where(explores, rng.integers(BEAMS, size=MEMBERS), greedy)
    seen.append(observations["aod"])
    observations, rewards, _, _, _ = envs.step(beams)
    chosen.append(beams)
    got.append(rewards.astype(np.float32))
    aods, tried, found_y = (torch.from_numpy(np.concatenate(part)) for part in (seen, chosen, got))
    for _ in range(4):
        rows = torch.from_numpy(rng.integers(len(aods), size=BATCH))
        predicted = predictor(aods[rows]).gather(1, tried[rows, None])[:, 0]
        loss = torch.nn.functional.mse_loss(predicted, found_y[rows])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
envs.close()

env = BeamSelectionEnv(SCENARIO, observe=OBSERVE)
card = card_of(env, algorithm="own_policy.py", steps=options.frames * MEMBERS, seeds=(1,))
export_module(Greedy(predictor), env.observation_space, options.out, card)

# On seeds that training has not seen; means of |y| with 95 % intervals.
found = evaluate(options.out, SCENARIO, seeds=range(1000, 1003)).found
for method in METHODS:
    print(f"{method:9} " + "  ".join(f"{kind} {found[method][kind]}" for kind in KINDS))
