"""Pictures of a recording, a module for each kind.

They know payloads and nothing of services; ``cli/plot.py`` puts recording, scenery and beams
together. Matplotlib is imported where a figure is drawn.
"""
