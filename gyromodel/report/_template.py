"""A page from its packaged template, with the style and the filters that all pages share."""

from __future__ import annotations

import html
import re
from collections.abc import Mapping
from importlib import resources
from typing import Any

from gyromodel import __version__
from gyromodel.report._numbers import percent


def filled(template: str, values: Mapping[str, Any]) -> str:
    """A page from its packaged template, with the style that all pages share inside it."""
    import jinja2

    from gyromodel.report._drawing import inline

    def packaged(name: str) -> str:
        return resources.files("gyromodel.report").joinpath(name).read_text(encoding="utf-8")

    environment = jinja2.Environment(
        loader=jinja2.FunctionLoader(packaged),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"pretty": _markup, "breakable": _breakable, "inline": inline, "percent": percent}
    return environment.get_template(template).render(values, style=packaged("style.css"), version=__version__)


def _markup(text: str) -> Any:
    """Text with powers of ten set as print: "(3.6 ± 0.2)e-4" with a raised exponent."""
    from markupsafe import Markup

    safe = html.escape(text, quote=False).replace(" ± ", "&nbsp;±&nbsp;")
    safe = re.sub(r"(?<![\w-])-(?=\d)", "−", safe)
    powers = re.compile(r"((?<![\w.])\d+\.?\d*|\))e(-?)(\d+)\b")
    return Markup(powers.sub(lambda f: f"{f[1]}&nbsp;×&nbsp;10<sup>{'−' * len(f[2])}{f[3]}</sup>", safe))


def _breakable(name: str) -> Any:
    """An id that may wrap after each underscore."""
    from markupsafe import Markup

    return Markup(html.escape(name, quote=False).replace("_", "_<wbr>"))
