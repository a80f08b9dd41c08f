"""Who may take part, and how much of the broker one peer may use."""
