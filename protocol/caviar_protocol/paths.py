"""Earlier name of `caviar_protocol.multipath`."""

from caviar_protocol.multipath import *  # noqa: F403
