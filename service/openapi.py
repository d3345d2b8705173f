"""``python -m service.openapi``: print the OpenAPI document, as docs/openapi.json keeps it."""

from __future__ import annotations

import json
import sys

from service.app import describe


def render() -> str:
    """The document as text, the same for the same code."""
    return json.dumps(describe().openapi(), indent=1, ensure_ascii=False, sort_keys=True) + "\n"


if __name__ == "__main__":
    sys.stdout.write(render())
