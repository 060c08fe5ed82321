"""Types and limits of settings: each dataclass declares them, one function checks them. Imports no torch."""

from __future__ import annotations

import math
from dataclasses import dataclass, is_dataclass
from functools import cache
from numbers import Integral, Number, Real
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

MAX_ROWS = 1 << 26  # of a table or array that comes from elsewhere: 1 GB of coordinates


class LimitError(ValueError):
    """A setting lies outside of its limits, whatever the others are."""


@dataclass(frozen=True)
class Within:
    """An interval that a number must lie in; NaN lies in none.

    >>> print(Within(0, 1))
    lie in [0, 1]
    """

    low: float = -math.inf
    high: float = math.inf
    open_low: bool = False  # whether ``low`` itself is outside
    open_high: bool = False

    def __contains__(self, value: float) -> bool:
        above = self.low < value if self.open_low else self.low <= value
        return above and (value < self.high if self.open_high else value <= self.high)

    def __str__(self) -> str:
        begin, end = "(" if self.open_low else "[", ")" if self.open_high else "]"
        return f"lie in {begin}{self.low:g}, {self.high:g}{end}"


@dataclass(frozen=True)
class Odd:
    """A number of pixels that has a middle one."""

    high: int = 255

    def __contains__(self, value: int) -> bool:
        return 1 <= value <= self.high and value % 2 == 1

    def __str__(self) -> str:
        return f"be odd and lie in [1, {self.high}]"


@dataclass(frozen=True)
class MultipleOf:
    """A positive number of pixels that is a multiple of another."""

    step: int
    high: int

    def __contains__(self, value: int) -> bool:
        return self.step <= value <= self.high and value % self.step == 0

    def __str__(self) -> str:
        return f"be a multiple of {self.step} and lie in [{self.step}, {self.high}]"


Fraction = Annotated[float, Within(0, 1)]
Positive = Annotated[float, Within(0, open_low=True, open_high=True)]
NotNegative = Annotated[float, Within(0, open_high=True)]
Count = Annotated[int, Within(1, 2**31 - 1)]
OddPx = Annotated[int, Odd()]


def check_settings(settings: Any, *, prefix: str = "") -> None:
    """Raise unless every field of a dataclass has a value of its type, within its limits.

    Args:
        settings: an instance whose fields are booleans, numbers, strings of a ``Literal``, tuples of them, nested
            dataclasses, or ``None`` where the annotation allows it; ``Annotated`` adds limits.
        prefix: comes before the name of the field in the message, such as ``"FASTConfig."``.

    Raises:
        TypeError: if a value has another type.
        LimitError: if it has the type but lies outside of the limits, a ValueError.

    >>> from tensor_stereo.configs import FASTConfig
    >>> FASTConfig(window_px=10)
    Traceback (most recent call last):
    ...
    tensor_stereo.limits.LimitError: FASTConfig.window_px must be odd and lie in [1, 255], got 10
    """
    kind: Any = type(settings)
    for name, hint in _hints(kind).items():
        value = getattr(settings, name)
        _check(f"{prefix}{name}", value, hint)
        if isinstance(value, Number) and type(value).__module__ == "numpy":
            object.__setattr__(settings, name, value.item())  # type: ignore[attr-defined]  # so that JSON can hold it


@cache
def _hints(kind: Any) -> dict[str, Any]:
    return get_type_hints(kind, include_extras=True)


def _check(name: str, value: Any, hint: Any) -> None:
    limits: tuple[Any, ...] = ()
    while get_origin(hint) is Annotated:
        hint, *more = get_args(hint)
        limits += tuple(more)
    if get_origin(hint) in (Union, UnionType):  # such as float | None
        if value is None:
            return
        (hint,) = (part for part in get_args(hint) if part is not NoneType)
        _check(name, value, Annotated[hint, *limits] if limits else hint)
        return
    if get_origin(hint) is Literal:
        if not any(value == one and isinstance(value, type(one)) for one in get_args(hint)):  # 1 is not True
            raise LimitError(f"{name} must be one of {', '.join(map(str, get_args(hint)))}, got {value!r}")
        return
    if get_origin(hint) is tuple:
        _check_type(name, value, tuple)
        for k, item in enumerate(value):
            _check(f"{name}[{k}]", item, get_args(hint)[0])
        return
    _check_type(name, value, hint)
    if is_dataclass(hint):
        return  # has checked itself
    if hint is float and not limits:
        limits = (Within(),)  # a number, not NaN
    for limit in limits:
        if value not in limit:
            raise LimitError(f"{name} must {limit}, got {value}")


def _check_type(name: str, value: Any, kind: type) -> None:
    if kind in (int, float):  # NumPy's numbers are such too
        fits = isinstance(value, Real if kind is float else Integral) and not isinstance(value, bool)
    else:
        fits = isinstance(value, kind)
    if not fits:
        raise TypeError(f"{name} must be {_WORDS.get(kind, kind.__name__)}, got {value!r}")


_WORDS = {int: "an integer", float: "a number", bool: "True or False"}
