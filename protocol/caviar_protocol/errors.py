"""Every error that CAVIAR raises on purpose.

::

    CaviarError
    ├── ProtocolError          a peer sent something that the protocol does not allow
    │   ├── DecodeError        bytes that are not the message or payload they claim to be
    │   ├── LimitError         a size or nesting limit was passed
    │   ├── VersionError       the peers share no major version
    │   └── ProductError       a product says what its topic does not allow; names its producer
    ├── PayloadError           our own product is malformed (shape, dtype, non-finite)
    ├── DeclarationError       services do not fit together: cycle, clash, missing source
    ├── ScenarioError          a scenario file is wrong; names file, key, line, remedy
    ├── SetupError             this machine lacks something; names the command that mends it
    ├── AssetError             scenery is missing, or its bytes do not match its digest
    ├── RecordingError         a recording cannot be read as one
    └── RunError               a run ended early; names the culprit

`ProtocolError` is the peer's fault and is answered with a message; the others are ours or
the user's and end a command with a status other than 0.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class CaviarError(Exception):
    """Base of all errors raised on purpose; its text is meant for the user.

    Example:
        >>> from caviar_protocol.scenario import load_scenario
        >>> try:
        ...     load_scenario("smok")
        ... except CaviarError as error:
        ...     print(f"{type(error).__name__}: {str(error).partition('; sc')[0]}")
        ScenarioError: smok: cannot be read: No such file or directory; did you mean 'smoke'?
    """


class ProtocolError(CaviarError):
    """A peer broke the protocol. ``code`` is the word that SPEC.md lists for the ERROR reply."""

    # The word stands in the ERROR that answers the peer; clients compare it, so it never changes.
    code = "protocol"


class DecodeError(ProtocolError):
    """Bytes that do not decode to the message or payload they claim to be."""

    code = "malformed"


class LimitError(ProtocolError):
    """A message, payload, name or nesting depth exceeds a limit of the protocol."""

    code = "limit"


class VersionError(ProtocolError):
    """The peer speaks another major version of the protocol."""

    code = "version"


class ProductError(ProtocolError):
    """A product that another service made cannot be read, or says what its topic does not allow.

    A service that raises it answers with a FAULT that names the producer, on which the run then lays the
    blame.

    Args:
        topic, source, frame: Which product: its topic, the service that made it, and the frame it is for.
        problem: What is wrong: object, field and value, and what would be right.

    Example:
        >>> print(ProductError("scene", "world", 7, "object 'car': dimensions (0, 2, 1) m are not above 0"))
        scene of 'world', frame 7: object 'car': dimensions (0, 2, 1) m are not above 0
    """

    code = "product"

    def __init__(self, topic: str, source: str, frame: int, problem: str) -> None:
        # Apart from the text as well: the runner names the source as culprit of its FAULT.
        self.topic, self.source, self.frame, self.problem = topic, source, frame, problem
        super().__init__(f"{topic} of {source!r}, frame {frame}: {problem}")


class PayloadError(CaviarError):
    """A product built by this process has a wrong shape, dtype or a non-finite value."""


class DeclarationError(CaviarError):
    """The declarations of the services in a run contradict each other."""


class ScenarioError(CaviarError):
    """A scenario file is wrong.

    Args:
        message: What is wrong, naming the value, and what to write instead.
        file: Path of the scenario file.
        key: Dotted key, for example ``services.channel.budget_ms``.
        line: 1-based line of that key, where known.

    Example:
        >>> print(ScenarioError("is 0, write a whole number ≥ 1", "my.toml", "run.frames", 3))
        my.toml:3: run.frames: is 0, write a whole number ≥ 1
    """

    def __init__(self, message: str, file: str = "", key: str = "", line: int | None = None) -> None:
        # Apart from the text as well, so that a caller can give the message another place.
        self.file, self.key, self.line, self.message = file, key, line, message
        # As compilers write it, so that editors and terminals make it a link.
        place = file + (f":{line}" if line is not None else "")
        prefix = ": ".join(part for part in (place, key) if part)
        super().__init__(f"{prefix}: {message}" if prefix else message)


class SetupError(CaviarError):
    """Something this machine needs is not there. The text ends with the command that mends it."""


class AssetError(CaviarError):
    """Scenery is missing or its bytes do not match the digest it was announced with."""


class RecordingError(CaviarError):
    """A file is not a recording of a run, or its content contradicts itself."""


class RunError(CaviarError):
    """A run ended before its last frame. The text names the service, the frame and the phase."""


def one_line(text: str) -> str:
    """Write a text of several lines as one, for logs and tables of which each line is an entry.

    Args:
        text: What an exception says, perhaps one that is not ours.

    Example:
        >>> one_line("shapes differ:\\n\\tweights: 3\\r\\n\\n")
        'shapes differ: / weights: 3'
    """
    return " / ".join(line.strip() for line in text.splitlines() if line.strip())


def suggestion(name: str, known: Iterable[str]) -> str:
    """Say which known name was probably meant, for an error.

    Args:
        name: What was written.
        known: The names that are possible there.

    Returns:
        ``did you mean 'frames'?``, or the known names where none is near.

    Example:
        >>> suggestion("frame", ["frames", "seed"])
        "did you mean 'frames'?"
    """
    names = sorted(known)
    if cased := next((known for known in names if known.lower() == name.lower()), None):
        return f"did you mean {cased!r}?"
    # 0.6 finds one or two wrong letters in a short word, and rarely a word that was not meant.
    near = difflib.get_close_matches(name, names, n=1, cutoff=0.6)
    if near:
        return f"did you mean {near[0]!r}?"
    return f"known: {', '.join(names)}" if names else "none is known here"
