"""Cases of the hidden-effect study: drawn, run through the engine and judged; used by the tests and the benchmark."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations, cycle
from multiprocessing import get_context
from typing import Any, TypeVar

import numpy as np
from scipy.optimize import brentq
from scipy.special import logsumexp

from . import contest
from .campaigns import ALIKE, HOMES, LOOP, MOTION, RUNS, STATED, TESTABLE, UNCATALOGUED, A, B, C, Truth, hide, known
from .designs import DESIGNS, Design
from .effects import error
from .laws import Told, kinds_of_any_level, tell
from .mde import Oracle, baseline, oracle, parts
from .motion import MOTION_EFFECTS
from .motion_designs import MOTION_DESIGNS
from .mutants import mutated
from .noise import FAMILY, Noise, draw
from .other_designs import OTHER_DESIGNS, OTHER_EFFECTS
from .verdicts import Answer, Score, judge

Array = np.ndarray
# The rival of these is the noise itself: they are judged with the ambiguous.
SLOW = ("bias_drift", "bias_step", "bias_warmup")
# The noise of a kind on a design.
NoiseOf = Callable[[str, Design], Noise]
S = TypeVar("S")
T = TypeVar("T")
CONTROLS = ("least_squares_f", "hac_f", "stepwise_bic", "lasso", "boosted_trees")


@dataclass(frozen=True)
class Case:
    """One campaign to simulate; its repr reproduces it."""

    seed: int
    design: str
    noise: str
    effect: str | None = None
    times_mde: float = 0.0
    superfluous: tuple[str, ...] = ()  # effects of the simulation that the gyro has not


@dataclass(frozen=True)
class Built:
    """A simulated campaign, with what only the judges may see."""

    columns: dict[str, Array]
    units: dict[str, str]
    metadata: dict[str, Any]
    truth: Truth
    design: Design
    noise: Noise
    seed: int
    simulated: tuple[str, ...]  # effects of the model that the engine starts from


@dataclass(frozen=True)
class Record:
    """A case of some rows, what the engine answered and how that was judged.

    `size` is the norm lambda of the hidden signal; `isolable` whether every rival separates from it at 3 x MDE;
    `oracle_first` what the oracle names, and `oracle_firm` whether it is sure; `controls` what the control methods
    answer.
    """

    case: Case
    truth: Truth
    answer: Answer | None
    score: Score | None
    size: float
    isolable: bool
    oracle_first: str
    oracle_firm: bool
    controls: dict[str, contest.Control]
    rows: int


def build(case: Case, noise_of: NoiseOf | None = None) -> Built:
    """Simulate a case, its noise drawn by kind, or that of its design by `noise_of`."""
    rng = np.random.default_rng(case.seed)
    design = (DESIGNS | MOTION_DESIGNS | OTHER_DESIGNS)[case.design](rng)
    noise = noise_of(case.noise, design) if noise_of else draw(case.noise, design, rng)
    hidden = hide(case.effect, design, noise, case.times_mde, rng)
    return Built(*hidden, design, noise, case.seed, (*hidden[-1].baseline, *case.superfluous))


def run_engine(
    built: Built, *, gain: bool = False, calibrate: int = 0, after: bool = False, mutant: str = ""
) -> Answer | None:
    """The only place that calls the package; None where it refuses a simulation for what that has besides.

    Args:
        built: the campaign.
        gain: whether to measure the held-out gain.
        calibrate: draws with nothing hidden.
        after: whether to diagnose the extended model too, and to carry out the further test that is asked for.
        mutant: what to switch off in the engine.
    """
    import gyromodel
    from gyromodel.estimate import EstimateError
    from gyromodel.units import factor, internal_unit

    campaign = gyromodel.Campaign(columns=built.columns, units=built.units, metadata=built.metadata)
    model = gyromodel.model_from_effects(list(built.simulated))
    try:
        with mutated(mutant):
            found = gyromodel.diagnose(campaign, model, hold_out=gain, calibrate=calibrate)
    except EstimateError:
        if built.simulated == built.truth.baseline:
            raise
        return None
    sizes = {}
    for cause in (c for c in found.causes if c.parameters):
        size = cause.parameters[0]
        scale = factor(size.unit, internal_unit(size.unit))
        low, high = size.ci95 or (size.value - 1.96 * size.std, size.value + 1.96 * size.std)
        sizes[cause.effect] = (low * scale, high * scale)
    adequate = None
    if after and found.verdict in ("named", "ambiguous"):
        try:
            again = gyromodel.diagnose(campaign, found.extended.model_as_given(), hold_out=False)
            adequate = again.verdict == "adequate"
        except EstimateError:  # what was found cannot be fitted anew
            adequate = False
    driver = tuple(found.driver.column.split(" and ")) if found.driver else ()
    first = (c.statistic for r in found.rounds[:1] for c in r.ranking if c.effect != "outliers")
    measured = found.gain
    return Answer(
        verdict=found.verdict,
        causes=tuple(c.effect for c in found.causes),
        first=next((c.effect for c in found.rounds[0].ranking if c.kind == "effect"), "") if found.rounds else "",
        sizes=sizes,
        noise=next(iter(found.noise_kinds), ""),
        p_value=found.p_value,
        adequate_after=adequate,
        settled=settled(built, campaign, model, found.next_test) if after and found.verdict == "ambiguous" else None,
        credible=tuple(found.credible_set),
        driver=driver,
        gain_ratio=(measured.ratio, *measured.ci95),
        gain_score=(measured.log_score, *measured.log_score_ci95),
        margin=max(first, default=-np.inf) - found.threshold,
    )


# One in so many campaigns is shown to what takes long.
SOME = 3


def oracle_told(record: Record, *, beside: bool = False) -> Told:
    """What an oracle tells of a campaign that knows how levels are drawn, and what column the unlisted follows.

    Of that the function is smooth at some length, as far as anybody knows: its evidence is that of "smooth". Where a
    listed effect was called unknown, the column is the one that the engine has named. `beside` the hidden effect, which
    is then known but for its size, it tells what more there is.
    """
    built = build(record.case)
    design, truth = built.design, built.truth
    data = np.deg2rad(built.columns["output"]) - design.true["rate"]
    none = np.zeros((len(data), 0))
    fixed = np.column_stack([none, *(error(name, design, 1.0, {}) for name in truth.baseline)])
    signals = contest.everything(design, record.case.effect)
    if beside:
        fixed = np.column_stack([fixed, truth.error / np.abs(truth.error).max()])
        signals = {name: block for name, block in signals.items() if name not in parts(truth.effect)}
    driver = truth.driver or (record.answer.driver if record.answer and known(truth.effect) else ())
    smooths = contest.smooths(design, driver) if driver else {}
    told = tell(data, design, fixed, signals | smooths)
    if truth.effect is None and record.case.seed % SOME == 0:
        told = told._replace(anyhow=kinds_of_any_level(data, design, fixed))
    if not smooths:
        return told
    names = {name: value for name, value in told.evidence.items() if name not in smooths}
    together = float(logsumexp([told.evidence[name] for name in smooths]) - np.log(len(smooths)))
    return Told(told.kinds, names | {"smooth": together})


def settled(built: Built, campaign: Any, model: Any, asked: str | None) -> tuple[str, ...] | None:
    """The credible set once the further test has been carried out too, by the simulator; None where none is known."""
    import gyromodel
    from gyromodel.diagnosis._added_tests import added_tests

    test = next((t for t in added_tests(campaign) if (asked or "").startswith(t.sentence)), None)
    if test is None:
        return None
    temperature = test.campaign.columns["temperature"]
    rate = np.gradient(temperature, built.design.true["time"])
    lived = replace(built.design, true=built.design.true | {"temperature": temperature, "temperature_rate": rate})
    rng = np.random.default_rng([built.seed, 1])
    wrong = error(str(built.truth.effect), lived, built.truth.amplitude, built.truth.shape)
    output = wrong + built.truth.bias + built.noise.sample(lived, rng)
    second = test.campaign.with_column("output", np.rad2deg(output), "deg/s")
    return tuple(gyromodel.diagnose([campaign, second], model, hold_out=False).credible_set)


def run_case(
    case: Case, *, engine: bool = True, controls: Iterable[str] = (), noise_of: NoiseOf | None = None, **options: Any
) -> Record:
    """Simulate, diagnose and judge one case, also by some controls; `options` are those of `run_engine`."""
    built = build(case, noise_of)
    truth, design = built.truth, built.design
    size, isolable, first, firm, others = 0.0, False, "", False, {}
    if controls or known(case.effect):
        signals = contest.library(design, case.effect)
        data = built.columns["output"] * np.pi / 180 - design.true["rate"]
    if known(case.effect):
        knower = oracle(design, built.noise, truth.baseline)
        unit = contest.reduced(knower, signals)
        size = knower.norm(truth.error)
        first, firm = contest.oracle_answer(unit, knower.reduce(data[:, None])[:, 0], size)
        isolable = _isolable(case, truth, knower, signals)
    if controls:
        plain = oracle(design, Noise("white", np.sqrt(design.step)), truth.baseline)  # unit variance: least squares
        unit = contest.reduced(plain, signals)
        residual = plain.reduce(data[:, None])[:, 0]
        methods = {
            "least_squares_f": lambda: contest.least_squares_f(unit, residual, len(truth.baseline)),
            "hac_f": lambda: contest.hac_f(unit, residual),
            "stepwise_bic": lambda: contest.stepwise_bic(unit, residual),
            "lasso": lambda: contest.lasso(unit, residual),
            "boosted_trees": lambda: contest.boosted_trees(design, residual),
        }
        others = {name: methods[name]() for name in controls}
    answer = run_engine(built, **options) if engine else None
    score = judge(truth, design.name, answer, isolable or not known(case.effect)) if answer else None
    return Record(case, truth, answer, score, size, isolable, first, firm, others, len(truth.noise))


def _isolable(case: Case, truth: Truth, knower: Oracle, signals: contest.Library) -> bool:
    """Whether each hidden effect, the others known, is told from every rival at 3 x MDE."""
    names = parts(case.effect)
    for i, name in enumerate(names):
        beside = knower
        for other, signal in zip(names, truth.errors, strict=True):
            # Beside the other as it is, or at any coefficients where it has but one form.
            block = signals.get(other, np.zeros((0, 0, 0)))
            taken = block[:, 0] if block.shape[1] == 1 else signal[:, None]
            if other != name:
                basis = np.column_stack([knower.basis, knower.reduce(taken / np.abs(taken).max())])
                beside = replace(knower, basis=np.linalg.qr(basis)[0])
        rivals = {k: v for k, v in signals.items() if k == name or k not in names}
        wrong = beside.reduce(truth.errors[i][:, None])[:, 0]
        needed = contest.separation_needed(contest.reduced(beside, rivals), name, wrong)
        if np.linalg.norm(wrong) / case.times_mde * 3 < max(needed.values(), default=0.0):
            return False
    return True


def _seeds(seed: int, count: int) -> list[int]:
    return [int(s) for s in np.random.SeedSequence(seed).generate_state(count, np.uint64) >> np.uint64(12)]


def null_cases(
    count: int, seed: int, noises: Iterable[str] = FAMILY, designs: Iterable[str] = (*HOMES, *MOTION)
) -> list[Case]:
    """Nothing hidden: designs and noises in an order of the seed, each as often as any other."""
    # Noise cannot grow with what does not vary.
    still = {"grows_with_rate": (B, RUNS, LOOP), "grows_with_temperature_rate": (LOOP,)}
    cells = [(d, n) for n in noises for d in designs if d not in still.get(n, ())]
    order = cycle(np.random.default_rng(seed).permutation(len(cells)))
    return [Case(s, *cells[next(order)]) for s in _seeds(seed, count)]


def effect_cases(count: int, seed: int, times_mde: float, noises: Iterable[str] = FAMILY[:3]) -> list[Case]:
    """Catalogue effects in turn, each in its designs and noises in turn, from where the seed says."""
    names = sorted({e for d in HOMES for e in TESTABLE[d]})
    return _in_turn(count, seed, times_mde, tuple(noises), names, TESTABLE)


def curve_cases(count: int, seed: int, times_mde: float, noises: Iterable[str] = FAMILY[:3]) -> list[Case]:
    """As `effect_cases`, of curves that the simulated bias and scale factor take up in part."""
    return _in_turn(count, seed, times_mde, tuple(noises), ["bias_temperature_curve", "scale_nonlinearity"], TESTABLE)


def unknown_cases(count: int, seed: int, times_mde: float, noises: Iterable[str] = FAMILY[:3]) -> list[Case]:
    """Effects that no catalogue has, in turn."""
    names = sorted({e for d in HOMES for e in UNCATALOGUED.get(d, ())})
    return _in_turn(count, seed, times_mde, tuple(noises), names, UNCATALOGUED)


def pair_cases(count: int, seed: int, times_mde: float, noises: Iterable[str] = FAMILY[:3]) -> list[Case]:
    """Two catalogue effects at once, of those that one run tells from noise; neither contains the other.

    A curve holds a slope, and a Shupe effect that changes with temperature one that does not.
    """
    cells = [
        (d, n, a, b)
        for d in (A, B, C)
        for n in noises
        for a, b in combinations([e for e in TESTABLE[d] if e not in SLOW], 2)
        if b != f"{a}_curve" and {a, b} != {"bias_temperature_rate", "bias_temperature_product"}
    ]
    order = np.random.default_rng(seed).permutation(len(cells))
    chosen = [cells[order[i % len(cells)]] for i in range(count)]
    return [Case(s, d, n, f"{a}+{b}", times_mde) for s, (d, n, a, b) in zip(_seeds(seed, count), chosen, strict=True)]


def moving_unknown_cases(count: int, seed: int, times_mde: float, noises: Iterable[str] = FAMILY) -> list[Case]:
    """As `unknown_cases`, of gyros that are tumbled, turned and driven, in an order of the seed."""
    cells = [(d, n, e) for d in MOTION for n in noises for e in UNCATALOGUED[d]]
    return _in_order(cells, count, seed, times_mde)


def moving_pair_cases(count: int, seed: int, times_mde: float, noises: Iterable[str] = FAMILY) -> list[Case]:
    """As `pair_cases`, of gyros that are tumbled, turned and driven."""
    pairs = {d: combinations([e for e in TESTABLE[d] if e in MOTION_EFFECTS], 2) for d in MOTION}
    cells = [(d, n, f"{a}+{b}") for d, of_design in pairs.items() for a, b in of_design for n in noises]
    return _in_order(cells, count, seed, times_mde)


def _in_order(cells: Sequence[tuple[str, str, str | None]], count: int, seed: int, times_mde: float) -> list[Case]:
    order = np.random.default_rng(seed).permutation(len(cells))
    return [Case(s, *cells[order[i % len(cells)]], times_mde) for i, s in enumerate(_seeds(seed, count))]


def inseparable_cases(count: int, seed: int) -> list[Case]:
    """A static log on one monotone ramp: a slope in temperature and a drift cannot be told apart."""
    effects, noises = TESTABLE["static_ramp"], FAMILY[:3]
    cells = [(n, e) for n in noises for e in effects]
    return [Case(s, "static_ramp", *cells[i % len(cells)], 3.0) for i, s in enumerate(_seeds(seed, count))]


def superfluous_cases(count: int, seed: int, times_mde: float) -> list[Case]:
    """One to four effects of the simulation that the gyro has not, and nothing hidden, or one other effect in turn."""
    rng = np.random.default_rng(seed)
    hidden = {d: [e for e in TESTABLE[d] if e not in SLOW] if times_mde else [None] for d in STATED}
    cells = [(d, n, e) for d in STATED for n in FAMILY for e in hidden[d]]
    cases = []
    for case in _in_order(cells, count, seed, times_mde):
        chosen: list[str] = []
        for name in rng.permutation([e for e in STATED[case.design] if e not in ("bias", "scale_factor", case.effect)]):
            if not any(name in group and group & {case.effect, *chosen} for group in ALIKE):
                chosen.append(str(name))
        cases.append(replace(case, superfluous=tuple(chosen[: rng.integers(1, 5)])))
    return cases


def drift_cases(count: int, seed: int) -> list[Case]:
    """A pure drift under random walk."""
    return [Case(s, (A, B, C)[i % 3], "random_walk", "bias_drift", 3.0) for i, s in enumerate(_seeds(seed, count))]


def motion_cases(count: int, seed: int, times_mde: float, noises: Iterable[str] = FAMILY[:2]) -> list[Case]:
    """Effects of specific force, field, geometry and time, each in its designs and noises, in an order of the seed."""
    cells = [(d, e, n) for n in noises for d in MOTION for e in TESTABLE[d] if e in MOTION_EFFECTS]
    order = cycle(np.random.default_rng(seed).permutation(len(cells)))
    chosen = [cells[next(order)] for _ in range(count)]
    return [Case(s, d, n, e, times_mde) for s, (d, e, n) in zip(_seeds(seed, count), chosen, strict=True)]


def other_cases(count: int, seed: int, times_mde: float) -> list[Case]:
    """Effects of what few campaigns log, each in its designs and noises, in an order of the seed."""
    cells = [(d, n, e) for d in OTHER_DESIGNS for n in FAMILY for e in TESTABLE[d] if e in OTHER_EFFECTS]
    return _in_order(cells, count, seed, times_mde)


def _in_turn(
    count: int,
    seed: int,
    times_mde: float,
    noises: tuple[str, ...],
    names: list[str],
    homes: dict[str, tuple[str, ...]],
) -> list[Case]:
    cases, first = [], int(np.random.default_rng(seed).integers(10**6))
    for i, s in enumerate(_seeds(seed, count), start=first):
        effect, lap = names[i % len(names)], i // len(names)
        designs = [d for d in HOMES if effect in homes.get(d, ())]
        cells = [
            (designs[(k + shift) % len(designs)], n) for shift in range(len(designs)) for k, n in enumerate(noises)
        ]
        design, noise = cells[(lap + i % len(names)) % len(cells)]
        cases.append(Case(s, design, noise, effect, times_mde))
    return cases


def run_cases(cases: list[Case], workers: int = 1, **options: Any) -> list[Record]:
    """Run cases, each with the options of `run_case`."""
    return in_processes(partial(run_case, **options), cases, workers)


def in_processes(function: Callable[[S], T], cases: list[S], workers: int) -> list[T]:
    """What a function makes of each case, in fresh processes when there are several workers (JAX does not fork)."""
    if workers == 1:
        return [function(case) for case in cases]
    # Read by the new processes, which would fight for the cores.
    os.environ |= {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        return list(pool.map(function, cases))


@dataclass(frozen=True)
class Confusion:
    """How often a rival was ranked above the hidden effect: predicted before the data, and counted.

    Of the campaigns whose ranking lists either.
    """

    design: str
    effect: str
    rival: str
    predicted: float
    wrong: int
    total: int


def confusion(seed: int, name: str, effect: str, rival: str, predicted: float, draws: int) -> Confusion:
    """Hide an effect at the size where a rival should be preferred in a given share of campaigns of white noise."""
    import gyromodel
    from gyromodel.units import factor, internal_unit

    rng = np.random.default_rng(seed)
    design = DESIGNS[name](rng)
    noise = draw("white", design, rng)
    names = [n for n in baseline(design) if n != effect]
    units = design.units | {"output": "deg/s"}
    campaign = gyromodel.Campaign(design.columns | {"output": design.true["time"]}, units, design.metadata)
    stated = gyromodel.GyroModel(gyromodel.model_from_effects(names).effects, {"noise_white": noise.white})
    if "scale_factor" in names:
        stated = stated.with_vector(np.eye(len(names))[names.index("scale_factor")])
    planned = gyromodel.isolability(campaign, stated, tests=False)
    apart = planned.apart[effect, rival]
    size = brentq(lambda size: planned.mistaken(effect, rival, size) - predicted, 0.0, 4.0 * apart.value)
    size *= factor(apart.unit, internal_unit(apart.unit))
    wrong, lost, listed = error(effect, design, size, {}), 0, 0
    for _ in range(draws):
        output = np.rad2deg(design.true["rate"] + wrong + noise.sample(design, rng))
        measured = campaign.with_column("output", output, "deg/s")
        found = gyromodel.diagnose(measured, gyromodel.model_from_effects(names), hold_out=False)
        evidence = {c.effect: c.statistic for c in found.rounds[0].ranking}
        lost += evidence.get(rival, -np.inf) > evidence.get(effect, -np.inf)
        listed += bool({rival, effect} & evidence.keys())
    return Confusion(name, effect, rival, predicted, lost, listed)
