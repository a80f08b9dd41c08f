"""Clients of a run: the `caviar` command and what agents connect with."""
