"""Former name of what `caviar_services.link.base` has of users, channels and choices."""

from caviar_services.link.base import User, UserChannels, Users, channels_of, choices_of, users_of

__all__ = ["User", "UserChannels", "Users", "channels_of", "choices_of", "users_of"]
