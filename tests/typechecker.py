"""The run-time type checker of the tests: beartype, made to accept `Self`.

The import hook decorates methods one by one, where beartype knows no class that `Self` could mean. Functions in
functions are not checked: each call makes them anew, and their check with them, which took a quarter of all time.
"""

from collections.abc import Callable
from typing import Any, Self

from beartype import BeartypeConf, FrozenDict, beartype

_check: Callable[[Any], Any] = beartype(conf=BeartypeConf(hint_overrides=FrozenDict({Self: object})))


def checked(what: Any) -> Any:
    """A function, or a class, with the types of its arguments and results checked at each call."""
    return what if "<locals>" in what.__qualname__ else _check(what)
