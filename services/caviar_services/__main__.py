"""One service as a process: ``python -m caviar_services NAME --use role:implementation --broker URL``."""

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Sequence
from pathlib import Path

from caviar_protocol.errors import CaviarError
from caviar_protocol.host import steady_memory
from caviar_protocol.keys import credentials
from caviar_services.registry import find_modules_in
from caviar_services.runner import CONNECT_TIMEOUT_S, run_service


def serve(
    name: str,
    use: str,
    broker: str,
    connect_timeout_s: float = CONNECT_TIMEOUT_S,
    key: Path | None = None,
    broker_key: Path | None = None,
    *,
    restarted: bool = False,
    modules: Sequence[Path] = (),
) -> int:
    """Run the implementation ``use`` ("role:name") as the service ``name``; the exit status.

    The module of a ``role:module:Class`` is also looked for in the current folder and in ``modules``.
    """
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(name)s %(message)s")
    role, separator, implementation = use.partition(":")
    if not separator:
        sys.stderr.write(f"caviar service: --use {use!r} is not ROLE:NAME, for example world:sumo\n")
        return 2
    if ":" in implementation:
        for folder in (*modules, Path.cwd()):
            find_modules_in(folder)
    steady_memory()
    try:
        found = credentials(key, broker_key)
        return run_service(name, role, implementation, broker, connect_timeout_s, found, restarted=restarted)
    except CaviarError as error:
        sys.stderr.write(f"caviar service {name}: {error}\n")
        return 1


def main() -> int:
    """Parse the command line and serve; the exit status."""
    parser = argparse.ArgumentParser(prog="python -m caviar_services", description=__doc__)
    parser.add_argument("name", help="name of the service in the run")
    parser.add_argument("--use", required=True, metavar="ROLE:NAME", help="registered implementation")
    parser.add_argument("--broker", required=True, metavar="URL", help="tcp://host:port of the broker")
    parser.add_argument(
        "--connect-timeout",
        type=float,
        default=CONNECT_TIMEOUT_S,
        metavar="S",
        help="how long to wait for the broker; it may start later than its services",
    )
    parser.add_argument("--key", type=Path, help="secret key of this service, NAME.key; else $CAVIAR_KEY")
    parser.add_argument(
        "--broker-key", type=Path, help="public key of the broker, broker.pub; else $CAVIAR_BROKER_KEY"
    )
    parser.add_argument(
        "--restarted",
        action="store_true",
        help="this process is started again whenever its status is not 0: status 1 after a run that failed, "
        "0 after SIGTERM",
    )
    parser.add_argument(
        "--modules", type=Path, action="append", default=[], help="folder of the module of ROLE:module:Class"
    )
    arguments = parser.parse_args()
    return serve(
        arguments.name,
        arguments.use,
        arguments.broker,
        arguments.connect_timeout,
        arguments.key,
        arguments.broker_key,
        restarted=arguments.restarted,
        modules=arguments.modules,
    )


if __name__ == "__main__":
    sys.exit(main())
