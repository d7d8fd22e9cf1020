"""Schemas of JSON that others wrote: a test for the value of each key (Spec G2)."""

from collections.abc import Callable, Mapping
from typing import Any

from hypogoal.core.files import MOST_INTEGER

LARGEST = 1e18  # of seconds: the age of the universe; sums of them stay finite
MOST_TEXT = 1 << 16  # characters; settings in commands may be long lists
Test = Callable[[Any], bool]
Schema = Mapping[str, Test]


def misfit(value: Any, needed: Schema, optional: Schema | None = None) -> str | None:
    """The first missing or malformed key of an object; empty if it is not an object, None if it fits."""
    if not isinstance(value, dict):
        return ""
    for key, fits in {**needed, **(optional or {})}.items():
        if (key in value or key in needed) and not (key in value and fits(value[key])):
            return key
    return None


def is_text(value: Any) -> bool:
    """Whether a value is a text that can be a path or a word of a command."""
    return isinstance(value, str) and "\0" not in value and len(value) < MOST_TEXT


def is_count(value: Any) -> bool:
    """Whether a value is an integer of at least 0 and not a bool."""
    return type(value) is int and 0 <= value <= MOST_INTEGER


def is_amount(value: Any) -> bool:
    """Whether a value is a number of seconds."""
    return type(value) in (int, float) and 0 <= value <= LARGEST


def is_list(test: Test) -> Test:
    """A test for lists whose items pass ``test``."""
    return lambda value: isinstance(value, list) and all(map(test, value))


def is_table(test: Test) -> Test:
    """A test for objects whose keys are texts and whose values pass ``test``."""
    return lambda value: isinstance(value, dict) and all(map(is_text, value)) and all(map(test, value.values()))


def is_object(needed: Schema) -> Test:
    """A test for objects that fit a schema."""
    return lambda value: misfit(value, needed) is None
