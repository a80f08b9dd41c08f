"""Numbers of a dataset as people read them."""

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
