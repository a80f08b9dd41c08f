"""Former name of the part of `caviar_services.link.beam_sweep` that has beam pairs over the band."""

from caviar_services.link.beam_sweep import beam_responses

__all__ = ["beam_responses"]
