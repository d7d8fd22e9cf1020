"""What JSON that others wrote must look like: of each key a test of its value (Spec G2)."""

from collections.abc import Callable, Mapping
from typing import Any

from hypogoal.core.files import MOST_INTEGER

LARGEST = 1e18  # of sizes and times: a million terabytes, the age of the universe; what is made of them stays finite
MOST_TEXT, MOST_WORD = 1 << 12, 1 << 16  # characters
Test = Callable[[Any], bool]
Schema = Mapping[str, Test]


def misfit(value: Any, needed: Schema, optional: Schema | None = None) -> str | None:
    """The first key of an object that is missing or malformed, empty where it is no object; None where it fits."""
    if not isinstance(value, dict):
        return ""
    for key, fits in {**needed, **(optional or {})}.items():
        if (key in value or key in needed) and not (key in value and fits(value[key])):
            return key
    return None


def is_text(value: Any) -> bool:
    """A text that can be a path."""
    return isinstance(value, str) and "\0" not in value and len(value) < MOST_TEXT


def is_word(value: Any) -> bool:
    """A text that can be a word of a command: settings may be lists."""
    return isinstance(value, str) and "\0" not in value and len(value) < MOST_WORD


def is_count(value: Any) -> bool:
    """An integer from 0 on; True is none."""
    return type(value) is int and 0 <= value <= MOST_INTEGER


def is_amount(value: Any) -> bool:
    """A number from 0 on, of seconds or bytes."""
    return type(value) in (int, float) and 0 <= value <= LARGEST


def is_list(test: Test) -> Test:
    """A test of lists by their items."""
    return lambda value: isinstance(value, list) and all(map(test, value))


def is_table(test: Test) -> Test:
    """A test of objects by their values; their keys are texts."""
    return lambda value: isinstance(value, dict) and all(map(is_text, value)) and all(map(test, value.values()))


def is_object(needed: Schema) -> Test:
    """A test of objects that have these keys."""
    return lambda value: misfit(value, needed) is None
