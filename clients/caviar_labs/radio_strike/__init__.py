"""Radio-Strike, the beam selection and scheduling game of the ITU AI/ML in 5G Challenge 2021, in NumPy.

`env.RadioStrikeEnv` is one environment, `vector_env.RadioStrikeVectorEnv` many that are computed as a batch;
`rules` has the formulas, `simulation` the game, `draws` its random numbers, `sources` and `trajectories` the
ways of the three users. `docs/howto/radio-strike.md` has a table of the original's defects: what
``rules="legacy"`` does, and what ``rules="fixed"`` does instead.
"""
