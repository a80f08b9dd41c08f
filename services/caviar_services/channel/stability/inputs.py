"""NaN and infinity in every number that comes in: each is refused, and the text names the culprit."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

from caviar_protocol.errors import AssetError, CaviarError, PayloadError, ScenarioError
from caviar_protocol.topics import AntennaArray, Scene
from caviar_services.channel.stability.bench import (
    CONDUCTOR,
    Bench,
    Material,
    Model,
    Plate,
    Thing,
    answer,
    antenna,
    link,
    square,
    world,
)
from caviar_services.channel.stability.case import Outcome, case, refused

F = 28e9
BAD = (math.nan, math.inf)

Change = Callable[[float], Scene]


def _antennas(x: float) -> Scene:
    return world([antenna("t", "tx", (0, 0, 9)), antenna("r", "rx", (x, 3, 1))])


def _transmitter(x: float) -> Scene:
    return world([antenna("t", "tx", (0, x, 9)), antenna("r", "rx", (20, 3, 1))])


def _spacing(x: float) -> Scene:
    array = AntennaArray(columns=4, horizontal_spacing=x)
    return world([antenna("t", "tx", (0, 0, 9), array), antenna("r", "rx", (20, 3, 1))])


def _thing(field: str, x: float) -> Scene:
    value = {"position": (x, 0, 0), "velocity": (0, x, 0), "size": (4, 2, x), "quaternion": (1, 0, 0, x)}
    thing = Thing("car", **{"position": (9.0, 9.0, 1.0), field: value[field]})
    return world([antenna("t", "tx", (0, 0, 9)), antenna("r", "rx", (20, 3, 1))], [thing])


SCENES: dict[str, tuple[str, Change]] = {
    "position of a receiver": ("device 'r' has the position", _antennas),
    "position of a transmitter": ("device 't' has the position", _transmitter),
    "spacing of an array": ("device 't' has the element spacing", _spacing),
    "position of an object": ("object 'car' has the position", partial(_thing, "position")),
    "velocity of an object": ("object 'car' has the velocity", partial(_thing, "velocity")),
    "dimensions of an object": ("object 'car' has the dimensions", partial(_thing, "size")),
    "orientation of an object": ("object 'car' has the orientation", partial(_thing, "quaternion")),
}


def _scene(words: str, change: Change, bad: float, rung: str, bench: Bench) -> Outcome:
    models: dict[str, Callable[[], Model]] = {
        "free-space": lambda: bench.free_space(F),
        "geometric": lambda: bench.geometric(F),
        "siso-rt": lambda: bench.traced(F),
    }
    model = models[rung]()
    return refused(PayloadError, words, lambda: answer(model, change(bad)))


for _bad in BAD:
    for _what, (_words, _change) in SCENES.items():
        for _rung in ("free-space", "geometric", "siso-rt"):
            case("input", f"{_bad} in the {_what}, {_rung}", traced=_rung == "siso-rt")(
                partial(_scene, _words, _change, _bad, _rung)
            )


@case("input", "a speed above that of light", traced=False)
def _(bench: Bench) -> Outcome:
    car = Thing("car", (40.0, 0.0, 0.0), velocity=(2.5e8, 2.5e8, 0.0))
    words = "object 'car': velocity (2.5e+08, 2.5e+08, 0) m/s: a finite speed below light's"
    ends = [antenna("t", "tx", (0, 0, 9)), antenna("r", "rx", (20, 3, 1))]
    return refused(PayloadError, words, lambda: answer(bench.free_space(F), world(ends, [car])))


@case("input", "a path gain above 1: 100 MHz, both antennas 5 cm above a conductor")
def _(bench: Bench) -> Outcome:
    model = bench.traced(100e6, [Plate("ground", square(50.0))], {"surface": CONDUCTOR})
    words = "the path from 't' to 'r' by way of ground has a gain of"
    return refused(PayloadError, words, lambda: link(model, (0, 0, 0.05), (0.02, 0, 0.05)))


def _setting(error: type[CaviarError], words: str, make: Callable[[Bench], object], bench: Bench) -> Outcome:
    return refused(error, words, lambda: make(bench))


def _mesh(bad: float, bench: Bench) -> object:
    corners = [*square(50.0)[:3], (-50.0, bad, 0.0)]
    model = bench.traced(F, [Plate("ground", corners)], {"surface": CONDUCTOR})
    return link(model, (0, 0, 9), (20, 3, 1))


def _carrier(bad: float, bench: Bench) -> object:
    return bench.free_space(bad)


def _drawn(bad: float, bench: Bench) -> object:
    return bench.geometric(F, delay_spread_ns=bad)


def _permittivity(bad: float, bench: Bench) -> object:
    return bench.traced(F, [Plate("ground", square(50.0))], {"surface": Material(bad, 0.1)})


def _conductivity(bad: float, bench: Bench) -> object:
    return bench.traced(F, [Plate("ground", square(50.0))], {"surface": Material(3.0, bad)})


SETTINGS: dict[str, tuple[type[CaviarError], str, Callable[[float, Bench], object], bool]] = {
    "the carrier frequency": (ScenarioError, "carrier 'c0' is at", _carrier, False),
    "a setting of the drawn channel": (ScenarioError, "delay_spread_ns", _drawn, False),
    "a material's permittivity": (ScenarioError, "relative_permittivity", _permittivity, True),
    "a material's conductivity": (ScenarioError, "conductivity_s_per_m", _conductivity, True),
    "a vertex of the scenery": (AssetError, "ground.ply: vertex 3 is at", _mesh, True),
}
for _bad in BAD:
    for _what, (_error, _words, _make, _traced) in SETTINGS.items():
        case("input", f"{_bad} in {_what}", traced=_traced)(
            partial(_setting, _error, _words, partial(_make, _bad))
        )
