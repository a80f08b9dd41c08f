#!/usr/bin/env python
"""make-keys NAME=ROLE...: the broker's keys in /keys/broker, and those of each service in /keys/NAME.

These are volumes of their own, so that no service can read another's. What is there already stays. A pair
that is made anew, since the volume of the one before is gone, takes its place among the authorized.
"""

import sys
from pathlib import Path

from caviar_clients.cli.keys import authorize, new, revoke
from caviar_protocol.files import replace_file
from caviar_protocol.keys import BROKER, read_authorized, read_public

ROOT = Path("/keys")


def pair(name: str) -> Path:
    """The public key of a pair, which is made if need be."""
    folder = ROOT / name
    public = folder / f"{name}.pub"
    if not public.exists():  # it is written after the secret key
        (folder / f"{name}.key").unlink(missing_ok=True)
        new(name, directory=folder)
    return public


def main() -> None:
    """Make what is missing."""
    ours = ROOT / BROKER
    broker = pair(BROKER)
    for argument in sys.argv[1:]:
        name, _, role = argument.partition("=")
        public = pair(name)
        known = {entry.name: entry.public for entry in read_authorized(ours)}
        if known.get(name) != read_public(public):
            if name in known:
                revoke(name, directory=ours)
            authorize(public, name=name, role=role, directory=ours)
        # Its service waits for this file, so it comes last, and in one step.
        replace_file(public.with_name(broker.name), broker.read_bytes())


if __name__ == "__main__":
    main()
