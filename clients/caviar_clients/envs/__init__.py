"""Environments of gymnasium: importing this registers them.

* ``caviar/BeamSelection-v0``: a beam pair for each user (`base.BeamSelectionEnv`), and many of them computed
  together by ``gymnasium.make_vec`` (`vector.BeamSelectionVectorEnv`);
* ``caviar/RecordedBeams-v0``: a beam pair for one recorded user after the other, single and many together
  (`caviar_clients.learning.recorded`);
* ``caviar/UavPath-v1``: a flight to a goal, or to addresses in any order, in reach of the radio, with a
  reward of comparable parts (`uav_path`);
* ``caviar/RadioStrike-v0``: a user and a beam in each slot, as in the ITU challenge of 2021, single and many
  together (`caviar_labs.radio_strike`, which plays without a run).

`pair.UavPairEnv` is one of PettingZoo: one agent flies, another one chooses the beams.

>>> env = gymnasium.make("caviar/BeamSelection-v0", scenario="geometric")
"""

import gymnasium

# As text: a program loads the environments that it makes, and no others.
gymnasium.register(
    "caviar/BeamSelection-v0",
    "caviar_clients.envs.base:BeamSelectionEnv",
    vector_entry_point="caviar_clients.envs.vector:BeamSelectionVectorEnv",
)
gymnasium.register(
    "caviar/RecordedBeams-v0",
    "caviar_clients.learning.recorded:RecordedBeamsEnv",
    vector_entry_point="caviar_clients.learning.recorded:RecordedBeamsVectorEnv",
)
gymnasium.register("caviar/UavPath-v1", "caviar_clients.envs.uav_path:UavPathEnv")
gymnasium.register(
    "caviar/RadioStrike-v0",
    "caviar_labs.radio_strike.env:RadioStrikeEnv",
    vector_entry_point="caviar_labs.radio_strike.vector_env:RadioStrikeVectorEnv",
)
