"""The services of a run: worlds, channel engines, sensors, the link, agents, the recorder."""
