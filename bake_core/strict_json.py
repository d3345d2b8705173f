"""JSON from strangers, parsed strictly: no NaN, no duplicate keys, no depth that overflows a stack."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from typing import Any, NoReturn

from bake_core.errors import InputError

# A glTF's or a spec's real depth is under 20; CPython's own scanner recurses, so the depth is checked before it runs.
MAX_DEPTH = 256


def parse(text: bytes | str, error: Callable[[str, str, str], InputError], area: str, where: str) -> Any:
    """Parse one JSON document, or raise ``error(slug, message, where)``.

    Parameters
    ----------
    text : bytes or str
        UTF-8; a byte-order mark is allowed.
    error : type of InputError
        What to raise (SpecError, SceneError, ...).
    area : str
        First word of the slug: ``spec`` gives ``spec.bad_json``, ``spec.json_too_deep``, ...
    where : str
        The file's name, for the message.
    """
    if isinstance(text, bytes):
        try:
            text = text.decode("utf-8-sig")
        except UnicodeDecodeError as e:
            raise error(f"{area}.bad_json", f"not UTF-8 at byte {e.start}; save the file as UTF-8", where) from None
    if _depth(text) > MAX_DEPTH:
        raise error(f"{area}.json_too_deep", f"nested deeper than {MAX_DEPTH} levels", where)

    def constant(name: str) -> NoReturn:
        raise error(f"{area}.not_finite", f"{name} is not a JSON number; give a finite one", where)

    def pairs(items: list[tuple[str, Any]]) -> dict[str, Any]:
        out = dict(items)
        if len(out) != len(items):
            seen: set[str] = set()
            twice = next(k for k, _ in items if k in seen or seen.add(k))  # type: ignore[func-returns-value]
            raise error(f"{area}.duplicate_key", f"the key {twice!r} stands twice in one object", where)
        return out

    def number(literal: str) -> int:
        # CPython refuses to convert more than 4,300 digits with a ValueError that names no place.
        if len(literal) > 400:
            raise error(f"{area}.bad_json", "a number of more than 400 digits", where)
        return int(literal)

    try:
        return json.loads(text, parse_constant=constant, object_pairs_hook=pairs, parse_int=number)
    except json.JSONDecodeError as e:
        raise error(f"{area}.bad_json", f"line {e.lineno}, column {e.colno}: {e.msg}", where) from None


_STRING = re.compile(r'"(?:[^"\\]|\\.)*"', re.DOTALL)
_BRACKET = re.compile(r"[\[\]{}]")


def _depth(text: str) -> int:
    """Deepest nesting of brackets outside strings; stops counting once it is past the limit."""
    depth = deepest = 0
    for bracket in _BRACKET.findall(_STRING.sub("", text)):
        depth += 1 if bracket in "[{" else -1
        deepest = max(deepest, depth)
        if deepest > MAX_DEPTH:
            break
    return deepest
