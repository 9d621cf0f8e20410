"""YAML as scenarios use it: plain values, keys that are text, and each of them once."""

from __future__ import annotations

import re
from typing import Any

import yaml

MOST_VALUES = 200_000
"""Values of a document, what aliases repeat included."""
DEEPEST = 40
_INTEGER, _FLOAT = "tag:yaml.org,2002:int", "tag:yaml.org,2002:float"
_OTHER_BASE = re.compile(r"[-+]?(?:0[0-7_]+|[0-9][0-9_]*(?::[0-5]?[0-9])+(?:\.[0-9_]*)?)")


_UNREADABLE = (ValueError, TypeError, LookupError, AttributeError, ArithmeticError)
_LONGEST = 400


class _Loader(yaml.SafeLoader):
    """Refuses what PyYAML reads in silence as something that nobody meant."""

    def get_single_node(self) -> yaml.Node | None:
        node: yaml.Node | None = super().get_single_node()
        if node is not None:
            _count_values(node, {}, 0)
        return node

    def strict_mapping(self, node: yaml.MappingNode) -> dict[str, Any]:
        if not isinstance(node, yaml.MappingNode):
            raise _refused(node, "a tag of a mapping on what is none")
        seen = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node)
            if not isinstance(key, str):
                raise _refused(key_node, f"the key {key!r} is no text: write it in quotes")
            if key in seen:
                raise _refused(key_node, f"the key {key!r} stands twice")
            seen.add(key)
        result: dict[Any, Any] = self.construct_mapping(node, deep=True)
        return result

    def strict_number(self, node: yaml.ScalarNode) -> int | float:
        text = str(node.value)
        if len(text) > _LONGEST:
            raise _refused(node, f"a number of {len(text)} digits")
        number: int | float
        try:
            is_integer = node.tag == _INTEGER
            number = (
                self.construct_yaml_int(node) if is_integer else self.construct_yaml_float(node)
            )
        except ValueError as error:
            raise _refused(node, f"the number {text!r:.40} cannot be read: {error}") from error
        if _OTHER_BASE.fullmatch(text):
            base = 60 if ":" in text else 8
            raise _refused(
                node,
                f"YAML reads {text} as {number}, to the base {base}: write {number}, or quotes",
            )
        if isinstance(number, int) and abs(number) >= 1 << 63:
            raise _refused(node, f"{text:.40} is beyond 64 bits")
        return number


_Loader.add_constructor(yaml.resolver.BaseResolver.DEFAULT_MAPPING_TAG, _Loader.strict_mapping)
for _tag in (_INTEGER, _FLOAT):
    _Loader.add_constructor(_tag, _Loader.strict_number)


def parse_yaml(text: str) -> Any:
    """Parse one YAML document.

    yaml.YAMLError if it is none, or has keys twice or that are no text, numbers to the base 8 or 60
    or beyond 64 bits, or more values than `MOST_VALUES`, deeper than `DEEPEST`.
    """
    try:
        return yaml.load(text, Loader=_Loader)  # a SafeLoader
    except RecursionError as error:
        raise yaml.YAMLError(f"nested deeper than {DEEPEST} levels") from error
    except _UNREADABLE as error:  # of dates that are none, of tags on what does not have them
        raise yaml.YAMLError(f"a value cannot be read: {error!r:.200}") from error


def _count_values(node: yaml.Node, known: dict[int, int], depth: int) -> int:
    """Count the values of a tree in which aliases repeat whole branches, perhaps without end."""
    if depth > DEEPEST:
        raise _refused(node, f"nested deeper than {DEEPEST} levels, or without end by an alias")
    if isinstance(node, yaml.ScalarNode) and _has_surrogates(node.value):
        raise _refused(node, "a character that no text has")
    if id(node) not in known:
        children = node.value if isinstance(node, yaml.CollectionNode) else []
        inner = [n for child in children for n in (child if isinstance(child, tuple) else (child,))]
        known[id(node)] = 1 + sum(_count_values(child, known, depth + 1) for child in inner)
        if known[id(node)] > MOST_VALUES:
            raise _refused(node, f"more than {MOST_VALUES} values, those of aliases included")
    return known[id(node)]


def _has_surrogates(text: str) -> bool:
    try:
        text.encode()
    except UnicodeEncodeError:
        return True
    return False


def _refused(node: yaml.Node, what: str) -> yaml.YAMLError:
    return yaml.constructor.ConstructorError(None, None, what, node.start_mark)
