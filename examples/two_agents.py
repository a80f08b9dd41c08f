"""Two agents in one world: a pilot that delivers to addresses, and beams that follow the UAV.

    python examples/two_agents.py [--seeds 3]

Needs the extra ``learning`` (PettingZoo), and ``world`` or ``channel``: the street is a scene of Sionna RT,
which both bring. Neither agent learns here: the pilot flies over the roofs to the next address, and the beams
point along the straight line, or at random, so that what each of them makes of the other's doing can be seen.
"""

import argparse

import numpy as np

from caviar_clients.envs.pair import UavPairEnv

SIZE_M = np.array([170.0, 100.0, 57.0])
"""Of the box that the scenario lets the UAV fly in."""
OVER_ROOFS = 0.75
"""Height, −1…1 of that box."""


def flown(observation: dict[str, np.ndarray]) -> np.ndarray:
    """Up over the roofs, across, and down to the next address."""
    x, y, z = observation["goal"] * SIZE_M
    across = float(np.hypot(x, y))
    if across <= 5.0:
        return np.array([x / 12, y / 12, np.clip(z / 10, -1, 1)], np.float32)
    if observation["position"][2] < OVER_ROOFS:
        return np.array([0, 0, 1], np.float32)
    speed = min(1.0, across / 20)  # it takes a way to brake
    return np.array([speed * x / across, speed * y / across, 0], np.float32)


parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--seeds", type=int, default=3)
options = parser.parse_args()

env = UavPairEnv("uav-pair", flight={"deliveries": 2, "reach_m": 6.0}, selection={"observe": ("aod",)})
rng = np.random.default_rng(0)
beams = env.action_space("beams").n
for name in ("straight", "random"):
    for seed in range(options.seeds):
        observations, infos = env.reset(seed=seed)
        rewards, frames = {"pilot": 0.0, "beams": 0.0}, 0
        while env.agents:
            straight = round(beams / 2 * np.sin(observations["beams"]["aod"][0])) % beams
            beam = straight if name == "straight" else int(rng.integers(beams))
            actions = {"pilot": flown(observations["pilot"]), "beams": np.int64(beam)}
            observations, step_rewards, _, _, infos = env.step(actions)
            rewards = {agent: rewards[agent] + step_rewards[agent] for agent in rewards}
            frames += 1
        print(
            f"{name:8} seed {seed}: {sum(infos['pilot']['delivered'])} of 2 delivered in {frames / 2:g} s, "
            f"{infos['pilot']['energy_j'] / 1e3:.1f} kJ; pilot's reward {rewards['pilot']:.1f}, "
            f"mean |y| {rewards['beams'] / frames:.2e}"
        )
env.close()
