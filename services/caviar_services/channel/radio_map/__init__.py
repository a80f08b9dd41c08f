"""Radio maps: what transmitters bring to every cell of a surface, by shooting rays through it.

`cell_gains` shoots rays through the cells of a surface (Sionna RT's radio map solver). `mapping` makes
surfaces over the ground of a scene, and received power, SINR and best server of the gains.
"""
