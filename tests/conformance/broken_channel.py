"""What the channel of `broken_client` makes: that of the kit's own street, with one thing wrong.

The channels of this repository hold the kit's formulas against another implementation: they fail nothing.
"""

from __future__ import annotations

from typing import cast

import numpy as np
from msgspec.structs import replace

from caviar_labs.conform import street
from caviar_protocol.codec import encode_payload
from caviar_protocol.multipath import TAPS_BEFORE


def channel(frame: int, fault: str) -> tuple[bytes, bytes]:
    """Header and body of the channel of a frame; ``fault`` is what is wrong with it, if anything here is."""
    made = street.channel_of(frame, {"h", "hf", "taps"})
    (h,), (hf,), (taps,) = made.h, made.hf, made.taps
    wrong = {
        "leaves hf out": {"hf": ()},
        "leaves taps out": {"taps": ()},
        "forgets a subcarrier": {"hf": (replace(hf, h=hf.h[:, 1:].copy()),)},
        "transposes hf": {"hf": (replace(hf, h=hf.h.swapaxes(2, 3).copy()),)},
        "doubles hf": {"hf": (replace(hf, h=cast("np.ndarray", 2 * hf.h)),)},
        "conjugates h": {"h": (replace(h, h=h.h.conj()),), "hf": (replace(hf, h=hf.h.conj()),)},
        "begins taps at the first path": {"taps": (replace(taps, first=taps.first + TAPS_BEFORE),)},
    }
    return encode_payload(replace(made, **wrong.get(fault, {})))
