"""The run-time type checker of the tests: beartype, made to accept `Self`.

The import hook decorates methods one by one, where beartype knows no class that `Self` could mean.
"""

from typing import Self

from beartype import BeartypeConf, FrozenDict, beartype

checked = beartype(conf=BeartypeConf(hint_overrides=FrozenDict({Self: object})))
