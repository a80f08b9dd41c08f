"""Key files: who can read them, what they say, and what is refused."""

from __future__ import annotations

import stat
from pathlib import Path

import pytest
import zmq

from caviar_protocol import keys as k
from caviar_protocol.errors import SetupError


def pair() -> k.Pair:
    public, secret = zmq.curve_keypair()
    return k.Pair(public=public.decode(), secret=secret.decode())


def test_a_secret_key_is_readable_by_its_owner_alone_and_comes_back_as_it_was(tmp_path: Path) -> None:
    made = pair()
    key, pub = k.write_pair(tmp_path, "world", made)
    assert stat.S_IMODE(key.stat().st_mode) == 0o600
    assert k.read_pair(key) == made
    assert k.read_public(pub) == made.public
    assert made.secret not in pub.read_text()


@pytest.mark.parametrize("existing", ["world.key", "world.pub"])
def test_a_key_is_never_overwritten(tmp_path: Path, existing: str) -> None:
    (tmp_path / existing).write_text("mine")
    with pytest.raises(SetupError, match="is not overwritten"):
        k.write_pair(tmp_path, "world", pair())
    assert [path.read_text() for path in tmp_path.iterdir()] == ["mine"]


def test_a_secret_key_that_others_can_read_is_refused(tmp_path: Path) -> None:
    key, _ = k.write_pair(tmp_path, "world", pair())
    key.chmod(0o640)
    with pytest.raises(SetupError, match=r"mode is 640.*chmod 600"):
        k.read_pair(key)


def test_a_secret_key_is_not_taken_where_a_public_one_is_asked_for(tmp_path: Path) -> None:
    key, _ = k.write_pair(tmp_path, "world", pair())
    with pytest.raises(SetupError, match=r"give the \.pub file"):
        k.read_public(key)


def test_neither_errors_nor_representations_show_a_secret(tmp_path: Path) -> None:
    made = pair()
    key, _ = k.write_pair(tmp_path, "world", made)
    assert made.secret not in repr(made) + repr(k.Credentials(made, made.public))
    for damaged in (
        f'public = "x"\nsecret = "{made.secret}"',
        f"secret = {made.secret}",
        f'a = "{made.secret}"',
    ):
        key.write_text(damaged)
        with pytest.raises(SetupError) as error:
            k.read_pair(key)
        assert made.secret not in str(error.value)


def test_the_authorized_file_is_replaced_as_a_whole_and_read_back(tmp_path: Path) -> None:
    entries = (
        k.Authorization(name="world", role="world", public=pair().public),
        k.Authorization(name="rx", role="agent", public=pair().public, topics=("action",)),
        k.Authorization(name="mute", role="agent", public=pair().public, topics=()),
    )
    assert k.read_authorized(tmp_path) == ()
    k.write_authorized(tmp_path, entries[:1])
    before = (tmp_path / k.AUTHORIZED).stat().st_ino
    k.write_authorized(tmp_path, entries)
    assert k.read_authorized(tmp_path) == entries
    assert (tmp_path / k.AUTHORIZED).stat().st_ino != before
    assert [path.name for path in tmp_path.iterdir()] == [k.AUTHORIZED]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('[[key]]\nname = "a"\nrole = "agent"\npublic = "short"\n', "public"),
        ('[[key]]\nname = "a"\nrole = "king"\npublic = "{key}"\n', "king"),
        ('[[key]]\nname = "a"\nrole = "agent"\npublic = "{key}"\ntopic = "x"\n', "topic"),
        ('[[key]]\nname = "a"\nrole = "agent"\npublic = "{key}"\n' * 2, "twice"),
        ("[[key", "not TOML"),
    ],
)
def test_an_authorized_file_with_a_mistake_is_refused(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / k.AUTHORIZED).write_text(text.replace("{key}", pair().public))
    with pytest.raises(SetupError, match=words):
        k.read_authorized(tmp_path)


def test_credentials_come_from_files_or_the_environment_and_never_half(tmp_path: Path) -> None:
    own, broker = pair(), pair()
    key, _ = k.write_pair(tmp_path, "rx", own)
    _, pub = k.write_pair(tmp_path, "broker", broker)
    expected = k.Credentials(own, broker.public)
    environment = {k.KEY_VARIABLE: str(key), k.BROKER_KEY_VARIABLE: str(pub)}
    assert k.credentials(key, pub, {}) == expected
    assert k.credentials(environment=environment) == expected
    assert k.credentials(environment={}) is None
    with pytest.raises(SetupError, match="--key is given without --broker-key"):
        k.credentials(key, environment={})
    with pytest.raises(SetupError, match="--broker-key is given without --key"):
        k.credentials(broker_key=pub, environment={})
