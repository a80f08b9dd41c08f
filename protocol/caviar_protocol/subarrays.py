"""Earlier name of `caviar_protocol.space.beams`."""

from caviar_protocol.space.beams import *  # noqa: F403
