"""Many environments at once: steps a second of one and of 64, and a rule that is judged on 64 seeds.

    python examples/vector_of_environments.py [--frames 500]

Needs the base install. The members are computed together, as arrays; each is equal, bit by bit, to a single
environment of its seed.
"""

import argparse
import time

import gymnasium
import numpy as np

MEMBERS = 64
NAME, OPTIONS = "caviar:caviar/BeamSelection-v0", {"scenario": "geometric", "observe": ("aod",)}

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--frames", type=int, default=500, help="of each environment")
options = parser.parse_args()

one = gymnasium.make(NAME, **OPTIONS)
one.reset(seed=1)
began = time.perf_counter()
for frame in range(options.frames):
    one.step(frame % 64)
single = options.frames / (time.perf_counter() - began)
one.close()

envs = gymnasium.make_vec(NAME, num_envs=MEMBERS, **OPTIONS)
observations, _ = envs.reset(seed=1)  # member i has the seed 1 + i
rewards = np.zeros((options.frames, MEMBERS))
began = time.perf_counter()
for frame in range(options.frames):
    # The beam of the DFT codebook that points into the azimuth of departure.
    beams = np.round(32 * np.sin(observations["aod"][:, 0])).astype(np.int64) % 64
    observations, rewards[frame], _, _, infos = envs.step(beams)
vector = options.frames * MEMBERS / (time.perf_counter() - began)
envs.close()

print(
    f"{single:,.0f} steps/s of one, {vector:,.0f} of {MEMBERS} together: {vector / single:.0f} times as many"
)
means = rewards.mean(axis=0)
print(f"mean |y| by azimuth alone: {means.mean():.3f}, {means.std(ddof=1):.3f} from seed to seed")
