"""The control channel of a running broker: its socket, its requests, and its launcher."""
