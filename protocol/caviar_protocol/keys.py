"""Keys of a run: which services may take part, and in which roles.

A keys directory holds, all of them TOML that a person can read:

``NAME.key``
    A secret key with its public one, mode 0600. It never leaves the machine of its owner.
``NAME.pub``
    The public key alone, for handing out.
``broker.key``, ``broker.pub``
    Those of the broker, by which its services recognise it.
``authorized.toml``
    The public keys that may take part, each with its name, role and, if need be, topics.
``tokens.toml``
    SHA-256 of the tokens of the HTTP interface, each with a name and a role.

Keys are CurveZMQ's (Curve25519), 32 B written as 40 characters of Z85 (ZeroMQ RFC 26 and 32).
"""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_args

import msgspec
import zmq
from msgspec import Meta

from caviar_protocol.errors import SetupError
from caviar_protocol.files import replace_file
from caviar_protocol.messages import PeerRole
from caviar_protocol.scenario.toml import key_lines, toml_text

BROKER = "broker"
"""Name of the broker's own pair."""
AUTHORIZED = "authorized.toml"
TOKENS = "tokens.toml"
KEY_VARIABLE, BROKER_KEY_VARIABLE = "CAVIAR_KEY", "CAVIAR_BROKER_KEY"
"""Environment variables with the paths of a service's secret key and of its broker's public one."""
ROLES: tuple[str, ...] = get_args(PeerRole)
VIEWER, OPERATOR, TRAINER, OBSERVER = "viewer", "operator", "trainer", "observer"
TOKEN_ROLES = (VIEWER, OPERATOR, TRAINER, *ROLES)
"""What the holder of a token may be over HTTP."""

Name = Annotated[str, Meta(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}$")]
Z85 = Annotated[str, Meta(pattern=r"^[0-9a-zA-Z.\-:+=^!/*?&<>()\[\]{}@%$#]{40}$")]
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}")


class _Entry(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """Base of all entries: unknown keys are refused."""


class Authorization(_Entry, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """One key that may take part in runs.

    Example:
        >>> key = Pair.new()
        >>> entry = Authorization(name="agent", role="agent", public=key.public, topics=("action",))
        >>> write_authorized(Path("keys"), [entry])
        >>> read_authorized(Path("keys")) == (entry,)
        True
    """

    name: Name
    """Of the service or observer that it may appear as, and of the key itself."""
    role: PeerRole
    public: Z85
    topics: tuple[str, ...] | None = None
    """Topics that it may produce; None: all that its role has."""


class Token(_Entry, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """One token of the HTTP interface.

    Example:
        >>> import hashlib
        >>> text = "of caviar keys token"
        >>> viewer = Token(name="ann", role=VIEWER, sha256=hashlib.sha256(text.encode()).hexdigest())
        >>> viewer.may(OPERATOR), viewer.of_service
        (False, False)
    """

    name: Name
    """Of the user that holds it, or of the service that it is for."""
    role: str
    """``viewer`` may read, ``operator`` may also give every order, ``trainer`` may read and give agents other
    policies; a role of a service, such as ``agent``, may take part through the gateway under that name and in
    that role, and nothing else, but ``observer`` may also read."""
    sha256: Annotated[str, Meta(pattern=r"^[0-9a-f]{64}$")]
    """Of the token's text; the token itself is written nowhere."""

    def may(self, role: str) -> bool:
        """Return whether the token is good for what a viewer, a trainer or an operator does.

        Args:
            role: `VIEWER`, `TRAINER` or `OPERATOR`.
        """
        return self.role in (OPERATOR, role) or (role == VIEWER and self.role in (TRAINER, OBSERVER))

    @property
    def of_service(self) -> bool:
        """True if a service or an observer takes part with it."""
        return self.role in ROLES


class Pair(_Entry, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """A secret key and its public one; its text leaves the secret out.

    Example:
        >>> key = Pair.new()
        >>> len(key.public), key.secret in repr(key)
        (40, False)
    """

    public: Z85
    secret: Z85

    @classmethod
    def new(cls) -> Pair:
        """A new pair."""
        public, secret = zmq.curve_keypair()
        return cls(public=public.decode(), secret=secret.decode())

    # msgspec's own text has all fields.
    def __repr__(self) -> str:
        """Without the secret, which a traceback or a log might show."""
        return f"Pair(public={self.public!r}, secret=…)"


class _Public(_Entry, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    public: Z85


class _AuthorizedFile(_Entry, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    key: tuple[Authorization, ...] = ()


class _TokenFile(_Entry, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    token: tuple[Token, ...] = ()


T = TypeVar("T")


def check_name(name: str) -> str:
    """Check that a key can have this name, and return it.

    Args:
        name: What a key shall be called.

    Raises:
        SetupError: It has other characters than letters, digits, ``_``, ``.`` and ``-``, or more than 64.

    Example:
        >>> check_name("agent-2")
        'agent-2'
    """
    if not _NAME.fullmatch(name):
        raise SetupError(
            f"a key cannot be called {name!r}; write letters, digits, '_', '.', '-', at most 64 of them, "
            "beginning with a letter or digit"
        )
    return name


def write_pair(directory: Path, name: str, pair: Pair) -> tuple[Path, Path]:
    """Write ``NAME.key``, readable by its owner alone, and ``NAME.pub``.

    Args:
        directory: Keys directory, made where it is missing.
        name: Of the service, or `BROKER`.
        pair: The keys.

    Returns:
        The two files.

    Raises:
        SetupError: One of them exists, which stays as it is, or cannot be written.

    Example:
        >>> key, pub = write_pair(Path("keys"), "agent", Pair.new())
        >>> key.name, pub.name, read_pair(key).public == read_public(pub)
        ('agent.key', 'agent.pub', True)
        >>> key.unlink(), pub.unlink()
        (None, None)
    """
    check_name(name)
    key, pub = directory / f"{name}.key", directory / f"{name}.pub"
    # A dangling link does not `exist`, and opening it with O_EXCL would fail with less to say.
    for path in (key, pub):
        if path.exists() or path.is_symlink():
            raise SetupError(f"{path} exists and is not overwritten; choose another name, or remove it first")
    line = f'public = "{pair.public}"\n'
    secret = f"# Secret key of {name!r}: keep it on its machine, and to yourself.\n{line}"
    secret += f'secret = "{pair.secret}"\n'
    public = f"# Public key of {name!r}: for its peers.\n{line}"
    try:
        directory.mkdir(parents=True, exist_ok=True)
        _create(key, secret, 0o600)
        _create(pub, public, 0o644)
    except OSError as error:
        raise SetupError(
            f"cannot write {error.filename}: {error.strerror}; choose another --directory"
        ) from error
    return key, pub


def read_pair(path: Path) -> Pair:
    """Read the key pair in a ``.key`` file.

    Args:
        path: A file ``NAME.key``, of mode 0600.

    Raises:
        SetupError: There is no such file, it is no key, or others on this machine can read it.
    """
    pair = _decoded(path, Pair, "make it with  caviar keys new NAME")
    mode = stat.S_IMODE(path.stat().st_mode)
    # ssh refuses such keys for the same reason: every account of the machine could be this service.
    if mode & 0o077:
        raise SetupError(
            f"{path} holds a secret key, and its mode is {mode:03o}, so that others can read it; "
            f"mend it with  chmod 600 {path}"
        )
    return pair


def read_public(path: Path) -> str:
    """Read the public key in a ``.pub`` file.

    Args:
        path: A file ``NAME.pub``.

    Raises:
        SetupError: There is no such file, it is no key, or it is a file of a secret key.
    """
    remedy = "it is the file NAME.pub that  caviar keys new NAME  writes"
    if path.suffix == ".key":
        # The most likely mistake, and one that would send the secret to another machine.
        raise SetupError(f"{path} holds a secret key, which stays where it is; give the .pub file beside it")
    return _decoded(path, _Public, remedy).public


def read_authorized(directory: Path) -> tuple[Authorization, ...]:
    """Read which keys may take part; none where the directory has no such file yet.

    Args:
        directory: Keys directory of the broker.

    Raises:
        SetupError: The file breaks a rule, or has a name or a key twice.
    """
    # A missing file is an empty one: a broker with keys lets no service in until one is authorized.
    path = directory / AUTHORIZED
    if not path.exists():
        return ()
    entries = _decoded(path, _AuthorizedFile, "mend that line").key
    for what in ("name", "public"):
        values = [getattr(entry, what) for entry in entries]
        for value in values:
            if values.count(value) > 1:
                raise SetupError(
                    f"{path}: the {what} {value!r} stands there twice; remove one of the entries"
                )
    return entries


def write_authorized(directory: Path, entries: Sequence[Authorization]) -> None:
    """Write which keys may take part; a reader sees the old file or the new one, never half of it.

    Args:
        directory: Keys directory of the broker, made where it is missing.
        entries: All keys that may take part.

    Raises:
        SetupError: The file cannot be written.
    """
    heading = (
        "# Keys that may take part in runs of this broker.\n# caviar keys authorize and revoke write it.\n"
    )
    _replace(directory / AUTHORIZED, heading, "key", entries)


def read_tokens(directory: Path) -> tuple[Token, ...]:
    """Read the tokens of the HTTP interface; none where the directory has no such file yet.

    Args:
        directory: Keys directory of the broker.

    Raises:
        SetupError: The file breaks a rule; the text names file and line where a role is unknown.
    """
    path = directory / TOKENS
    if not path.exists():
        return ()
    tokens = _decoded(path, _TokenFile, "mend that line").token
    # Checked here and not by type, so that the error can name the line.
    for number, token in enumerate(tokens):
        if token.role not in TOKEN_ROLES:
            line = key_lines(path.read_text())["token", number, "role"]
            raise SetupError(
                f"{path}, line {line}: {token.name!r} has the role {token.role!r}; "
                f"write one of {', '.join(TOKEN_ROLES)}"
            )
    return tokens


def write_tokens(directory: Path, entries: Sequence[Token]) -> None:
    """Write the tokens' digests.

    Args:
        directory: Keys directory of the broker, made where it is missing.
        entries: All tokens.

    Raises:
        SetupError: The file cannot be written.
    """
    # Digests alone: the file tells a reader no token.
    heading = "# Digests of the tokens that open runs over HTTP. caviar keys token writes it.\n"
    _replace(directory / TOKENS, heading, "token", entries)


class Credentials(msgspec.Struct, frozen=True):
    """The keys of a service and the public key of its broker.

    Args:
        pair: The service's own keys.
        broker: Public key of the broker.

    Example:
        >>> own, broker = Pair.new(), Pair.new()
        >>> with zmq.Context() as context, context.socket(zmq.DEALER) as socket:
        ...     Credentials(own, broker.public).apply_to(socket)
        ...     socket.mechanism == zmq.CURVE
        True
    """

    pair: Pair
    broker: str
    """Public key of the broker."""

    def apply_to(self, socket: zmq.Socket[Any]) -> None:
        """Give a socket what it needs before it connects.

        Args:
            socket: Of the service, not connected yet.

        Raises:
            zmq.ZMQError: The keys are none of CurveZMQ.
        """
        socket.curve_publickey = self.pair.public.encode()
        socket.curve_secretkey = self.pair.secret.encode()
        socket.curve_serverkey = self.broker.encode()


def credentials(
    key: Path | None = None, broker_key: Path | None = None, environment: Mapping[str, str] = os.environ
) -> Credentials | None:
    """Read the credentials of a service.

    Args:
        key: File of its secret key; None: the one that the environment names in ``CAVIAR_KEY``.
        broker_key: File of its broker's public key; None: the one named in ``CAVIAR_BROKER_KEY``.
        environment: Environment variables.

    Returns:
        The keys; None where neither argument nor environment names a file.

    Raises:
        SetupError: Only one of the two is given, or a file is no key.

    Example:
        >>> credentials(environment={}) is None
        True
    """
    # Arguments come before the environment, as with most commands.
    own = key or _path(environment.get(KEY_VARIABLE))
    broker = broker_key or _path(environment.get(BROKER_KEY_VARIABLE))
    if own is None and broker is None:
        return None
    if own is None or broker is None:
        given, missing = ("--broker-key", "--key") if own is None else ("--key", "--broker-key")
        variable = KEY_VARIABLE if own is None else BROKER_KEY_VARIABLE
        raise SetupError(f"{given} is given without {missing} (or {variable}); a broker with keys needs both")
    return Credentials(read_pair(own), read_public(broker))


def _path(text: str | None) -> Path | None:
    return Path(text) if text else None


def _decoded(path: Path, kind: type[T], remedy: str) -> T:
    try:
        return msgspec.toml.decode(path.read_bytes(), type=kind)
    except OSError as error:
        raise SetupError(f"cannot read {path}: {error.strerror}; {remedy}") from error
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        # What the file holds may be secret: only the place and the rule are shown, never the content.
        rule = str(error) if isinstance(error, msgspec.ValidationError) else "it is not TOML"
        raise SetupError(f"{path} is not what it should be: {rule}; {remedy}") from None


def _create(path: Path, text: str, mode: int) -> None:
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
    with os.fdopen(descriptor, "w") as file:
        # The umask may have taken bits of the mode away, or another default may have added some (ACLs).
        os.fchmod(descriptor, mode)
        file.write(text)


def _replace(path: Path, heading: str, table: str, entries: Sequence[msgspec.Struct]) -> None:
    text = f"{heading}\n{toml_text({table: msgspec.to_builtins(entries)})}" if entries else heading
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        replace_file(path, text.encode(), mode=0o600, concurrent=True)
    except OSError as error:
        raise SetupError(f"cannot write {path}: {error.strerror}; choose another --directory") from error
