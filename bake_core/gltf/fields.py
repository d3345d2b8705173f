"""One JSON object of a glTF, read field by field: every complaint names its place.

Written by hand because places and speed both matter here: a scene of 100,000 nodes is ordinary.
"""

from __future__ import annotations

import math
from collections import Counter
from typing import Any, NoReturn

from bake_core.errors import SceneError

_KINDS = {dict: "an object", list: "a list", str: "a string", bool: "true or false", int: "a whole number", float: "a fraction"}
# JSON integers have no limit; nothing that a file counts or points at is larger than what a file offset holds.
MAX_INTEGER = 2**63 - 1


def fail(reason: str, message: str, where: str) -> NoReturn:
    """Raise a SceneError whose slug is ``gltf.REASON``."""
    raise SceneError(f"gltf.{reason}", message, where)


def quoted(text: str) -> str:
    """A name from the file as one short printable piece of a message."""
    shown = repr(text)
    return shown if len(shown) <= 80 else f"{shown[:76]}...'"


class Notes:
    """What was read over, gathered as one line per kind with its first place and how often it occurs."""

    def __init__(self) -> None:
        self._count: Counter[str] = Counter()
        self._first: dict[str, str] = {}

    def add(self, what: str, where: str) -> None:
        self._count[what] += 1
        self._first.setdefault(what, where)

    def extend(self, other: Notes) -> None:
        self._count.update(other._count)
        for what, where in other._first.items():
            self._first.setdefault(what, where)

    def lines(self) -> tuple[str, ...]:
        return tuple(f"{what} (at {self._first[what]}" + (f", and {n - 1} more)" if n > 1 else ")") for what, n in self._count.items())


class Fields:
    """A JSON object and where it stands in the file.

    Every reader below raises SceneError ``gltf.missing_key``, ``gltf.wrong_type``, ``gltf.not_finite`` or ``gltf.out_of_range``
    with the field's path. A `default` of None makes a field required.
    """

    __slots__ = ("value", "where")

    def __init__(self, value: Any, where: str) -> None:
        if type(value) is not dict:
            fail("wrong_type", f"must be an object, not {_kind(value)}", where)
        self.value: dict[str, Any] = value
        self.where = where

    def __contains__(self, key: str) -> bool:
        return key in self.value

    def at(self, where: str) -> Fields:
        """The same object by another name."""
        return Fields(self.value, where)

    def place(self, key: str) -> str:
        return f"{self.where}.{key}" if self.where else key

    def integer(self, key: str, *, low: int = 0, high: int = MAX_INTEGER, default: int | None = None) -> int:
        value = self.value.get(key)
        if value is None and key not in self.value:
            return default if default is not None else self._missing(key)
        if type(value) is not int:
            fail("wrong_type", f"must be a whole number, not {_kind(value)}", self.place(key))
        if not low <= value <= high:
            limit = f"at least {low}" if value < low else f"at most {high}"
            fail("out_of_range", f"is {_short(value)}, must be {limit}", self.place(key))
        return value

    def index(self, key: str, count: int, of: str) -> int | None:
        """An optional index into the list called `of`, which has `count` elements."""
        return check_index(self.value[key], count, of, self.place(key)) if key in self.value else None

    def required_index(self, key: str, count: int, of: str) -> int:
        index = self.index(key, count, of)
        return index if index is not None else self._missing(key)

    def indices(self, key: str, count: int, of: str) -> list[int]:
        """A list of indices, empty where there is none."""
        return [check_index(v, count, of, f"{self.place(key)}[{i}]") for i, v in enumerate(self._list(key))]

    def number(self, key: str, *, default: float | None = None, low: float = -math.inf, high: float = math.inf) -> float:
        if key not in self.value:
            return default if default is not None else self._missing(key)
        return _number(self.value[key], low, high, self.place(key))

    def positive(self, key: str, default: float) -> float:
        value = self.number(key, default=default)
        return value if value > 0 else fail("out_of_range", f"is {value:g}, must be greater than 0", self.place(key))

    def numbers(self, key: str, default: tuple[float, ...], *, low: float = -math.inf, high: float = math.inf) -> tuple[float, ...]:
        """As many numbers as the default has."""
        if key not in self.value:
            return default
        values = self._list(key)
        if len(values) != len(default):
            fail("wrong_type", f"must be {len(default)} numbers, not {len(values)}", self.place(key))
        return tuple(_number(v, low, high, f"{self.place(key)}[{i}]") for i, v in enumerate(values))

    def boolean(self, key: str) -> bool:
        value = self.value.get(key, False)
        return value if type(value) is bool else fail("wrong_type", f"must be true or false, not {_kind(value)}", self.place(key))

    def text(self, key: str, default: str | None = None) -> str:
        if key not in self.value:
            return default if default is not None else self._missing(key)
        value = self.value[key]
        if type(value) is not str:
            fail("wrong_type", f"must be a string, not {_kind(value)}", self.place(key))
        if not value.isascii() and any("\ud800" <= c <= "\udfff" for c in value):
            fail("bad_json", "has half of a surrogate pair, which is no character", self.place(key))
        return value

    def texts(self, key: str) -> list[str]:
        place = self.place(key)
        return [
            v if type(v) is str else fail("wrong_type", f"must be a string, not {_kind(v)}", f"{place}[{i}]")
            for i, v in enumerate(self._list(key))
        ]

    def child(self, key: str) -> Fields:
        """An object, empty where there is none."""
        return Fields(self.value.get(key, {}), self.place(key))

    def children(self, key: str) -> list[Fields]:
        """A list of objects, empty where there is none."""
        place = self.place(key)
        return [Fields(v, f"{place}[{i}]") for i, v in enumerate(self._list(key))]

    def count(self, key: str) -> int:
        """How many elements the list `key` has."""
        return len(self._list(key))

    def _list(self, key: str) -> list[Any]:
        value = self.value.get(key, [])
        return value if type(value) is list else fail("wrong_type", f"must be a list, not {_kind(value)}", self.place(key))

    def _missing(self, key: str) -> NoReturn:
        fail("missing_key", "is required", self.place(key))


def check_index(value: Any, count: int, of: str, where: str) -> int:
    """`value` as an index into `count` elements of `of`.

    Raises
    ------
    SceneError
        ``gltf.wrong_type`` or ``gltf.index_out_of_range``.
    """
    if type(value) is not int:
        fail("wrong_type", f"must be an index into {of}, not {_kind(value)}", where)
    if not 0 <= value < count:
        fail("index_out_of_range", f"is {_short(value)}, but the file has {count} {of}", where)
    return value


def _number(value: Any, low: float, high: float, where: str) -> float:
    if type(value) is not float and type(value) is not int:
        fail("wrong_type", f"must be a number, not {_kind(value)}", where)
    try:
        real = float(value)
    except OverflowError:
        real = math.inf
    if not math.isfinite(real):
        fail("not_finite", "must be a finite number", where)
    if not low <= real <= high:
        fail("out_of_range", f"is {real:g}, must be in [{low:g}, {high:g}]", where)
    return real


def _kind(value: Any) -> str:
    """A JSON value's type in JSON's words."""
    return _KINDS.get(type(value), "null")


def _short(value: int) -> str:
    return str(value) if abs(value) < 10**20 else "a number of more than 20 digits"
