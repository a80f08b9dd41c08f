"""What methods that users write return, checked where they can still be named."""

from __future__ import annotations

import reprlib
from collections.abc import Iterable
from typing import TypeVar

from caviar_protocol.errors import PayloadError

T = TypeVar("T")


def returned(cls: type[T], value: object, service: object, method: str) -> T:
    """What a method of a service returned, where it is what it has to be.

    Args:
        cls: What it has to be.
        value: What it returned.
        service: The service.
        method: Name of the method.

    Raises:
        PayloadError: It is something else; the text has class and method.

    Example:
        >>> from caviar_services.service import StepResult
        >>> returned(StepResult, None, object(), "step")
        Traceback (most recent call last):
            ...
        caviar_protocol.errors.PayloadError: object.step returned None; return a StepResult
    """
    if not isinstance(value, cls):
        author = f"{type(service).__name__}.{method}"
        raise PayloadError(f"{author} returned {reprlib.repr(value)}; return a {cls.__name__}")
    return value


def series_of(cls: type[T], author: str, values: object) -> list[T]:
    """List the items that a method returned.

    Args:
        cls: What each has to be.
        author: What the method is called in errors: ``Mine.objects_at``.
        values: What it returned.

    Raises:
        PayloadError: It is no series of these; the text has author, value and remedy.

    Example:
        >>> series_of(str, "M.prefixes", "car.")
        Traceback (most recent call last):
            ...
        caviar_protocol.errors.PayloadError: M.prefixes returned 'car.'; return a list of str, or yield them
    """
    # A text is a series of texts, and never what is meant.
    if not isinstance(values, Iterable) or isinstance(values, str | bytes):
        raise PayloadError(
            f"{author} returned {reprlib.repr(values)}; return a list of {cls.__name__}, or yield them"
        )
    found = list(values)
    for item in found:
        if not isinstance(item, cls):
            raise PayloadError(
                f"{author} returned {reprlib.repr(item)} among others; the items have to be {cls.__name__}"
            )
    return found
