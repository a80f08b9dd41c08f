"""Formats of other programs: what CAVIAR's datasets become in them, and what becomes a dataset.

One module a format. `caviar_formats.base` has the class that a format extends, the registry, and the loop
that writes an export; a distribution adds a format by an entry point of the group ``caviar.formats``.
"""
