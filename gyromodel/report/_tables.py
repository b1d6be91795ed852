"""The page's tables: causes, rankings, the gain, the noise, what was searched, the extended model."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from gyromodel.report._numbers import count, number, pair, percent, stated, unit_text, with_uncertainty
from gyromodel.report._sentence import Held, confused, followed, gave_up, kinds, searched
from gyromodel.report._words import driver_columns, is_driver, listed, phrase, spoken, title

if TYPE_CHECKING:
    from gyromodel.diagnosis._result import Cause, Diagnosis, ParameterValue, Round
    from gyromodel.estimate._calibration import ParameterRow

_RANKED = 12
# Standard deviations from a size to an end of its interval from which on the interval is told beside the size.
_HELPED = 2.1
# Evidence that noise needs, whatever was calibrated: the safe threshold.
_NOISE_NEEDS = 3.0


def cause_row(cause: Cause, at: Held) -> dict[str, Any]:
    return {
        "title": title(cause.effect),
        "id": cause.effect,
        "statistic": evidence(cause.statistic),
        "odds": _odds(cause.statistic),
        "p": _small(cause.p_adjusted),
        "posterior": percent(cause.posterior),
        "parameters": [
            {
                "name": spoken(p.name),
                "value": with_uncertainty(p.value, p.std, p.unit),
                "held": stated(at[p.name].value, at[p.name].unit) if p.name in at else "",
                "interval": _helped(p),
            }
            for p in cause.parameters
        ],
        "confusers": [
            {"title": title(c.effect), "id": c.effect, "separation": c.separation, "word": _separation(c.separation)}
            for c in sorted(cause.confusers, key=lambda c: c.separation)
        ],
        "places": cause.places,
    }


def _helped(parameter: ParameterValue) -> str:
    """The interval of a size that noise may have helped to be told; empty where that changes it by little."""
    if parameter.ci95 is None:
        return ""
    low, high = parameter.ci95
    if max(high - parameter.value, parameter.value - low) < _HELPED * parameter.std:
        return ""
    return f"{number(low)} to {number(high)} {unit_text(parameter.unit)}"


def rankings(diagnosis: Diagnosis) -> list[dict[str, Any]]:
    """Beside the simulation, and after each addition, the best candidates with bars of evidence."""
    kind = kinds(diagnosis)
    following = [step.added for step in diagnosis.rounds[1:]]
    tables = []
    for step, chosen in zip(diagnosis.rounds, [*following, None], strict=False):
        ranked = sorted(step.ranking, key=lambda c: -c.statistic if math.isfinite(c.statistic) else math.inf)
        ranked = ranked[:_RANKED]
        top = max([diagnosis.threshold, *(c.statistic for c in ranked if math.isfinite(c.statistic))], default=1.0)
        rows = [
            {
                "title": title(c.effect, c.kind),
                "id": c.effect,
                "kind": c.kind,
                "statistic": evidence(c.statistic),
                "bar": _bar(c.statistic, top),
                "above": c.statistic > max(diagnosis.threshold, _NOISE_NEEDS * (c.kind == "noise")),
                "posterior": percent(c.posterior),
                "chosen": c.effect == chosen,
            }
            for c in ranked
        ]
        mark = _bar(diagnosis.threshold, top)
        with_it = step.added and phrase(step.added, kind.get(step.added, "effect"))
        beside = f"with {with_it} added{' too' * (len(tables) > 1)}" if with_it else "beside your simulation"
        beside += f" and {phrase(step.beside)}" if step.beside else ""
        tables.append({"title": f"Round {len(tables) + 1}: ranked {beside}", "rows": rows, "mark": mark})
    return tables


def ladder(diagnosis: Diagnosis) -> list[dict[str, str]]:
    """The rounds as steps, from the simulation as given."""
    steps = [r for r in diagnosis.rounds if r.added]
    kind = kinds(diagnosis)
    shown = [_step(index, step, kind.get(step.added or "", "effect")) for index, step in enumerate(steps, 1)]
    if math.isfinite(diagnosis.gain.before):
        score = evidence(diagnosis.rounds[0].log_score)
        start = {"number": "0", "title": "Your simulation", "id": "", "statistic": "", "score": score}
        shown.insert(0, start | {"held_out": number(diagnosis.gain.before, 3)})
    return shown


def _step(index: int, step: Round, kind: str) -> dict[str, str]:
    assert step.added is not None
    return {
        "number": str(index),
        "title": title(step.added, kind),
        "id": "" if kind == "driver" else step.added,
        "statistic": evidence(step.statistic),
        "held_out": number(step.held_out, 3),
        "score": evidence(step.log_score) if math.isfinite(step.log_score) else "–",
    }


def gain(diagnosis: Diagnosis) -> dict[str, Any]:
    gain = diagnosis.gain
    before, after = pair(gain.before, gain.after)
    low, high = gain.ci95
    return {
        "before": before,
        "after": after,
        "unit": unit_text(gain.unit),
        "ratio": number(gain.ratio, 3),
        "low": number(low, 3),
        "high": number(high, 3),
        "scheme": spoken(gain.scheme),
        "folds": gain.folds,
        "score": evidence(gain.log_score),
        "score_low": evidence(gain.log_score_ci95[0]),
        "score_high": evidence(gain.log_score_ci95[1]),
        "measured": math.isfinite(gain.before) and math.isfinite(gain.after),
        "alone": number(gain.before),
        "same": gain.after == gain.before,
        "bars": [100.0 * error / max(gain.before, gain.after, 1e-300) for error in (gain.before, gain.after)],
    }


def noise_of(diagnosis: Diagnosis) -> str:
    """Whether noise is that of an angle."""
    return "angle" if any(entry.get("unit") == "deg/sqrt(Hz)" for entry in diagnosis.noise.values()) else "noise"


def noise(noise: Mapping[str, Mapping[str, float | str]], of: str) -> list[dict[str, str]]:
    rows = []
    for name, entry in noise.items():
        value, low, high = (float(entry.get(key, math.nan)) for key in ("value", "lo", "hi"))
        interval = f"{number(low, 3)} to {number(high, 3)}" if math.isfinite(high) else "too few samples to tell"
        interval = "stated" if low == value == high else interval
        unit = unit_text(str(entry.get("unit", "")))
        rows.append(
            {"title": title(name, of), "id": name, "value": number(value, 3), "interval": interval, "unit": unit}
        )
    return rows


def nearest(diagnosis: Diagnosis) -> str:
    """What in the catalogue comes closest to the curve that was found, and why it is not that."""
    driver = diagnosis.driver
    if driver is None or not driver.nearest:
        return ""
    return (
        f"Of the catalogue, {phrase(driver.nearest)} comes closest: alone it explains "
        f"{100 * driver.nearest_share:.0f} % of what the curve explains, and the evidence for the curve is "
        f"{number(driver.behind, 2)} nats greater."
    )


def noise_kinds(diagnosis: Diagnosis) -> str:
    """What the noise is most probably made of."""
    kinds = list(diagnosis.noise_kinds.items())
    if not kinds:
        return ""

    def made_of(name: str, share: float) -> str:
        parts = [title(part, noise_of(diagnosis)) for part in name.split(" + ")]
        return f"{listed([part if 'Markov' in part else part.lower() for part in parts])} ({100 * share:.0f} %)"

    likely = dict(kind for kind in kinds[:2] if kind[1] >= 0.05)
    of_fit = ""
    if "noise_markov" not in diagnosis.noise and all("noise_markov" in name for name in likely):
        of_fit = " The terms below are those of the fit, which holds no Markov noise."
    elif "noise_markov" in diagnosis.noise and not any("noise_markov" in name for name in likely):
        of_fit = (
            " The terms below are those of the fit, in which Markov noise was likeliest; the shares weigh besides that "
            "such noise is rarer, one to twenty beforehand."
        )
    return f"Most probably {', or '.join(made_of(*kind) for kind in likely.items())}.{of_fit}"


def searched_rows(diagnosis: Diagnosis) -> list[dict[str, str]]:
    """Each searched name with the smallest size that would have been seen, and what was found of it."""
    doubtful = confused(diagnosis) if diagnosis.verdict == "ambiguous" else ()
    had = {row.effect for row in diagnosis.baseline.table()}
    added = [row.effect for row in diagnosis.extended.table() if row.effect not in had]
    found = dict.fromkeys([*added, *doubtful, *diagnosis.credible_set], "possible")
    found |= {"outliers": "given up"} if gave_up(diagnosis) else {}
    found |= {cause.effect: "named" for cause in diagnosis.causes if cause.effect not in doubtful}
    rows = []
    for name in searched(diagnosis):
        size, unit = diagnosis.minimum_detectable.get(name, (math.nan, ""))
        smallest = f"{number(size)} {unit_text(unit)}".strip() if math.isfinite(size) else "–"
        follows = is_driver(name) and driver_columns(name) == followed(diagnosis)
        verdict = "followed" if follows else found.get(name, "")
        rows.append(
            {"title": title(name), "id": "" if is_driver(name) else name, "smallest": smallest, "found": verdict}
        )
    return rows


def parameters(diagnosis: Diagnosis) -> list[dict[str, str]]:
    """Every parameter of the extended model beside its value in the simulation as given."""
    given: dict[tuple[str, str], list[ParameterRow]] = {}
    for row in diagnosis.baseline.table():
        given.setdefault((row.effect, row.name), []).append(row)
    rows = []
    for effect, name, value, std, unit in diagnosis.extended.table():
        # Of several effects of one name each stands beside its own.
        of_name = given.get((effect, name))
        old = of_name.pop(0) if of_name else None
        rows.append(
            {
                "effect": effect,
                "name": spoken(name),
                "before": with_uncertainty(old.value, old.std, old.unit) if old else "not in it",
                "after": with_uncertainty(value, std, unit),
                "held": old is not None and old.std == 0.0,
                "fixed": std == 0.0,
                "new": old is None,
            }
        )
    return rows


def threshold(diagnosis: Diagnosis) -> str:
    bound = number(diagnosis.threshold, 2)
    if diagnosis.threshold_kind == "calibrated":
        p = diagnosis.p_value
        share = "" if p is None else f" As much evidence of an effect as here is reached in {100 * p:.2g} % of them."
        if diagnosis.baseline.noise_given:
            share += f" Noise beyond what the simulation states needs {number(_NOISE_NEEDS)} or more."
        return (
            f"An effect is accepted when its evidence exceeds {bound}. This bound was calibrated: the best of all "
            "candidates exceeds it in one of 100 simulations or fewer of this campaign with its noise and nothing "
            f"missing.{share}"
        )
    return (
        f"An effect is accepted when its evidence exceeds {bound}, odds of {_odds(diagnosis.threshold)} after paying "
        "for the number of forms tried. This is the safe default, with what few samples, or a random walk that would "
        "imitate this effect, add to it; it was not calibrated by simulating this campaign."
    )


def _bar(value: float, top: float) -> float:
    """Length in percent; square root, so that weak candidates beside a strong one stay visible."""
    if not (math.isfinite(value) and top > 0.0) or value <= 0.0:
        return 0.0
    return round(100.0 * math.sqrt(min(value / top, 1.0)), 2)


def evidence(nats: float) -> str:
    return f"{nats:.1f}".replace("-0.0", "0.0") if math.isfinite(nats) else number(nats)


def _odds(statistic: float) -> str:
    """Evidence as odds."""
    if not math.isfinite(statistic):
        return "–"
    if statistic > 13.8:
        return "more than a million to 1"
    if statistic < 0.0:
        return f"1 to {count(round(math.exp(min(-statistic, 13.8))))}"
    return f"{count(round(math.exp(statistic)))} to 1"


def _small(p: float) -> str:
    return "–" if not math.isfinite(p) else ("< 0.0001" if p < 1e-4 else number(p, 2))


def _separation(value: float) -> str:
    """A separation in words."""
    bounds = ((0.05, "shares a column"), (0.3, "nearly shares a column"), (0.7, "partly alike"))
    return next((word for bound, word in bounds if value < bound), "clearly different")
