"""What may explain a vibration test: delays, friction of the shafts, a resonance of the mount, in loops of some shape.

Angles tell of a loop its friction and its gain over inertia, c/J and K/J: inertia itself needs a torque or a mass
that is known. Entries are therefore those of the inertia that the default loop has.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from gyromodel.platform._acceptance import AXES

# What the causes are made of: time offset (s), friction (N m s/rad), dry friction (N m) and compliance (s²) of each
# axis, lag (s) of all, the corner of the loop's integration and its crossover (rad/s).
ENTRIES = (
    *(f"{kind} {axis}" for kind in ("offset", "friction", "dry friction", "compliance") for axis in AXES),
    "lag",
    "corner",
    "crossover",
)
# Where fits begin; all but offsets are positive.
SIZES = np.repeat([1e-3, 1.0, 1e-2, 1e-5, 1e-3, 40.0, 200.0], [3, 3, 3, 3, 1, 1, 1])
# Loops of the published bandwidth other than the default one: with as much integration as margins of 45° allow, and
# with two integrators.
QUICK = {"correction": 5.0, "corner": 120.0}
DOUBLE = {"correction": 5.5, "corner": 48.0, "second_corner": 48.0}


class Alternative(NamedTuple):
    """An explanation: which kinds of entries it has, in which loop, and what the mount's damper acts against.

    kinds: of "offset" (the same for all axes), "offsets" (of each axis), "friction", "dry friction", "compliance",
    "lag", "corner" (of the integration) and "crossover" (both of all loops); loop: what of it differs from the default
    one.
    """

    kinds: tuple[str, ...]
    loop: Mapping[str, Any] = MappingProxyType({})
    grounded: float = 0.0

    @property
    def columns(self) -> Float[np.ndarray, "entry parameter"]:
        """Entries by parameters."""
        unit = np.eye(len(ENTRIES))
        parts = {
            "offset": unit[:, :3].sum(1, keepdims=True),
            "offsets": unit[:, :3],
            "friction": unit[:, 3:6],
            "dry friction": unit[:, 6:9],
            "compliance": unit[:, 9:12],
            "lag": unit[:, 12:13],
            "corner": unit[:, 13:14],
            "crossover": unit[:, 14:],
        }
        return np.concatenate([unit[:, :0], *(parts[kind] for kind in self.kinds)], axis=1)

    def within(self, other: Alternative) -> bool:
        """Whether the other is this one with more to fit."""
        kinds, more = set(self.kinds), set(other.kinds)
        more |= {"offset"} if "offsets" in more else set()
        # A corner that is fitted can be that of any loop with one integrator; without friction no loop shows.
        loops = self.loop == other.loop or "friction" not in kinds
        loops |= "corner" in more and "second_corner" not in self.loop
        return kinds <= more and loops and ("lag" not in kinds or self.grounded == other.grounded)


ALTERNATIVES = {
    "time offset": Alternative(("offset",)),
    "time offset of each axis": Alternative(("offsets",)),
    "friction": Alternative(("friction",)),
    "friction, quick integration": Alternative(("friction",), QUICK),
    "friction, double integration": Alternative(("friction",), DOUBLE),
    "resonance": Alternative(("compliance",)),
    "resonance, damped": Alternative(("compliance", "lag")),
    "resonance, damped against inertial space": Alternative(("compliance", "lag"), grounded=1.0),
    "time offset, resonance": Alternative(("offset", "compliance")),
    "time offset, resonance, damped": Alternative(("offset", "compliance", "lag")),
    "time offset, friction": Alternative(("offset", "friction")),
    "time offset, friction, double integration": Alternative(("offset", "friction"), DOUBLE),
    "friction, resonance": Alternative(("friction", "compliance")),
    "friction, resonance, quick integration": Alternative(("friction", "compliance"), QUICK),
    "time offset, friction, resonance": Alternative(("offset", "friction", "compliance")),
    "friction, integration estimated": Alternative(("friction", "corner")),
    "time offset, friction, integration estimated": Alternative(("offset", "friction", "corner")),
    "time offset, wet and dry friction, integration estimated": Alternative(
        ("offset", "friction", "dry friction", "corner")
    ),
}


def _offered() -> dict[str, Alternative]:
    """Each of delay, friction, resonance and loop with each of the others, under the names of `ALTERNATIVES`."""
    parts: tuple[dict[str, tuple[str, ...]], ...] = (
        {"": (), "time offset": ("offset",)},
        {"": (), "friction": ("friction",), "wet and dry friction": ("friction", "dry friction")},
        {"": (), "resonance": ("compliance",), "resonance, damped": ("compliance", "lag")},
        {"": (), "integration estimated": ("corner",), "loop estimated": ("corner", "crossover")},
    )
    return {
        ", ".join(filter(None, names)): Alternative(sum((part[n] for part, n in zip(parts, names, strict=True)), ()))
        for names in product(*parts)
        # Without friction no loop shows.
        if names[1] or not names[3]
    }


# What is offered for a log, nothing at all included: more than twelve points without signs could tell apart.
NOTHING = "nothing"
OFFERED = {name or NOTHING: alternative for name, alternative in (_offered() | ALTERNATIVES).items()}
