"""The OpenAPI document is a product: kept in docs/, complete, and true."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from bake_core.spec import parse_spec
from service.documents import BakeRequest, VerificationRequest
from service.openapi import render

DOCS = Path(__file__).resolve().parents[2] / "docs"
DOCUMENT: dict[str, Any] = json.loads(render())
OPERATIONS = [(method, path, operation) for path, methods in DOCUMENT["paths"].items() for method, operation in methods.items()]


def test_the_copy_in_docs_is_up_to_date() -> None:
    assert (DOCS / "openapi.json").read_text() == render(), "run: python -m service.openapi > docs/openapi.json"


def test_operation_ids_are_stable_and_unique() -> None:
    ids = [operation["operationId"] for *_, operation in OPERATIONS]
    assert len(set(ids)) == len(ids)
    assert all(re.fullmatch(r"[a-z]+[A-Z][A-Za-z]*", i) for i in ids), "chosen by us, not made from a function's name and path"


def test_every_error_is_a_problem() -> None:
    for method, path, operation in OPERATIONS:
        for status, response in operation["responses"].items():
            if status >= "400":
                assert list(response["content"]) == ["application/problem+json"], f"{method} {path} {status}"


def test_every_reference_leads_somewhere() -> None:
    for name in re.findall(r'"#/components/schemas/([^"]+)"', render()):
        assert name in DOCUMENT["components"]["schemas"]


def test_the_examples_are_valid() -> None:
    schemas = DOCUMENT["components"]["schemas"]
    (bake,) = schemas["BakeRequest"]["examples"]
    parse_spec(BakeRequest.model_validate(bake).spec)
    for example in schemas["VerificationRequest"]["examples"]:
        VerificationRequest.model_validate(example)
    (problem,) = schemas["Problem"]["examples"]
    assert set(problem) == set(schemas["Problem"]["properties"])


def test_every_operation_is_described_for_people_too() -> None:
    text = (DOCS / "http.md").read_text()
    for method, path, _ in OPERATIONS:
        assert f"`{method.upper()} {path}`" in text, f"docs/http.md does not tell of {method.upper()} {path}"
