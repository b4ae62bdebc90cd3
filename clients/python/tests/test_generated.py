"""What is generated is what is committed, and shapes that the description does not have yet do not stop the generator."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from typing import Any, Optional, get_args, get_type_hints

import pytest
from served import ROOT

from uniground import Vector

GENERATOR = ROOT / "scripts/python-client.py"


def test_models_and_client_are_up_to_date() -> None:
    check = subprocess.run([sys.executable, GENERATOR, "--check"], capture_output=True, text=True)
    assert check.returncode == 0, check.stderr


def written(schemas: dict[str, Any], request: Optional[str] = None) -> dict[str, Any]:
    """The module that these schemas become; `request` is one that callers send."""
    spec = importlib.util.spec_from_file_location("python_client", GENERATOR)
    assert spec is not None
    assert spec.loader is not None
    generator = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(generator)
    body = {"requestBody": {"$ref": f"#/components/schemas/{request}"}} if request else {}
    text = generator.Models({"components": {"schemas": schemas}, "paths": {"/": {"post": body}}}).write()
    module: dict[str, Any] = {"__name__": "uniground.models"}
    exec(text.replace("from uniground._values import \n", ""), module)
    return module


@pytest.mark.parametrize(
    ("shape", "expected"),
    [
        ({"type": "array", "prefixItems": [{"type": "number"}] * 3, "items": False}, Vector),
        ({"type": "array", "items": {"type": "array", "items": {"type": "number"}}}, list[Vector]),
        ({"type": ["string", "integer", "null"]}, Any),
        ({"type": ["string", "null"]}, Optional[str]),
        ({"type": "object", "additionalProperties": {"type": "integer"}}, dict[str, int]),
        ({"oneOf": [{"type": "string"}, {"type": "integer"}]}, Any),
        ({}, Any),
    ],
)
def test_a_field_of_any_shape_has_a_type(shape: Any, expected: Any) -> None:
    module = written({"Thing": {"type": "object", "required": ["it", "import"], "properties": {"it": shape, "import": {"type": "string"}}}})
    assert get_type_hints(module["Thing"], module) == {"it": expected, "import_": str}


def test_variants_are_one_class_and_requests_are_dictionaries() -> None:
    variants = [
        {"type": "object", "required": ["on"], "properties": {"on": {"type": "string", "enum": ["floor"]}}},
        {"type": "object", "required": ["on", "id"], "properties": {"on": {"type": "string", "enum": ["wall"]}, "id": {"type": "integer"}}},
    ]
    module = written({"Support": {"oneOf": variants}, "Every": {"type": "array", "items": {"$ref": "#/components/schemas/Support"}}})
    assert module["Support"](on="floor").id is None
    assert get_args(module["Every"]) == (module["Support"],)

    asked = {"type": "object", "required": ["query"], "properties": {"query": {"type": "string"}, "top_k": {"type": "integer"}}}
    module = written({"AskRequest": asked}, request="AskRequest")
    assert set(module["AskOptions"].__annotations__) == {"top_k"}
    assert module["AskRequest"].__required_keys__ == {"query"}
