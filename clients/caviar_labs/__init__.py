"""Laboratories: commands that measure parts of CAVIAR, judge clients, and reproduce what others published.

They may import every other package, and none imports them: a run needs none of it. The entry-point group
``caviar.commands`` makes them commands of `caviar`, as those of any other distribution.
"""
