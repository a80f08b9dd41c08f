"""Train against a run on another machine: this program takes the agent's place over the network.

Here, make the keys of this program; ``keys/agent.key`` stays on this machine (docs/topics/threat-model.md)::

    caviar keys new agent

On the machine of the world, with a copy of ``keys/agent.pub``::

    caviar keys new broker
    caviar keys authorize agent.pub --name agent --role agent
    caviar new crossing
    sed -i 's/use = "los-beam"/use = "remote"/' crossing.toml
    caviar run crossing.toml --bind tcp://0.0.0.0:5570 --keys keys

and here, with copies of ``crossing.toml`` and of ``keys/broker.pub``, within half a minute::

    python examples/remote_trainer.py crossing.toml tcp://HOST:5570 \\
        --key keys/agent.key --broker-key broker.pub

Needs the base install. It learns in a table, by UCB1 (Auer et al. 2002), which beam pair serves a user best
that is seen in some direction. The run ends with its last episode; ``run.episodes`` says how many there are.
"""

import argparse

import numpy as np

from caviar_clients.envs.base import BeamSelectionEnv
from caviar_protocol.errors import RunError

SECTORS = 24
"""Of the azimuth, each with a line of the table."""

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("scenario", help="the file, or the name of one that ships, as at the broker")
parser.add_argument("broker", help="its address: tcp://HOST:PORT")
parser.add_argument("--users", default="uav/*", help="receivers that are served: one user")
parser.add_argument("--key", help="file with the agent's secret key; none for a broker without keys")
parser.add_argument("--broker-key", help="file with the broker's public key")
parser.add_argument(
    "--wait", type=float, default=30.0, metavar="S", help="for the broker's answer (default: 30)"
)
options = parser.parse_args()

env = BeamSelectionEnv(
    options.scenario,
    broker=options.broker,
    users=options.users,
    observe=("aod",),
    reward="normalised",  # |y| over that of the best pair
    key=options.key,
    broker_key=options.broker_key,
    connect_timeout_s=options.wait,
)
pairs = int(env.action_space.n)
tried, total = np.ones((SECTORS, pairs)), np.ones((SECTORS, pairs))  # each pair once, at its best: optimism
episode = 0
try:
    while True:
        observation, _ = env.reset(seed=1 if episode == 0 else None)
        rewards, is_over = [], False
        while not is_over:
            sector = int((observation["aod"][0] / (2 * np.pi) + 0.5) * SECTORS) % SECTORS
            bound = total[sector] / tried[sector] + np.sqrt(
                0.02 * np.log(tried[sector].sum()) / tried[sector]
            )
            pair = int(bound.argmax())
            observation, reward, _, is_over, _ = env.step(np.int64(pair))
            tried[sector, pair] += 1
            total[sector, pair] += reward
            rewards.append(reward)
        episode += 1
        print(f"episode {episode}: mean |y| {np.mean(rewards):.3f} of the best pair's", flush=True)
except RunError as error:
    print(f"the run is over: {error}" if episode else f"no episode was played: {error}")
    raise SystemExit(0 if episode else 1) from None
finally:
    env.close()
