"""The `noise:` of a model file: its entries to and from what a model states."""

from __future__ import annotations

from typing import Any

import yaml

from gyromodel._yaml import Place, exact_text
from gyromodel.effects._base import Domain
from gyromodel.model import LEVEL_UNITS, GyroModel, Level
from gyromodel.noise import NOISE_UNITS, TIMES, check_stated, noise_units
from gyromodel.units import convertible

# A noise level that follows a column, and how that is written.
LEVEL = "noise_heteroscedastic"
LEVEL_KEYS = ("driver", "from", "to")


def read_noise(place: Place, of: list[Domain]) -> tuple[dict[str, float], Domain, Level | None]:
    """Coefficients; what they are the noise of, one of those given, all in its units; and what the level follows."""
    if isinstance(place.node, yaml.ScalarNode):
        if place.text() != "auto":
            raise place.error('noise is "auto" or a list of noise_* effects with values')
        return {}, of[0], None
    noise: dict[str, float] = {}
    level = None
    for item in place.items("noise"):
        times = dict.fromkeys(what for _, what in TIMES.values())
        keys = ("effect", "value", "lo", "hi", *times, *LEVEL_KEYS)
        entry = item.mapping(keys, "a noise entry")
        if "effect" not in entry or "value" not in entry:
            raise item.error("each noise entry needs an effect: id and a value")
        name = entry["effect"].text()
        known = [*(k for k in NOISE_UNITS if k not in TIMES), LEVEL]
        if name not in known:
            raise entry["effect"].error(f"unknown noise {name}; known are {', '.join(known)}")
        if name in noise or (name == LEVEL and level is not None):
            raise entry["effect"].error(f"{name} appears twice")
        of = [domain for domain in of if name in noise_units(domain) or (name == LEVEL and domain == "gyro")]
        if not of:
            raise entry["effect"].error(f"{name} is noise of a rate, and not of the angle of a platform's base")
        if name == LEVEL:
            level = _read_level(item, entry)
            continue
        noise[name] = entry["value"].number_in(*(noise_units(domain)[name] for domain in of))
        of = [d for d in of if convertible(entry["value"].quantity()[1], noise_units(d)[name])]
        if noise[name] < 0:
            raise entry["value"].error(f"{name} cannot be negative")
        for key in (key for key in times if key in entry):
            of_kind = next((k for k, what in TIMES.items() if what == (name, key)), None)
            if of_kind is None:
                raise entry[key].error(f"{name} has no {key}")
            noise[of_kind] = entry[key].number_in(NOISE_UNITS[of_kind])
        if extra := next((key for key in LEVEL_KEYS if key in entry), None):
            raise entry[extra].error(f"{name} has no {extra}")
    if level is not None and not noise:
        return noise, of[0], level
    try:
        check_stated(noise)
    except ValueError as problem:
        raise place.error(str(problem)) from None
    return noise, of[0], level


def _read_level(item: Place, entry: dict[str, Place]) -> Level:
    """What a noise level follows: `driver` with its values `from` and `to`."""
    if missing := next((key for key in LEVEL_KEYS if key not in entry), None):
        raise item.error(f"noise_heteroscedastic needs {missing}: it is the level at `to` over that at `from`")
    driver = entry["driver"].text()
    if driver not in LEVEL_UNITS:
        raise entry["driver"].error(f"noise_heteroscedastic follows one of {', '.join(LEVEL_UNITS)}")
    low, high = (entry[key].number_in(LEVEL_UNITS[driver]) for key in LEVEL_KEYS[1:])
    if not low < high:
        raise entry["to"].error("noise_heteroscedastic goes from a value to a larger one")
    ratio = entry["value"].number_in("")
    if ratio <= 0:
        raise entry["value"].error("noise_heteroscedastic is a ratio of noise levels, and above zero")
    return Level(driver, low, high, ratio)


def noise_entries(model: GyroModel) -> list[dict[str, Any]] | str:
    """What a model states of its noise; "auto" where it states nothing."""
    units = noise_units(model.noise_of)
    noise = {k: {"effect": k, "value": exact_text(float(v), units[k])} for k, v in model.noise.items()}
    if model.level is not None:
        driver, low, high, ratio = model.level
        texts = [driver, *(exact_text(end, LEVEL_UNITS[driver]) for end in (low, high))]
        noise[LEVEL] = {"effect": LEVEL, "value": ratio, **dict(zip(LEVEL_KEYS, texts, strict=True))}
    for name in TIMES.keys() & noise.keys():
        kind, what = TIMES[name]
        noise[kind][what] = noise.pop(name)["value"]
    return list(noise.values()) or "auto"
