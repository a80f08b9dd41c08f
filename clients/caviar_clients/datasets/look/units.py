"""Times and rates of the page of a dataset, in units in which they are numbers that people read."""

from __future__ import annotations

_SMALL = ((0.1, 1.0, "s"), (1e-4, 1e-3, "ms"), (1e-7, 1e-6, "µs"), (1e-10, 1e-9, "ns"), (0.0, 1e-12, "ps"))
_LONG = ((3 * 3600.0, 3600.0, "h"), (180.0, 60.0, "min"))
_RATES = ((0.1, 1.0, "s"), (0.1 / 60, 60.0, "min"), (0.0, 3600.0, "h"))


def time_unit(seconds: float) -> tuple[float, str]:
    """Choose the unit of times up to this one [s]: how many seconds it has, and its name.

    Example:
        >>> time_unit(7200.0), time_unit(0.25), time_unit(2.5e-8), time_unit(0.0)
        ((60.0, 'min'), (1.0, 's'), (1e-09, 'ns'), (1.0, 's'))
    """
    for least, unit, name in (*_LONG, *_SMALL):
        if seconds >= least and seconds > 0.0:
            return unit, name
    return 1.0, "s"


def small_time_unit(seconds: float) -> tuple[float, str]:
    """Choose the unit as `time_unit` does, seconds at most.

    Example:
        >>> small_time_unit(7200.0)
        (1.0, 's')
    """
    return time_unit(min(seconds, 1.0))


def time_text(seconds: float) -> str:
    """Say a time in the scenes' own clock, with four digits.

    Example:
        >>> time_text(0.3), time_text(0.001), time_text(30.0), time_text(0.0)
        ('0.3 s', '1 ms', '30 s', '0 s')
    """
    unit, name = small_time_unit(seconds)
    return f"{seconds / unit:.6g} {name}"


def rate_unit(per_second: float) -> tuple[float, str]:
    """Choose the time to which a rate refers: how many seconds it has, and its name.

    Example:
        >>> rate_unit(4.2), rate_unit(0.02), rate_unit(1e-4)
        ((1.0, 's'), (60.0, 'min'), (3600.0, 'h'))
    """
    return next((unit, name) for least, unit, name in _RATES if per_second >= least)
