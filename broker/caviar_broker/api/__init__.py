"""Earlier name of `caviar_broker.http`."""
