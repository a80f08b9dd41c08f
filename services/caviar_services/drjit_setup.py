"""Needs of Dr.Jit, the compiler of the ray tracer: an LLVM library, threads, and aligned arrays.

Without a CUDA device Dr.Jit needs a libLLVM shared library, which pip does not bring. Left alone it takes
the first that it finds; with versions before 16 the process aborts at its first kernel on machines with
AVX-512. So the library is chosen here, before Dr.Jit is imported.

Left alone, Dr.Jit computes with as many threads as the machine has cores, and each of them looks for work
for a while after every kernel. Services that trace rays side by side then take the cores from one another:
on two cores, in `street-canyon`, the channel's frame took 65 ms of processor time with two threads and 39
ms with one, the LIDAR's 19 ms and 11 ms. So `caviar run` shares the cores out among them.
"""

from __future__ import annotations

import ctypes
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from caviar_protocol.arrays import BoolArray, Float32Array, Float64Array, Int32Array, Int64Array
from caviar_protocol.errors import SetupError

ENVIRONMENT = "DRJIT_LIBLLVM_PATH"
"""Environment variable that Dr.Jit reads when it is imported."""

OLDEST = 16
"""First major version that compiles every kernel."""

INSTALL = "sudo apt-get install -y libllvm19"
"""The command that mends a missing library."""

FOLDERS: tuple[str, ...] = (
    "/usr/lib/llvm-*/lib",
    "/usr/lib/*-linux-gnu",
    "/usr/lib64",
    "/usr/lib",
    "/usr/local/lib",
    "/opt/homebrew/opt/llvm*/lib",
    "/usr/local/opt/llvm*/lib",
)
"""Folders, as patterns, in which a libLLVM is looked for beside the linker's cache."""

# libLLVM-19.so.1 of Debian, libLLVM.so.19.1 of LLVM itself, libLLVM.dylib of macOS, which has no version.
_NAME = re.compile(r"libLLVM(?:-(?P<dashed>\d+(?:\.\d+)*))?\.(?:so|dylib)(?:\.(?P<dotted>\d+(?:\.\d+)*))?$")
_FOLDER = re.compile(r"llvm-(?P<version>\d+)")


@dataclass(frozen=True, order=True)
class LlvmLibrary:
    """A libLLVM shared library.

    Example:
        >>> str(LlvmLibrary((19, 1), Path("/usr/lib/libLLVM.so.19.1")))
        'LLVM 19.1 (/usr/lib/libLLVM.so.19.1)'
    """

    version: tuple[int, ...]
    """Major version first; as many parts as its file name has."""
    path: Path

    def __str__(self) -> str:
        return f"LLVM {'.'.join(map(str, self.version))} ({self.path})"


def choose_llvm(
    environment: Mapping[str, str] = os.environ,
    folders: Sequence[str] = FOLDERS,
    listed: Iterable[str] | None = None,
) -> LlvmLibrary:
    """The library that Dr.Jit shall use: an explicit one first, else the newest that is new enough.

    Args:
        environment: Where `ENVIRONMENT` may name one explicitly.
        folders: Patterns of folders to look in.
        listed: Further candidates; by default those in the linker's cache.

    Raises:
        SetupError: The explicit one does not exist or is too old, or there is none; ends with the command
            that mends it.

    Example:
        >>> choose_llvm({}, folders=(), listed=())
        Traceback (most recent call last):
            ...
        caviar_protocol.errors.SetupError: no libLLVM of version 16 or newer on this machine; the ray tracer \
compiles with it. Install one: sudo apt-get install -y libllvm19
    """
    explicit = environment.get(ENVIRONMENT, "")
    if explicit:
        return _explicit(Path(explicit))
    candidates = [Path(name) for name in (_linker_cache() if listed is None else listed)]
    for folder in folders:
        root = Path(folder).anchor or "."
        for found in Path(root).glob(folder.removeprefix(root)):
            candidates += found.glob("libLLVM*")
    libraries = {_library(path) for path in candidates if path.is_file()} - {None}
    known = sorted(library for library in libraries if library is not None)
    usable = [library for library in known if library.version[0] >= OLDEST]
    if usable:
        return usable[-1]
    instead = f"; found only {', '.join(map(str, known))}" if known else ""
    raise SetupError(
        f"no libLLVM of version {OLDEST} or newer on this machine{instead}; the ray tracer compiles "
        f"with it. Install one: {INSTALL}"
    )


def activate_llvm() -> str:
    """Make Dr.Jit use the chosen library; call before Dr.Jit is imported.

    Where Dr.Jit was imported before, it holds a library already: one that is new enough stays.

    Returns:
        A line that says which library it is.

    Raises:
        SetupError: Dr.Jit holds an older library, or `choose_llvm` refuses.
    """
    held = _held_by_drjit()
    if held is None:
        library = choose_llvm()
        os.environ[ENVIRONMENT] = str(library.path)
        return str(library)
    version = ".".join(map(str, held))
    if not held or held[0] < OLDEST:
        raise SetupError(
            f"Dr.Jit was imported before its library was chosen and holds LLVM {version or 'none'}, the ray "
            f"tracer needs {OLDEST} or newer; before the start: export {ENVIRONMENT}={choose_llvm().path}"
        )
    return f"LLVM {version} (held by Dr.Jit since its import)"


def _held_by_drjit() -> tuple[int, ...] | None:
    """Version of the library that Dr.Jit loaded; None if not imported, or if the environment names one."""
    # Asked of `sys.modules`: an import would load a library, which is what is to be prevented.
    drjit = sys.modules.get("drjit")
    if drjit is None or os.environ.get(ENVIRONMENT):
        return None
    return tuple(drjit.detail.llvm_version() or ())


def choose_variant() -> str:
    """Mitsuba variant of the channel: CUDA where there is a device that answers, else LLVM."""
    return "cuda_ad_mono_polarized" if cuda_devices() else "llvm_ad_mono_polarized"


def cuda_devices(library: str = "libcuda.so.1") -> int:
    """Count the CUDA devices that the driver reports; 0 without a driver.

    Args:
        library: File name of the driver's library.

    Example:
        >>> cuda_devices("no-such-driver.so")
        0
    """
    # The driver itself is asked: Dr.Jit would have to be imported, and with it the library be chosen.
    try:
        driver = ctypes.CDLL(library)
    except OSError:
        return 0
    # A driver without a device, as in a container, is there and answers with an error.
    count = ctypes.c_int(0)
    if driver.cuInit(0) != 0 or driver.cuDeviceGetCount(ctypes.byref(count)) != 0:
        return 0
    return count.value


def _explicit(path: Path) -> LlvmLibrary:
    if not path.is_file():
        raise SetupError(
            f"{ENVIRONMENT} is {str(path)!r}, which is not a file; name an existing libLLVM, or unset it "
            f"and install one: {INSTALL}"
        )
    library = _library(path)
    if library is None:
        return LlvmLibrary(_asked(path), path)
    if library.version[0] < OLDEST:
        raise SetupError(
            f"{ENVIRONMENT} is {str(path)!r}, LLVM {library.version[0]}, the ray tracer needs {OLDEST} or "
            f"newer; unset it and install one: {INSTALL}"
        )
    return LlvmLibrary(library.version, path)


def _library(path: Path) -> LlvmLibrary | None:
    """The library of a file name that has its version; None where it has not."""
    real = path.resolve()  # libLLVM.so is a link to the file whose name has the version
    match = _NAME.match(real.name)
    if match is None:
        return None
    version = match["dashed"] or match["dotted"]
    if version is None:
        folder = _FOLDER.search(str(real.parent))
        if folder is None:
            return None
        version = folder["version"]
    return LlvmLibrary(tuple(int(part) for part in version.split(".")), real)


def _asked(path: Path) -> tuple[int, ...]:
    """Version that a library of unknown name says itself; LLVMGetVersion came with LLVM 16."""
    try:
        tell = ctypes.CDLL(str(path)).LLVMGetVersion
    except (OSError, AttributeError) as error:
        raise SetupError(
            f"{ENVIRONMENT} is {str(path)!r}, which is not an LLVM {OLDEST} or newer ({error}); unset it and "
            f"install one: {INSTALL}"
        ) from error
    parts = [ctypes.c_uint(0) for _ in range(3)]
    tell(*(ctypes.byref(part) for part in parts))
    return tuple(part.value for part in parts)


def _linker_cache() -> list[str]:
    # Debian has it in /sbin, which is not in the PATH of ordinary users.
    ldconfig = shutil.which("ldconfig", path=os.environ.get("PATH", "") + ":/sbin:/usr/sbin")
    if ldconfig is None:
        return []
    listing = subprocess.run([ldconfig, "-p"], capture_output=True, text=True, timeout=10, check=False)  # noqa: S603 - fixed command
    return [line.rpartition("=> ")[2].strip() for line in listing.stdout.splitlines() if "libLLVM" in line]


THREADS_VARIABLE = "CAVIAR_RAY_TRACING_THREADS"
"""Environment variable that says how many; without it they are as many as the cores."""


def cores() -> int:
    """Number of cores that this process may run on: a container may have fewer than the machine."""
    return len(os.sched_getaffinity(0))


def share_of_each(tracers: int) -> int:
    """Share the cores of this machine out among processes that trace rays at once.

    Args:
        tracers: Number of these processes.

    Returns:
        Threads for each of them, 1 at least.

    Example:
        >>> share_of_each(10_000)
        1
    """
    return max(1, cores() // max(1, tracers))


def limited_threads(environment: Mapping[str, str] = os.environ) -> int:
    """Read the number of threads from the environment.

    Args:
        environment: Where `THREADS_VARIABLE` may be.

    Returns:
        The number; 0 where the variable is unset.

    Raises:
        SetupError: The variable is no number from 1 on.

    Example:
        >>> limited_threads({THREADS_VARIABLE: "2"}), limited_threads({})
        (2, 0)
    """
    text = environment.get(THREADS_VARIABLE, "")
    if not text:
        return 0
    if not (text.isascii() and text.isdecimal() and int(text) > 0):
        raise SetupError(f"{THREADS_VARIABLE} is {text!r}; write a number of threads from 1 on, or unset it")
    return int(text)


def limit_threads() -> None:
    """Have the ray tracer compute with as many threads as `THREADS_VARIABLE` says; imports Dr.Jit."""
    import drjit as dr

    # Dr.Jit's own number stands where none is asked for: a service alone on its machine has all cores.
    threads = limited_threads()
    if threads and dr.thread_count() != threads:
        dr.set_thread_count(threads)


@contextmanager
def all_threads() -> Iterator[None]:
    """All cores, for what others wait for before the first frame."""
    import drjit as dr

    before = dr.thread_count()
    if before < cores():
        dr.set_thread_count(cores())
    try:
        yield
    finally:
        if dr.thread_count() != before:
            dr.set_thread_count(before)


def aligned_columns(rows: Float64Array) -> Float32Array:
    """Copy rows as float32, each at a multiple of 64 bytes, with room after it.

    Dr.Jit computes in NumPy's memory where it can, whole vectors of up to 64 bytes at a time, and
    compiles a kernel anew for each combination of arrays that happen to be aligned or not.

    Args:
        rows: Shape ``[R, N]``.

    Returns:
        The same numbers, Shape ``[R, N]``.

    Example:
        >>> [row.ctypes.data % 64 for row in aligned_columns(np.zeros((2, 5)))]
        [0, 0]
    """
    columns: Float32Array = _aligned(rows, np.dtype(np.float32))
    return columns


def aligned_doubles(rows: Float64Array) -> Float64Array:
    """Copy rows as float64, laid out like `aligned_columns`.

    Args:
        rows: Shape ``[R, N]``.
    """
    columns: Float64Array = _aligned(rows, np.dtype(np.float64))
    return columns


def aligned_indices(values: Int64Array | Int32Array | BoolArray) -> NDArray[np.uint32]:
    """Copy indices as uint32, laid out like `aligned_columns`.

    Args:
        values: Shape ``[N]``.
    """
    column: NDArray[np.uint32] = aligned_columns(np.zeros((1, len(values)))).view(np.uint32)[0]
    column[...] = values
    return column


def several(count: int) -> Int64Array:
    """Indices of so many things, a single one twice: to Dr.Jit an array of one element is another kernel.

    Args:
        count: How many.

    Example:
        >>> several(3).tolist(), several(1).tolist()
        ([0, 1, 2], [0, 0])
    """
    return np.arange(count) if count > 1 else np.zeros(2 * count, np.int64)


def _aligned(rows: Float64Array, dtype: np.dtype[Any]) -> NDArray[Any]:
    # One vector more than the rows take, so that the first row can begin at a multiple of 64 bytes, wherever
    # NumPy's memory lies.
    count, size = rows.shape
    of_vector = 64 // dtype.itemsize
    stride = -(-size // of_vector) * of_vector
    buffer = np.zeros(count * stride + of_vector, dtype)
    start = (-buffer.ctypes.data % 64) // dtype.itemsize
    columns = buffer[start : start + count * stride].reshape(count, stride)[:, :size]
    columns[...] = rows
    return columns


def positions(points: Float64Array) -> Any:
    """Copy positions for the ray tracer.

    Args:
        points: [m], Shape ``[N, 3]``.

    Returns:
        A `mitsuba.Point3f` of N points.
    """
    import mitsuba as mi

    return mi.Point3f(*map(mi.Float, aligned_columns(points.T)))
