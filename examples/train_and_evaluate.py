"""Train beam selection with Stable-Baselines3 on one machine, export the policy, compare it with baselines.

    python examples/train_and_evaluate.py [--steps 10000] [--out beams.onnx]

Needs the extra ``learning``. The policy observes the direction to the user, and chooses one of 64 beams.
"""

import argparse
from pathlib import Path

import gymnasium
from stable_baselines3 import DQN

from caviar_clients.learning.evaluate import KINDS, METHODS, evaluate
from caviar_clients.learning.export import export_policy

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--steps", type=int, default=10_000)
parser.add_argument("--out", type=Path, default=Path("beams.onnx"))
options = parser.parse_args()

env = gymnasium.make("caviar:caviar/BeamSelection-v0", scenario="geometric", observe=("aod",))
model = DQN(
    "MultiInputPolicy",
    env,
    gamma=0.0,  # a beam has no influence on the next channel
    learning_rate=1e-3,
    train_freq=4,
    exploration_fraction=0.5,
    seed=1,
)
model.learn(options.steps, progress_bar=False)
card = export_policy(model, env.unwrapped, options.out, steps=options.steps, seeds=(1,))
env.close()
print(f"{options.out}: {card.algorithm}, {options.out.stat().st_size:,} B")

# On seeds that training has not seen; means of |y| with 95 % intervals.
found = evaluate(options.out, "geometric", seeds=range(1000, 1003)).found
for method in METHODS:
    print(f"{method:9} " + "  ".join(f"{kind} {found[method][kind]}" for kind in KINDS))
