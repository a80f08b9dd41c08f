"""Environments of gymnasium: importing this registers them.

* ``caviar/BeamSelection-v0``: a beam pair for each user (`beam_selection`);
* ``caviar/UavPath-v1``: a flight to a goal in reach of the radio, with a reward of comparable parts
  (`uav_path_v1`);
* ``caviar/UavPath-v0``: the same with a reward of |y| and metres (`uav_path`), replaced by version 1.

import gymnasium
import caviar_clients.envs

env = gymnasium.make("caviar/BeamSelection-v0", scenario="geometric")
"""

import gymnasium

gymnasium.register("caviar/BeamSelection-v0", "caviar_clients.envs.base:BeamSelectionEnv")
gymnasium.register("caviar/UavPath-v0", "caviar_clients.envs.uav_path:UavPathEnv")
gymnasium.register("caviar/UavPath-v1", "caviar_clients.envs.uav_path_v1:UavPathV1Env")
