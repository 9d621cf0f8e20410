"""Places of a scenario where a model is chosen by name, and what its other keys may be."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from pydantic import PlainValidator, ValidationError
from pydantic_core import InitErrorDetails, PydanticCustomError

from hiersched.core.parameters import read_strictly
from hiersched.models.model import Model, Section
from hiersched.policies.files import FILE_POLICIES
from hiersched.policies.find import ImportedPolicy
from hiersched.policies.registry import RULES


def chosen_from(section: Section) -> PlainValidator:
    """Annotate a key whose value is a mapping that names one of the models of a section."""
    return PlainValidator(partial(_choose, section))


def policy_entry() -> PlainValidator:
    """Annotate an entry of `policies`: a rule with its keys, an imported function, a file."""
    return PlainValidator(_choose_policy)


def rule_entry() -> PlainValidator:
    """Annotate a key whose value is a rule with keys of its own."""
    return PlainValidator(partial(_choose, RULES))


def _choose(section: Section, value: Any) -> Model:
    if not isinstance(value, Mapping):
        example = value if isinstance(value, str) else section.example
        raise PydanticCustomError(
            "no_mapping", "must be a mapping with the key `model`, such as {example}",
            {"example": f"{{model: {example}}}"},
        )  # fmt: skip
    if "model" not in value:
        raise _fault("missing", "Field required", {"model": None}, "model")
    name = value["model"]
    if not isinstance(name, str) or name not in section:
        raise _fault("unknown_model", section.allowed(value.get("model")), value, "model")
    return read_strictly(section[name], value)


def _choose_policy(value: Any) -> Any:
    if isinstance(value, Mapping) and "import" in value:
        return read_strictly(ImportedPolicy, value)
    for key, kind in FILE_POLICIES.items():
        if isinstance(value, Mapping) and key in value:
            return read_strictly(kind, value)
    if not isinstance(value, Mapping) or "model" not in value:
        raise PydanticCustomError(
            "no_policy",
            "must be a mapping with the key `model` (a rule with keys of its own), `import` "
            "(module:function), `sb3` or `onnx` (a file)",
        )
    return _choose(RULES, value)


def _fault(kind: str, message: str, value: Mapping[str, Any], key: str) -> ValidationError:
    """Return a fault at a key inside the value."""
    error: Callable[..., Any] = PydanticCustomError
    details = InitErrorDetails(
        type=error(kind, message.replace("{", "{{")), loc=(key,), input=value.get(key)
    )
    return ValidationError.from_exception_data("model", [details])
