"""Dataclasses that can be put aside and taken up again, by another process too."""

from __future__ import annotations

import io
from dataclasses import fields
from typing import Self

import numpy as np


class Stored:
    """Dataclasses of arrays and integers as .npz bytes; the same bytes for the same values."""

    def to_bytes(self) -> bytes:
        out = io.BytesIO()
        np.savez(out, allow_pickle=False, **{f.name: getattr(self, f.name) for f in fields(self)})  # type: ignore[arg-type]
        return out.getvalue()

    @classmethod
    def from_bytes(cls, data: bytes) -> Self:
        with np.load(io.BytesIO(data), allow_pickle=False) as stored:
            values = {f.name: stored[f.name] for f in fields(cls)}  # type: ignore[arg-type]
        return cls(**{k: int(v) if v.ndim == 0 else v for k, v in values.items()})
