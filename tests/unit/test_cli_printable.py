"""What others send is printed as text, and steers no terminal."""

from caviar_clients.files import printable


def test_control_characters_are_written_out() -> None:
    assert printable("enough\x1b[2J\x07 of it: |y| = 1 µV\n") == "enough\\x1b[2J\\x07 of it: |y| = 1 µV\n"
