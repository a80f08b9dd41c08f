"""The `caviar` command."""
