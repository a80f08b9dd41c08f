"""Access to a run, and the share of the broker that one peer may use."""
