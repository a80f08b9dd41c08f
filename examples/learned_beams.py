"""Learn beams from one ray-traced flight over Munich, and choose them on another one.

    python examples/learned_beams.py [--frames 200] [--steps 60000] [--out munich.onnx]

Needs the extras ``channel`` and ``learning``. The policy observes the direction to the UAV, and its position.
It is held against the beam along the line of sight, which does not know what stands in the way, on a flight
that passes 1.4 m beside the one that it learned from.
"""

import argparse
from pathlib import Path

import gymnasium
import numpy as np
import torch
from stable_baselines3 import DQN
from stable_baselines3.common.vec_env import VecMonitor

import caviar
from caviar_clients.learning.export import export_policy
from caviar_clients.learning.features import EncodedParts, Encoding
from caviar_clients.learning.vec_env import stable_baselines3_env
from caviar_protocol.scenario import find_scenario

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--frames", type=int, default=200)
parser.add_argument("--steps", type=int, default=60_000)
parser.add_argument("--out", type=Path, default=Path("munich.onnx"))
options = parser.parse_args()


def flown(name: str, aside_m: float, *settings: str) -> Path:
    """Run `uav-munich` with a flight that is further east and north by as much; the directory of the run."""
    shipped = find_scenario(Path("uav-munich"))
    points = np.loadtxt(shipped.parent / "uav-munich" / "flight.csv", delimiter=",", skiprows=5)
    points[:, 1:3] += aside_m
    np.savetxt(f"{name}.csv", points, delimiter=",", header="t_s,x_m,y_m,z_m", comments="")
    scenario = Path(f"{name}.toml")
    scenario.write_text(shipped.read_text().replace("uav-munich/flight.csv", f"{name}.csv"))
    return caviar.run(scenario, frames=options.frames, settings=settings, progress=True)


recordings = [flown("munich-learned", 0.0)]

torch.set_num_threads(1)  # a small network: threads would wait for each other
task = {"recordings": recordings, "observe": ("departure", "position"), "reward": "normalised"}
envs = gymnasium.make_vec("caviar:caviar/RecordedBeams-v0", num_envs=32, autoreset_mode="SameStep", **task)
waves = {  # beams are narrow in these: sines and cosines of the phases along 64 elements, and of the place
    "departure": Encoding(waves=(0, 32, 0)),
    "position": Encoding(offset=(20.0, 140.0, 12.0), scale=(80.0, 100.0, 12.0), waves=4),
}
network = {"features_extractor_class": EncodedParts, "features_extractor_kwargs": {"encodings": waves}}
model = DQN(
    "MultiInputPolicy",
    VecMonitor(stable_baselines3_env(envs)),
    gamma=0.0,  # a beam has no influence on the next channel
    learning_rate=1e-3,
    batch_size=256,
    exploration_fraction=0.5,
    policy_kwargs={**network, "net_arch": [128, 128]},
    seed=1,
)
model.learn(options.steps)
envs.close()
env = gymnasium.make("caviar:caviar/RecordedBeams-v0", **task)
export_policy(model, env.unwrapped, options.out, steps=options.steps, seeds=(1,))
env.close()

policy = ("services.agent.use=policy", f"services.agent.settings.file=file:{options.out.absolute()}")
link = caviar.open(flown("munich-other", 1.0, *policy))["link"]
print("mean of |y| over that of the best pair")
kinds = {"all": link.has_path, "LOS": link.los, "NLOS": link.has_path & ~link.los}
for name, abs_y in {"policy": link.abs_y, "los-beam": link.baseline_abs_y}.items():
    share = abs_y / link.top_abs_y[..., 0]
    print(f"{name:8}", *(f"{kind} {share[mask].mean():.3f}" for kind, mask in kinds.items()))
