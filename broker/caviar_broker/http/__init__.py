"""HTTP and WebSocket beside a broker: a process of its own, which asks the broker over its control socket."""
