"""``caviar keys``: make key pairs and authorize them; the key that ``caviar run`` lends its processes."""

from __future__ import annotations

import hashlib
import os
import secrets
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Annotated, cast

import typer

from caviar_protocol import keys as k
from caviar_protocol.errors import SetupError, suggestion
from caviar_protocol.files import PrivateFolder
from caviar_protocol.messages import Role
from caviar_protocol.topics import PAYLOADS

app = typer.Typer()

Directory = Annotated[Path, typer.Option(help="keys directory")]
DEFAULT = Path("keys")


@app.command()
def new(
    name: Annotated[str, typer.Argument(help="of the service, or `broker`", show_default=False)],
    role: Annotated[str | None, typer.Option(help="authorize it for this role as well")] = None,
    directory: Directory = DEFAULT,
) -> None:
    """Make a key pair: NAME.key, which is secret, and NAME.pub."""
    if role is not None:  # all that may be refused is, before there are files
        _free(directory, name)
        _role(role)
    pair = k.Pair.new()
    key, pub = k.write_pair(directory, name, pair)
    typer.echo(f"{key}: secret, stays on its machine\n{pub}: for the others")
    if role is not None:
        _add(directory, k.Authorization(name=name, role=_role(role), public=pair.public))


@app.command()
def authorize(
    file: Annotated[Path, typer.Argument(help="public key, NAME.pub", show_default=False)],
    name: Annotated[str, typer.Option(help="name of the service that it may appear as")],
    role: Annotated[str, typer.Option(help="role that it may take: " + ", ".join(k.ROLES))],
    topics: Annotated[
        str | None, typer.Option(help="topics that it may produce, as a,b; by default all")
    ] = None,
    directory: Directory = DEFAULT,
) -> None:
    """Let a key take part in the runs of the broker of this keys directory."""
    listed = None if topics is None else tuple(topic for topic in topics.split(",") if topic)
    for topic in listed or ():
        if topic not in PAYLOADS:
            raise SetupError(f"--topics {topics}: no topic is named {topic!r}; {suggestion(topic, PAYLOADS)}")
    _free(directory, name)
    public = k.read_public(_where_made(file, directory))
    _add(directory, k.Authorization(name=name, role=_role(role), public=public, topics=listed))


@app.command("list")
def list_keys(directory: Directory = DEFAULT) -> None:
    """Show who may take part, and who may look on over HTTP."""
    rows: list[tuple[str, str, str, str]] = []
    for entry in k.read_authorized(directory):
        topics = "all of its role" if entry.topics is None else ", ".join(entry.topics) or "none"
        rows.append((entry.name, entry.role, f"topics: {topics}", f"key {entry.public}"))
    for held in k.read_tokens(directory):
        rows.append((held.name, held.role, "HTTP token", f"sha256 {held.sha256}"))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        typer.echo("  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)))
    if not rows:
        missing = "" if directory.is_dir() else ", which does not exist"
        typer.echo(f"no key or token is authorized in {directory}{missing}")


@app.command()
def revoke(
    name: Annotated[str, typer.Argument(help="as `caviar keys list` shows it", show_default=False)],
    directory: Directory = DEFAULT,
) -> None:
    """Withdraw a key or a token; a client that takes part with it is cut off within a second."""
    entries, tokens = k.read_authorized(directory), k.read_tokens(directory)
    kept = [entry for entry in entries if entry.name != name]
    kept_tokens = [token for token in tokens if token.name != name]
    if len(kept) == len(entries) and len(kept_tokens) == len(tokens):
        names = ", ".join([e.name for e in entries] + [t.name for t in tokens]) or "none"
        raise SetupError(f"{name!r} is not authorized in {directory}, but: {names}")
    if len(kept) < len(entries):
        k.write_authorized(directory, kept)
    if len(kept_tokens) < len(tokens):
        k.write_tokens(directory, kept_tokens)
    typer.echo(f"{name} is revoked")


@app.command()
def token(
    name: Annotated[str, typer.Argument(help="of who gets it", show_default=False)],
    role: Annotated[
        str,
        typer.Option(
            help="viewer: look on; operator: also give orders; trainer: look on and swap policies; "
            "observer: look on, frames over WebSocket too; or the role of a service"
        ),
    ] = k.VIEWER,
    directory: Directory = DEFAULT,
) -> None:
    """Make a token for the HTTP interface. It is shown once; only its digest is kept."""
    k.check_name(name)
    if role not in k.TOKEN_ROLES:
        raise SetupError(f"no token has the role {role!r}; {suggestion(role, k.TOKEN_ROLES)}")
    tokens = k.read_tokens(directory)
    if any(other.name == name for other in tokens):
        raise SetupError(f"there is a token {name!r} already; revoke it first:  caviar keys revoke {name}")
    text = secrets.token_urlsafe(32)  # 256 bits: no password that could be guessed from its digest
    digest = hashlib.sha256(text.encode()).hexdigest()
    k.write_tokens(directory, [*tokens, k.Token(name=name, role=role, sha256=digest)])
    typer.echo(text)


def _where_made(file: Path, directory: Path) -> Path:
    """``file``; `SetupError` where it is not there but in the keys directory, into which `new` writes."""
    made = directory / file.name
    if not file.exists() and made != file and made.exists():
        raise SetupError(f"{file} does not exist, but {made} does; write  caviar keys authorize {made}")
    return file


def _role(role: str) -> Role:
    if role not in k.ROLES:
        raise SetupError(f"there is no role {role!r}; write one of: {', '.join(k.ROLES)}")
    return cast("Role", role)


def _free(directory: Path, name: str) -> None:
    """Raise `SetupError` where a name is no service's, or is authorized already."""
    k.check_name(name)
    if any(entry.name == name for entry in k.read_authorized(directory)):
        raise SetupError(f"{name!r} is authorized already; revoke it first:  caviar keys revoke {name}")


def _add(directory: Path, entry: k.Authorization) -> None:
    # A key with two names would let a service appear as the other one.
    entries = k.read_authorized(directory)
    for other in entries:
        if other.public == entry.public:
            raise SetupError(
                f"this key is authorized already, as {other.name!r}; make another, or revoke that"
            )
    k.write_authorized(directory, [*entries, entry])
    typer.echo(f"{entry.name} may take part as {entry.role}")


class BorrowedKey:
    """The key pair of all services that a launcher starts, in a folder that only this user can read.

    It is made when it is first needed, so that a run without keys has none, and removed by `close`.

    Args:
        keys: Keys directory of the broker; None: a run without keys.
    """

    def __init__(self, keys: Path | None) -> None:
        self._keys = keys
        self._folder: PrivateFolder | None = None

    @cached_property
    def _pair(self) -> tuple[str, Path]:
        """The public key, and the file of the secret one."""
        self._folder = PrivateFolder("key")
        pair = k.Pair.new()
        secret, _ = k.write_pair(self._folder.path, "run", pair)
        return pair.public, secret

    def environment(self) -> Mapping[str, str]:
        """Make the environment of a service that is started here."""
        if self._keys is None:
            return os.environ
        broker = (self._keys / f"{k.BROKER}.pub").resolve()
        return {**os.environ, k.KEY_VARIABLE: str(self._pair[1]), k.BROKER_KEY_VARIABLE: str(broker)}

    def options(self) -> list[str]:
        """Make the options of the broker's command line: its keys, and the lent key that it accepts."""
        return [] if self._keys is None else ["--keys", str(self._keys), f"--local-key={self._pair[0]}"]

    def close(self) -> None:
        """Remove the key."""
        if self._folder is not None:
            self._folder.cleanup()
