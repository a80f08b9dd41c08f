"""Numbers of a dataset as people read them, in units that fit."""

from __future__ import annotations


def duration_text(seconds: float) -> str:
    """Say how long something takes.

    Example:
        >>> duration_text(8.25), duration_text(75.0), duration_text(7300.0)
        ('8.2 s', '1 min 15 s', '2 h 1 min')
    """
    if seconds < 60.0:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60} min"


def counted(number: int, what: str, several: str = "") -> str:
    """Name a number of things, with commas between thousands.

    Example:
        >>> counted(1, "scene"), counted(2086, "scene"), counted(2, "process", "processes")
        ('1 scene', '2,086 scenes', '2 processes')
    """
    return f"{number:,} {what if number == 1 else several or what + 's'}"


def bytes_text(size: float) -> str:
    """Say how large something is.

    Example:
        >>> bytes_text(512), bytes_text(98.2e6), bytes_text(1.5e13)
        ('512 B', '98.2 MB', '15 TB')
    """
    if size < 1000.0:
        return f"{size:.0f} B"
    for unit in ("kB", "MB", "GB"):
        size /= 1000.0
        if size < 999.5:
            return f"{size:.3g} {unit}"
    return f"{size / 1000.0:.3g} TB"


def percent(share: float) -> str:
    """Say a share.

    Example:
        >>> percent(0.8123)
        '81.2 %'
    """
    return f"{100.0 * share:.1f} %"


def decimal(value: float, digits: int = 4) -> str:
    """Write a number with so many digits, and with the sign that stands in figures.

    Example:
        >>> decimal(-98.9614), decimal(0.06651234, 2)
        ('−98.96', '0.067')
    """
    return f"{value:.{digits}g}".replace("-", "−")


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
