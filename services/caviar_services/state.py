"""Former name of `caviar_services.checkpoint`, kept for services of other distributions."""

from caviar_services.checkpoint import Packed, restored, saved

__all__ = ["Packed", "restored", "saved"]
