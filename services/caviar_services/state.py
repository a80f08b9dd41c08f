"""Former name of `caviar_services.checkpoint`."""

from warnings import warn

from caviar_services.checkpoint import Packed, restored, saved

__all__ = ["Packed", "restored", "saved"]

warn("caviar_services.state is now caviar_services.checkpoint", DeprecationWarning, stacklevel=2)
