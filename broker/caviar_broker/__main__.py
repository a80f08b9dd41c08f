"""The broker as a process: ``python -m caviar_broker SCENARIO --bind URL --directory DIR``.

With ``--control`` a launcher talks to it in JSON lines. On standard output come ``listening``,
``notice``, ``frame`` and ``finished`` events; on standard input it takes
``{"lost": SERVICE, "verdict": TEXT}`` and ``{"stop": REASON}``. When the input ends, the run does.
"""

from __future__ import annotations

import argparse
import gc
import sys
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path

import msgspec

from caviar_broker.briefing import briefings, with_ownership
from caviar_broker.control import Control, Reporter, stop_on_signals
from caviar_broker.core.plan import plan_run
from caviar_broker.journal import JournalFile
from caviar_broker.security.access import Access
from caviar_broker.security.local import check_bind
from caviar_broker.server import BrokerServer
from caviar_protocol.errors import CaviarError, RunError
from caviar_protocol.host import steady_memory
from caviar_protocol.scenario_checks import with_overrides
from caviar_protocol.scenario_loader import load_scenario


def tune_collector() -> None:
    """Let the garbage collector look less often: what a frame leaves behind has no cycles, and
    is freed by counting references."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(50_000, 20, 20)


def serve(arguments: argparse.Namespace) -> int:
    """Run the broker; the exit status: 0 exactly if the run came to its end."""
    steady_memory()
    scenario = load_scenario(arguments.scenario)
    scenario = with_ownership(with_overrides(scenario, arguments.frames, arguments.seed))
    access = _access(
        arguments, {name: spec.role for name, spec in scenario.services.items() if not spec.remote}
    )
    check_bind(arguments.bind, keys=access is not None)
    directory = _made(arguments.directory)
    plan = plan_run(scenario, arguments.run or directory.name, briefings(scenario, directory))
    reporter = Reporter(sys.stdout.fileno(), directory / "events.jsonl", arguments.control)
    with closing(JournalFile(directory / "journal.msgpack", plan.epoch)) as journal:
        supervised = arguments.supervised if arguments.control else ()
        server = BrokerServer(plan, arguments.bind, journal, reporter, supervised=supervised, access=access)
        reporter.attach(server)
        if arguments.control:
            Control(server)
        stop_on_signals(server)
        reporter.listening(server.endpoint)
        tune_collector()
        outcome = server.run()
    statistics = server.statistics
    statistics.save(directory / "latency.npz")
    reporter.finished(
        error=outcome.error,
        culprit=outcome.culprit,
        digest=outcome.digest,
        frames=statistics.frames,
        frames_per_second=statistics.frames_per_second(),
        warm_up_frames=statistics.warm_up_frames,
        services={n: msgspec.structs.asdict(s) for n, s in statistics.services().items()},
    )
    if outcome.error and not arguments.control:
        sys.stderr.write(f"caviar broker: {outcome.error}\n")
    return 1 if outcome.error else 0


def _access(arguments: argparse.Namespace, local: Mapping[str, str]) -> Access | None:
    if arguments.keys is None:
        return None
    return Access(arguments.keys, arguments.local_key, local)


def _made(directory: Path) -> Path:
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RunError(
            f"cannot write the run to {directory}: {error.strerror}; choose another --directory"
        ) from error
    return directory.resolve()


def parser() -> argparse.ArgumentParser:
    """Command line of the broker."""
    found = argparse.ArgumentParser(prog="python -m caviar_broker", description=__doc__)
    found.add_argument("scenario", type=Path)
    found.add_argument("--bind", default="tcp://127.0.0.1:5570", help="address to listen on")
    found.add_argument("--keys", type=Path, help="keys directory: who may take part (caviar keys)")
    found.add_argument("--local-key", default="", help="public key of the services that a launcher starts")
    found.add_argument("--directory", type=Path, required=True, help="where the run is written")
    found.add_argument("--run", default="", help="id of the run; by default the directory's name")
    found.add_argument("--frames", type=int, default=None, help="instead of the scenario's")
    found.add_argument("--seed", type=int, default=None, help="instead of the scenario's")
    found.add_argument("--control", action="store_true", help="talk JSON lines with a launcher")
    found.add_argument("--supervised", nargs="*", default=[], help="services the launcher watches itself")
    return found


def main() -> int:
    """Parse the command line and serve; the exit status."""
    try:
        return serve(parser().parse_args())
    except CaviarError as error:
        sys.stderr.write(f"caviar broker: {error}\n")
        return 1


if __name__ == "__main__":
    sys.exit(main())
