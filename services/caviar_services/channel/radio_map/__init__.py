"""Radio maps: what transmitters bring to every cell of a surface, by shooting rays through it.

`measurement_surface` says which cells there are, `cell_gains` shoots rays (Sionna RT's radio map solver) and
`coverage` makes received power, SINR and best server of the gains.
"""
