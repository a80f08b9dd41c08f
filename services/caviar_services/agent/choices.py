"""What an agent chose, checked where its author can still be told: by class, user, value and range."""

from __future__ import annotations

import operator
from collections.abc import Iterable, Sequence
from typing import NoReturn

from caviar_protocol.errors import PayloadError
from caviar_protocol.space.scene import Pair
from caviar_protocol.topics import AntennaDevice, BeamChoice, Carrier

_FORM = "BeamChoice(tx=pair.tx.name, rx=pair.rx.name, tx_beam=…, rx_beam=…)"


def checked_choices(
    author: str, chosen: object, pairs: Sequence[Pair], carriers: Sequence[Carrier] = ()
) -> list[BeamChoice]:
    """Check what an agent's `choose` returned.

    Args:
        author: What the agent's method is called in errors: ``Mine.choose``.
        chosen: What it returned.
        pairs: Transmitter and receiver of each user that the agent serves in the frame.
        carriers: Of the run; empty: the names of carriers are not looked at.

    Returns:
        The choices, sorted by receiver, transmitter and carrier.

    Raises:
        PayloadError: It is no series of `BeamChoice`, or one of them is for a user that the agent does not
            serve, for one that has a choice already, or of a beam that its device does not have. The text
            has author, value, user, range and remedy.

    Example:
        >>> from caviar_protocol.space.scene import pairs_of
        >>> from caviar_services.testing.samples import scene
        >>> pairs = pairs_of(scene(0))
        >>> chosen = (BeamChoice(tx="bs", rx=pair.rx.name, tx_beam=7) for pair in reversed(pairs))
        >>> [choice.rx for choice in checked_choices("Mine.choose", chosen, pairs)]
        ['car.1/rx', 'truck.2/rx']
    """
    if not isinstance(chosen, Iterable):
        raise PayloadError(
            f"{author} returned {_shown(chosen)}; return a list of BeamChoice, one for each pair to be "
            "served, or yield them"
        )
    served = {(pair.tx.name, pair.rx.name): pair for pair in pairs}
    names = {"", *(carrier.name for carrier in carriers)}
    found: dict[tuple[str, str, str], BeamChoice] = {}
    for choice in chosen:
        if type(choice) is not BeamChoice:
            raise PayloadError(f"{author} chose {_shown(choice)}, which is no BeamChoice; write {_FORM}")
        tx, rx, carrier = choice.tx, choice.rx, choice.carrier
        if not (isinstance(tx, str) and isinstance(rx, str) and isinstance(carrier, str)):
            _refuse_name(author, choice)
        pair = served.get((tx, rx))
        if pair is None:
            known = ", ".join(f"{one} → {other}" for one, other in served) or "none"
            raise PayloadError(
                f"{author} chose beams for {_user(choice)}, which it does not serve in this frame; choose "
                f"for the pairs that it is given: {known}"
            )
        twice = found.setdefault((rx, tx, carrier), choice)
        if twice is not choice:
            raise PayloadError(
                f"{author} chose beams for {_user(choice)} twice, {_beams(twice)} and {_beams(choice)}; "
                "write one BeamChoice for each pair and carrier"
            )
        if carriers and carrier not in names:
            known = ", ".join(sorted(names - {""}))
            raise PayloadError(
                f"{author}: carrier={carrier!r} for {tx} → {rx}; the run has: {known}; without a carrier a "
                "choice holds for all"
            )
        _check_beam(author, "tx_beam", choice, pair.tx)
        _check_beam(author, "rx_beam", choice, pair.rx)
    # Sorted, so that equal decisions are equal bytes whatever order an agent makes them in.
    return [found[key] for key in sorted(found)]


def _check_beam(author: str, name: str, choice: BeamChoice, device: AntennaDevice) -> None:
    beam, size = getattr(choice, name), device.array.size
    try:
        if 0 <= operator.index(beam) < size:  # NumPy's whole numbers are right, too
            return
    except TypeError:
        pass
    allowed = f"an int from 0 to {size - 1}, the beams" if size > 1 else "0, the only beam"
    raise PayloadError(
        f"{author}: {name}={_shown(beam)} for {_user(choice)}; write {allowed} of {device.name!r}"
    )


def _refuse_name(author: str, choice: BeamChoice) -> NoReturn:
    values = (("tx", choice.tx), ("rx", choice.rx), ("carrier", choice.carrier))
    name, value = next(entry for entry in values if not isinstance(entry[1], str))
    form = "the carrier's name, a text" if name == "carrier" else f"{name}=pair.{name}.name"
    raise PayloadError(f"{author}: {name}={_shown(value)} is no name; write {form}")


def _user(choice: BeamChoice) -> str:
    return f"{choice.tx} → {choice.rx}" + (f" on carrier {choice.carrier!r}" if choice.carrier else "")


def _beams(choice: BeamChoice) -> str:
    return f"({_shown(choice.tx_beam)}, {_shown(choice.rx_beam)})"


def _shown(value: object) -> str:
    """A value as Python writes it, shortened: an array has thousands of numbers."""
    text = " ".join(repr(value).split())
    return text if len(text) <= 80 else f"{text[:79]}…"
