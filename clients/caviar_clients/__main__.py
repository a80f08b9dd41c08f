"""``python -m caviar_clients`` is the `caviar` command."""

from caviar_clients.cli.main import main

if __name__ == "__main__":
    main()
