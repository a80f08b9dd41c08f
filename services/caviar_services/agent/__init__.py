"""Agents: they decide, from what they are granted, what the actuators they own shall do."""
