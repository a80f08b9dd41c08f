"""HTTP and WebSocket beside a broker: a process of its own, which talks to the broker's desk only."""
