"""Pictures of a recording, one file each: `map`, `fig8`, `lidar`.

They know payloads and nothing of services; ``cli/plot.py`` puts recording, scenery and beams
together. Matplotlib is imported where a figure is drawn.
"""
