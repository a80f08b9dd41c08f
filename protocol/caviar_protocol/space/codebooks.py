"""Codebooks: the beams that an antenna array has, which one points where, and its gain.

Beam ``k`` of an array is a unit-norm vector c_k in element order. It is matched to waves from the direction
it points to: a receiver combines with ``w = c_k``, a transmitter precodes with ``f = conj(c_k)``, so that
one index means one direction at both ends. With eq. (1) of the paper, ``y = w* H f``, a single path of
amplitude a that lies on the DFT grids of both arrays gives ``|y| = sqrt(Nr·Nt)·|a|``.

`AntennaArray.codebook` names the codebook of an array, what it is made with after a colon: ``dft``,
``quantized:2``, ``file:beams.npy``, or the name of a plug-in. The codebook of an array with several subarrays
(panels, polarizations) is that of each of them, block by block: a beam has the elements of one subarray.
|y| of all pairs of two arrays has `caviar_protocol.space.beams.beam_gains`.
"""

from __future__ import annotations

import hashlib
import io
import math
import re
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np

from caviar_protocol.arrays import Complex128Array, Float64Array, Int64Array
from caviar_protocol.errors import ScenarioError, suggestion
from caviar_protocol.plugins import plugin_class, plugins
from caviar_protocol.space.antenna_arrays import (
    Subarray,
    beam_gain,
    beam_towards,
    dft_beam,
    dft_codebook,
    facing,
    pointing_directions,
    steering_vector,
    subarrays,
)
from caviar_protocol.space.coordinates import rotation_matrix
from caviar_protocol.topics.scene import AntennaArray

DFT = "dft"
"""Name of the codebook of an array that names none."""
FILE = "file:"
"""What the name of a codebook from a file begins with."""
CODEBOOK_PLUGINS = "caviar.codebooks"
"""Group of entry points, each a subclass of `Codebook`."""
UNIT_NORM = 1e-5
"""Deviation of a beam's norm from 1 that a codebook may have: files hold single precision."""


class Codebook(ABC):
    """The beams of one array.

    A subclass defines `block`: the beams of one uniform subarray. All else follows from these vectors.

    Args:
        array: The array, uniform or of several panels or polarizations.
        argument: What stands after the colon in `AntennaArray.codebook`.

    Raises:
        ScenarioError: The argument is wrong, or vectors are no codebook of the array; raised by any method.

    Example:
        >>> class Switched(Codebook):
        ...     def block(self):
        ...         return np.eye(self.uniform.size)  # a beam for each element
        >>> Switched(AntennaArray(columns=2, polarization="VH")).vectors.shape
        (4, 4)
    """

    def __init__(self, array: AntennaArray, argument: str = "") -> None:
        self.array, self.argument = array, argument
        self.parts = subarrays(array)
        self.uniform = self.parts[0].array

    @abstractmethod
    def block(self) -> Complex128Array:
        """Compute the beams of one subarray, `uniform`.

        Returns:
            Shape ``[K, N]``, each row of norm 1, N elements in their order (`element_positions`).
        """

    @cached_property
    def _block(self) -> Complex128Array:
        found: Any = np.asarray(self.block())
        elements = self.uniform.size
        if found.ndim != 2 or not len(found) or found.shape[1] != elements or found.dtype.kind not in "fc":
            raise self._error(
                f"is an array of {found.dtype} of the shape {found.shape}; write real or complex numbers "
                f"of the shape [K, {elements}], a row for each beam of {elements} elements"
            )
        norms = np.linalg.norm(found, axis=1)
        wrong = np.flatnonzero(~(np.abs(norms - 1) <= UNIT_NORM))
        if wrong.size:  # so where a number is not finite
            k = int(wrong[0])
            raise self._error(f"has beam {k} of norm {norms[k]:.6g}; divide each row by its norm")
        vectors: Complex128Array = found.astype(np.complex128)
        return vectors

    def _error(self, text: str) -> ScenarioError:
        path, _, _ = self.array.codebook.partition("#" + codebook_digest(self.array))
        return ScenarioError(f"{self.array.codebook if path == FILE else path!r} {text}")

    @property
    def beams(self) -> int:
        """Number of beams."""
        return len(self._block) * len(self.parts)

    @cached_property
    def vectors(self) -> Complex128Array:
        """All beams: row ``k`` is c_k, Shape ``[K, N]``."""
        found: Any = np.kron(np.eye(len(self.parts)), self._block)
        return found  # type: ignore[no-any-return]

    def vector(self, beam: int) -> Complex128Array:
        """One beam c_k, Shape ``[N]``."""
        found: Complex128Array = self.vectors[beam]
        return found

    def part_of(self, beam: int) -> tuple[Subarray, int]:
        """The subarray that a beam is of, and the beam's index in that subarray's own codebook."""
        number, own = divmod(beam, self.beams // len(self.parts))
        return self.parts[number], own

    def gain(self, beam: int, directions: Float64Array) -> Float64Array:
        """Amplitude of a beam towards directions, 1 where all elements of its subarray add in phase.

        Args:
            beam: Index of the beam.
            directions: Unit vectors k̂ in device axes, Shape ``[..., 3]``.

        Returns:
            ``|c_k* a(k̂)| / sqrt(N)`` with the N elements of the subarray, Shape ``[...]``.
        """
        part, own = self.part_of(beam)
        response = steering_vector(part.array, directions @ rotation_matrix(part.orientation))
        found: Float64Array = np.abs(response @ self._block[own].conj()) / math.sqrt(part.array.size)
        return found

    def beam_towards(self, direction: Sequence[float], polarization: int = 0) -> int:
        """Find the beam with the greatest ``|c_k* a(k̂)|`` towards a direction.

        Args:
            direction: Unit vector in device axes.
            polarization: Which of dual polarizations, by its index.

        Returns:
            Index of the beam: of several panels one of the panel that faces the direction most, of beams with
            equal gain the one of lowest index.
        """
        number, part = facing(self.array, direction, polarization)
        response = steering_vector(part.array, np.array(part.towards(direction)))
        return number * len(self._block) + int(np.argmax(np.abs(self._block.conj() @ response)))

    def pointing_directions(self, beam: int) -> Float64Array:
        """The directions that a beam is made for, where these are known.

        Args:
            beam: Index of the beam.

        Returns:
            Unit vectors in device axes, Shape ``[L, 3]``; none for vectors that come without directions.
        """
        return np.zeros((0, 3))


class DftCodebook(Codebook):
    """DFT beams, as many as elements: orthonormal, and known without forming a vector.

    Example:
        >>> codebook_of(AntennaArray(columns=4)).beam_towards((0.866, 0.5, 0.0))
        1
    """

    def __init__(self, array: AntennaArray, argument: str = "") -> None:
        super().__init__(array, argument)
        if array.codebook.partition(":")[1]:
            raise self._error('has something after the colon; write "dft"')

    def block(self) -> Complex128Array:
        """`dft_codebook` of a subarray."""
        return dft_codebook(self.uniform)

    @property
    def beams(self) -> int:
        """A beam for each element."""
        return self.array.size

    def vector(self, beam: int) -> Complex128Array:
        """`dft_beam`."""
        return dft_beam(self.array, beam)

    def gain(self, beam: int, directions: Float64Array) -> Float64Array:
        """`beam_gain`."""
        return beam_gain(self.array, beam, directions)

    def beam_towards(self, direction: Sequence[float], polarization: int = 0) -> int:
        """`beam_towards`."""
        return beam_towards(self.array, direction, polarization)

    def pointing_directions(self, beam: int) -> Float64Array:
        """`pointing_directions`."""
        return pointing_directions(self.array, beam)


class QuantizedCodebook(Codebook):
    """DFT beams with phase shifters of b bits: each phase is the nearest multiple of 2π/2^b.

    Amplitudes stay ``1/sqrt(N)``. In the mean over evenly distributed phase errors the power gain of a beam
    towards its centre is sinc²(1/2^b) of that of the DFT (Wu and Zhang, "Beamforming optimization for
    wireless network aided by intelligent reflecting surface with discrete phase shifts", IEEE Trans. Commun.
    68(3), 2020, proposition 1).

    Args:
        array: As of `Codebook`.
        argument: The bits b, from 1 to 16.

    Example:
        >>> codebook_of(AntennaArray(columns=4, codebook="quantized:1")).vector(1).real.tolist()
        [0.5, -0.5, -0.5, 0.5]
    """

    def block(self) -> Complex128Array:
        """Round the phases of `dft_codebook`."""
        if not (self.argument.isdecimal() and 1 <= int(self.argument) <= 16):
            raise self._error('names no bits of its phase shifters; write "quantized:BITS", from 1 to 16')
        rows, columns = self.uniform.rows, self.uniform.columns
        size, levels = rows * columns, 2 ** int(self.argument)
        q, p = np.divmod(np.arange(size), rows)
        # In whole numbers, in turns·N: a phase between two levels goes up, whatever rounding does elsewhere.
        turns: Int64Array = (np.outer(q, q) % columns * rows + np.outer(p, p) % rows * columns) % size
        level = (2 * turns * levels + size) // (2 * size) % levels
        found: Complex128Array = np.exp(2j * np.pi * level / levels) / math.sqrt(size)
        return found

    def pointing_directions(self, beam: int) -> Float64Array:
        """`pointing_directions` of the DFT beam that is rounded."""
        return pointing_directions(self.array, beam)


class FileCodebook(Codebook):
    """Beams of a file: of ``.npy``, or the one array of an ``.npz``, Shape ``[K, N]``.

    N elements of one panel and polarization. The name that the loader of scenarios makes of ``file:PATH`` has
    the file's SHA-256 after a ``#``: it alone stands for the beams, on machines without the path too
    (`add_codebook_files`).
    """

    def block(self) -> Complex128Array:
        """The matrix of the file.

        Raises:
            ScenarioError: It is not here, has changed, or is no matrix.
        """
        digest = codebook_digest(self.array)
        path = self.argument.removesuffix(f"#{digest}")
        if not (path and digest) and digest not in _FILES:
            raise self._error(
                f"is not here; the run or the recording has {CODEBOOKS_FOLDER}{digest or 'SHA-256'}"
            )
        if digest not in _FILES and named_by_content(FILE + path) != self.array.codebook:
            raise self._error("has another SHA-256 now than the scenario has; restore the file")
        try:
            loaded: Any = np.load(io.BytesIO(_FILES[digest]), allow_pickle=False)
            if isinstance(loaded, Mapping):
                (loaded,) = loaded.values()
        except (ValueError, EOFError, OSError, BadZipFile) as error:
            raise self._error("is no .npy, and no .npz of one array of numbers") from error
        return loaded  # type: ignore[no-any-return]  # `_block` looks what it is


CODEBOOKS: Mapping[str, type[Codebook]] = {
    DFT: DftCodebook,
    "quantized": QuantizedCodebook,
    "file": FileCodebook,
}
"""Codebooks by the word before the colon; those of plug-ins are registered in `CODEBOOK_PLUGINS`."""

CODEBOOKS_FOLDER = "codebooks/"
"""What the names of assets begin with that are files of codebooks; the SHA-256 follows."""
# Bytes by SHA-256: what a file holds stays what its name says, so that runs of one process share them.
_FILES: dict[str, bytes] = {}


# Arrays are few and frozen; link and agents ask in every frame.
@lru_cache(maxsize=256)
def codebook_of(array: AntennaArray) -> Codebook:
    """The codebook of an array.

    Args:
        array: Names it.

    Raises:
        ScenarioError: There is none of this name; the text has those there are.
        DeclarationError: A plug-in cannot be loaded, or is no `Codebook`.

    Example:
        >>> codebook_of(AntennaArray(rows=2, columns=4)).beams
        8
    """
    name, _, argument = array.codebook.partition(":")
    cls = CODEBOOKS.get(name) or plugin_class(CODEBOOK_PLUGINS, name, Codebook)  # type: ignore[type-abstract]  # compared, never made
    if cls is None:
        known = suggestion(name, [*CODEBOOKS, *plugins(CODEBOOK_PLUGINS)])
        raise ScenarioError(f"{array.codebook!r} is no codebook; {known}")
    return cls(array, argument)


def beam_count(array: AntennaArray) -> int:
    """Number of beams of an array's codebook."""
    return codebook_of(array).beams


def codebook_digest(array: AntennaArray) -> str:
    """SHA-256 of the file that an array's beams come from; empty: from no file."""
    found = re.fullmatch(r"file:.*#([0-9a-f]{64})", array.codebook)
    return found[1] if found else ""


def named_by_content(codebook: str) -> str:
    """Read the file of a codebook, and add its SHA-256 to its name.

    Args:
        codebook: ``file:`` and an absolute path.

    Returns:
        ``file:PATH#SHA-256``.

    Raises:
        ScenarioError: The file cannot be read.
    """
    try:
        content = Path(codebook.removeprefix(FILE)).read_bytes()
    except OSError as error:
        raise ScenarioError(f"{codebook!r} cannot be read: {error.strerror}") from error
    digest = hashlib.sha256(content).hexdigest()
    _FILES[digest] = content
    return f"{codebook}#{digest}"


def codebook_file(array: AntennaArray) -> bytes | None:
    """The file that an array's beams come from; None where it is not here, or there is none."""
    digest = codebook_digest(array)
    if digest and digest not in _FILES:
        try:
            codebook_of(array).block()
        except ScenarioError:
            return None
    return _FILES.get(digest)


def add_codebook_files(files: Iterable[Path]) -> None:
    """Make known files of codebooks that came from elsewhere: from a broker, with a recording.

    Args:
        files: The files, of any name.

    Raises:
        ScenarioError: One cannot be read.
    """
    for file in files:
        named_by_content(f"{FILE}{file}")
