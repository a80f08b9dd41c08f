"""``caviar doctor``: what this machine has, and the command that mends what it lacks.

Libraries that could take the process down with them (Dr.Jit with an old LLVM aborts) are tried
in a process of their own; versions are read from package metadata.
"""

from __future__ import annotations

import importlib.util
import os
import resource
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Mapping
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

import zmq
from packaging.requirements import Requirement
from rich.console import Console
from rich.table import Column, Table

from caviar_clients.cli.scenarios import extras_of
from caviar_clients.cli.shared import print_line
from caviar_clients.cli.summary import recorded_figures
from caviar_clients.session.embedded import EmbeddedRun
from caviar_clients.session.prepared import prepare
from caviar_protocol.errors import CaviarError, SetupError
from caviar_protocol.files import PrivateFolder
from caviar_protocol.host import DISTRIBUTION, PYTHON, install_command
from caviar_protocol.scenario import load_scenario, shipped_scenarios
from caviar_services import drjit_setup

EXTRAS = (
    "channel",
    "sensors",
    "world",
    "plot",
    "datasets",
    "policy",
    "panda3d",
    "mavlink",
    "mujoco",
    "system",
    "learning",
)
MINIMUM_PYTHON = (3, 11)
MINIMUM_FREE_GB = 2.0
MINIMUM_FILES = 1024

SUMO_LIBRARIES = "sudo apt-get install -y libx11-6 libxext6 libxrender1 libgl1 libatomic1 libexpat1"

# A kernel with a floating-point maximum, the instruction that LLVM before 16 cannot select.
_KERNEL = """
import drjit as dr
from drjit.llvm import Float
x = dr.arange(Float, 64)
print(dr.sum(dr.maximum(dr.sin(x), 0.5))[0])
"""

FRAME_DIGESTS = {
    "bcc5e9da09faa7a27a118a76526a9713645f14428dca010e48b8de901d7f33ed": "AVX-512",
    "538d5611c3e701d80d6fc95516fec6a5b5b9cb360785e18cf4fb4d0601b1a336": "AVX2",
    "d511d480b3f03ac518d71ceaf09d437d109d9502ff4205bae405c93630e773b9": "SSE",
}
"""Digests of two frames of `smoke`, by the instructions for which NumPy and OpenBLAS round: kernels for wider
registers sum in another order."""
FRAME_ABS_Y = 0.00011088124487901756
"""Mean |y| of these frames, which another order of sums changes in its 16th digit."""
ABS_Y_TOLERANCE = 1e-12

_SUMO = "import libsumo; print(libsumo.getVersion()[1])"


@dataclass(frozen=True)
class Check:
    """One thing looked at."""

    name: str
    ok: bool
    found: str
    """What there is, or what is wrong with it."""
    remedy: str = ""
    """The command that mends it; empty where it is ok."""
    extra: str = ""
    """The extra that brings it, where the base install does without."""


def doctor() -> list[Check]:
    """Look at everything that a shipped scenario needs.

    It takes a few seconds and imports nothing heavy.

    Returns:
        What was found, in the order of the table.
    """
    checks = [check_python(), check_base()]
    checks += [check_frames()]
    checks += [check_extra(extra) for extra in EXTRAS]
    checks += [check_llvm(), check_gpu(), check_sumo(), check_zmq(), check_loopback()]
    checks += [check_disk(Path.cwd()), check_kernel_cache(Path.home()), check_open_files()]
    return checks


def warm(console: Console) -> None:
    """Compile the loops of enumerated channels into Numba's cache, where they are not there yet.

    Args:
        console: Where the progress goes.

    Raises:
        SetupError: Numba is not installed.
    """
    from caviar_services.channel.enumeration.compiled_loops import compile_loops

    with console.status("compiling the channel's loops") as shown:
        compile_loops(lambda number, count: shown.update(f"compiling loop {number + 1} of {count}"))
    console.print("loops of enumerated channels are compiled")


def exit_status(checks: list[Check]) -> int:
    """Work out the exit status: 1 where something is wrong. An extra that is not installed is optional."""
    return 0 if all(check.ok or check.extra for check in checks) else 1


def render(checks: list[Check], console: Console) -> None:
    """Print the checks as a table, and below it the commands that mend what is wrong."""
    columns = ("", Column("what", no_wrap=True), Column("found", overflow="fold"))
    table = Table(*columns, box=None, pad_edge=False)
    for check in checks:
        mark = "[green]ok[/]" if check.ok else "[yellow]optional[/]" if check.extra else "[bold red]--[/]"
        table.add_row(mark, check.name, check.found)
    console.print(table)
    wrong = [check for check in checks if not check.ok and not check.extra]
    lacking = {check.extra for check in checks if not check.ok and check.extra}
    for check in wrong:
        console.print(f"\n[bold red]{check.name}[/]: mend it with")
        print_line(console, f"  {check.remedy}")
    if not wrong:
        console.print(f"\n{_readiness(lacking)}")
    if lacking:
        names = [extra for extra in EXTRAS if extra in lacking]
        console.print(f"\nNot installed, and optional: {', '.join(names)}. To add all of it:")
        print_line(console, f"  {install_command(*names)}")
        # What pip does not bring, as the LLVM of the ray tracer.
        own = {check.remedy for check in checks if not check.ok and check.extra}
        for remedy in sorted(own - {install_command(extra) for extra in lacking}):
            print_line(console, f"  {remedy}")


def _readiness(lacking: AbstractSet[str]) -> str:
    """Say which shipped scenarios run without some extras, on a machine where nothing else is wrong."""
    needs = {name: extras_of(load_scenario(path)) for name, path in shipped_scenarios().items()}
    short = [extras for extras in needs.values() if lacking & {*extras}]
    if not short:
        return f"Ready: all {len(needs)} shipped scenarios run here."
    extras = ", ".join(extra for extra in EXTRAS if extra in set().union(*short) & {*lacking})
    return (
        f"Ready: {len(needs) - len(short)} of the {len(needs)} shipped scenarios run here; the others need "
        f"{extras} (`caviar scenarios` says which)."
    )


def check_python() -> Check:
    """Check the version of the interpreter."""
    version = ".".join(map(str, sys.version_info[:3]))
    remedy = "sudo apt-get install -y python3.11 python3.11-venv && make clean setup PYTHON=python3.11"
    return _check("Python", sys.version_info >= MINIMUM_PYTHON, f"{version} ({sys.executable})", remedy)


def check_base() -> Check:
    """Check the packages that every part needs."""
    return _check_requirements("base install", "")


def check_frames() -> Check:
    """Check that the base install computes, and computes the right thing: two frames of `smoke`, here."""
    remedy = f"{sys.executable} -m pip install --upgrade --upgrade-strategy eager {DISTRIBUTION}"
    try:
        with PrivateFolder("doctor") as folder:
            smoke = prepare(shipped_scenarios()["smoke"], frames=2)
            outcome = EmbeddedRun(smoke, folder.path).run()
            figures = recorded_figures(folder.path)
            abs_y = (figures.link.mean_abs_y if figures and figures.link else None) or 0.0
    except Exception as error:  # anything: a dependency that does not fit raises what it likes
        text = str(error) if isinstance(error, CaviarError) else f"{type(error).__name__}: {error}"
        return Check("frames", False, text, remedy)
    if outcome.error:
        return Check("frames", False, outcome.error, remedy)
    rounding = FRAME_DIGESTS.get(outcome.digest)
    if rounding:
        return Check("frames", True, f"two frames of smoke have a known digest ({rounding})")
    # Another order of sums changes the digest and no result.
    off = abs(abs_y / FRAME_ABS_Y - 1)
    if off <= ABS_Y_TOLERANCE:
        found = f"two frames of smoke are right, rounded in a way of their own: digest {outcome.digest:.12}…"
        return Check("frames", True, f"{found}; digests of this machine compare with each other only")
    found = f"two frames of smoke have mean |y| {abs_y:.6g}, expected {FRAME_ABS_Y:.6g}"
    return Check("frames", False, f"{found}; digest {outcome.digest:.12}…", remedy)


def check_extra(extra: str) -> Check:
    """Check the packages of one extra."""
    return _check_requirements(f"extra {extra}", extra)


def check_llvm() -> Check:
    """Check the LLVM that the ray tracer would use: that it is there, and compiles."""
    tracer = importlib.util.find_spec("drjit") is not None
    try:
        library = drjit_setup.choose_llvm()
    except SetupError as error:
        if not tracer:
            found = "none, which the extras channel and sensors need"
            return Check("LLVM", False, found, drjit_setup.INSTALL, extra="channel")
        return Check("LLVM", False, str(error), drjit_setup.INSTALL)
    if not tracer:
        return Check("LLVM", True, f"{library}; not tried, Dr.Jit is not installed")
    ok, text = _run([*PYTHON, "-c", _KERNEL], {drjit_setup.ENVIRONMENT: str(library.path)})
    found = f"{library}; compiled a kernel" if ok else f"{library} cannot compile: {text}"
    return _check("LLVM", ok, found, drjit_setup.INSTALL)


def check_gpu() -> Check:
    """Count CUDA devices; none is fine."""
    count = drjit_setup.cuda_devices()
    return Check("CUDA", True, f"{count} device(s)" if count else "none, the CPU computes")


def check_sumo() -> Check:
    """Check that programs and library of the traffic simulator load."""
    spec = importlib.util.find_spec("sumo")
    if spec is None or not spec.submodule_search_locations:
        return Check("SUMO", False, "not installed", install_command("world"), extra="world")
    home = Path(next(iter(spec.submodule_search_locations)))
    for command in ([str(home / "bin" / "netconvert"), "--version"], [*PYTHON, "-c", _SUMO]):
        ok, text = _run(command, {"SUMO_HOME": str(home)})
        if not ok:
            return Check("SUMO", False, f"does not load: {text}", SUMO_LIBRARIES)
    return Check("SUMO", True, f"{text}, SUMO_HOME {home}")


def check_zmq() -> Check:
    """Check that ZeroMQ is here, with encryption."""
    found = f"libzmq {zmq.zmq_version()}, pyzmq {zmq.pyzmq_version()}"
    # Wheels bring a libzmq with CURVE; one that was built here takes what the system has.
    remedy = f"{sys.executable} -m pip install --force-reinstall --only-binary :all: pyzmq"
    encrypts = bool(zmq.has("curve"))
    return _check("ZeroMQ", encrypts, f"{found}, {'with' if encrypts else 'built without'} CURVE", remedy)


def check_loopback() -> Check:
    """Check that services and broker of one machine can talk over TCP."""
    # A container without a network may lack the loopback interface.
    try:
        with socket.create_server(("127.0.0.1", 0)) as server:
            address = server.getsockname()
            socket.create_connection(address, timeout=2.0).close()
    except OSError as error:
        return Check("loopback", False, f"127.0.0.1: {error}", "sudo ip link set lo up")
    return Check("loopback", True, "127.0.0.1 accepts connections")


def check_disk(folder: Path) -> Check:
    """Check the room for recordings, which go to ``runs/`` of a folder."""
    free = shutil.disk_usage(folder).free / 1e9
    remedy = "caviar run SCENARIO --out DIR, with DIR on a larger disk; or delete old runs"
    return _check("disk", free >= MINIMUM_FREE_GB, f"{free:.1f} GB free in {folder}", remedy)


def check_kernel_cache(home: Path) -> Check:
    """Check that compiled kernels can be kept: else every start compiles for seconds."""
    cache = home / ".drjit"
    nearest = cache if cache.exists() else home
    writable = os.access(nearest, os.W_OK | os.X_OK)
    remedy = f"sudo chown -R {os.getuid()} {nearest}; or: export HOME=/a/writable/folder"
    return _check("kernel cache", writable, f"{cache} is {'' if writable else 'not '}writable", remedy)


def check_open_files() -> Check:
    """Check the limit of open files, of which every connection of the broker takes some."""
    soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    unlimited = soft == resource.RLIM_INFINITY
    found = "unlimited" if unlimited else f"at most {soft}"
    return _check("open files", unlimited or soft >= MINIMUM_FILES, found, f"ulimit -n {4 * MINIMUM_FILES}")


def _check(name: str, ok: bool, found: str, remedy: str) -> Check:
    return Check(name, ok, found, "" if ok else remedy)


def _requirements(extra: str) -> list[Requirement]:
    """Requirements of an extra, or with ``""`` of the base install, on this platform."""
    try:
        lines = metadata.requires(DISTRIBUTION) or []
    except metadata.PackageNotFoundError:
        return []
    found = []
    for line in lines:
        requirement = Requirement(line)
        marker = requirement.marker
        # Evaluated for one extra, a marker lets requirements of the base install pass, too.
        belongs = marker is not None and "extra" in str(marker)
        wanted = marker is None or marker.evaluate({"extra": extra})
        if wanted and belongs == bool(extra) and requirement.name != DISTRIBUTION:
            found.append(requirement)
    return found


def _check_requirements(name: str, extra: str) -> Check:
    requirements = _requirements(extra)
    if not requirements and not extra:
        remedy = f"{sys.executable} -m pip install --editable '.[all]'"
        return Check(name, False, f"{DISTRIBUTION} is not installed as a package", remedy)
    unmet, versions, outdated = [], [], False
    for requirement in requirements:
        version = _version(requirement.name)
        if version is None or not requirement.specifier.contains(version, prereleases=True):
            unmet.append(requirement)
            outdated = outdated or version is not None
        versions.append(f"{requirement.name} {version or 'missing'}")
    found = ", ".join(versions)
    if unmet and extra and not outdated:
        return Check(name, False, found, install_command(extra), extra)
    wanted = " ".join(f"'{requirement.name}{requirement.specifier}'" for requirement in unmet)
    return _check(name, not unmet, found, f"{sys.executable} -m pip install {wanted}")


def _version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def _run(command: list[str], environment: Mapping[str, str]) -> tuple[bool, str]:
    """Run a command: whether it succeeded, and the first line that it printed, or why it failed."""
    try:
        # Its own process: Dr.Jit with an LLVM that is too old aborts, and takes this one with it.
        done = subprocess.run(  # noqa: S603 - the commands are those above
            command,
            env={**os.environ, **environment},
            capture_output=True,
            text=True,
            timeout=120,
            check=False,
        )
    except OSError as error:
        return False, str(error)
    except subprocess.TimeoutExpired:
        return False, "no end after 120 s"
    if done.returncode == 0:
        return True, done.stdout.partition("\n")[0].strip()
    last = (done.stderr.strip() or done.stdout.strip()).rpartition("\n")[2]
    how = f"status {done.returncode}"
    if done.returncode < 0:
        how = f"killed by {signal.Signals(-done.returncode).name}"
    return False, f"{how}: {last}" if last else how
