"""Who may do what: tokens by name, each with its scopes, of which only a hash is kept."""

from __future__ import annotations

import hashlib
import secrets
import time
from collections.abc import Collection
from dataclasses import dataclass
from enum import StrEnum

import sqlalchemy as sa
from sqlalchemy.engine import Engine
from sqlalchemy.exc import IntegrityError

from bake_core.errors import InputError
from service.tables import reading, tokens, writing

PREFIX = "octobake_"


class Scope(StrEnum):
    """What a token is good for. None includes another."""

    SUBMIT = "submit"
    READ = "read"
    ADMIN = "admin"


@dataclass(frozen=True)
class Token:
    """A token without its secret."""

    name: str
    scopes: frozenset[Scope]
    created: float


class Tokens:
    """The table of tokens."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine

    def create(self, name: str, scopes: Collection[Scope]) -> str:
        """Make a token; this answer is the only time that anybody sees it.

        Raises
        ------
        InputError
            ``token.exists``.
        """
        secret = PREFIX + secrets.token_urlsafe(32)
        try:
            with writing(self._engine) as c:
                row = {"name": name, "hash": _hash(secret), "scopes": sorted(scopes), "created": time.time()}
                c.execute(sa.insert(tokens).values(row))
        except IntegrityError:
            raise InputError("token.exists", "there is a token of this name; revoke it first, or take another name", name) from None
        return secret

    def list(self) -> list[Token]:
        """All tokens by name."""
        with reading(self._engine) as c:
            return [Token(r.name, frozenset(map(Scope, r.scopes)), r.created) for r in c.execute(sa.select(tokens).order_by(tokens.c.name))]

    def revoke(self, name: str) -> None:
        """Take a token away; the next request with it is refused.

        Raises
        ------
        InputError
            ``token.unknown``.
        """
        with writing(self._engine) as c:
            if not c.execute(sa.delete(tokens).where(tokens.c.name == name)).rowcount:
                raise InputError("token.unknown", "there is no token of this name; `octobake token list` names them", name)

    def find(self, secret: str) -> Token | None:
        """Whose secret this is."""
        with reading(self._engine) as c:
            row = c.execute(sa.select(tokens).where(tokens.c.hash == _hash(secret))).first()
        return None if row is None else Token(row.name, frozenset(map(Scope, row.scopes)), row.created)


def _hash(secret: str) -> str:
    # 256 random bits cannot be guessed, however fast the hash; slow ones are for what people think of.
    return hashlib.sha256(secret.encode()).hexdigest()
