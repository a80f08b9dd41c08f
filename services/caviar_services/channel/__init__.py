"""Channel models: from a scene to the paths between its antennas."""
