"""Who wins among named signals: the oracle that knows noise and size, and the controls that should fail.

A library maps each name to an array (sample, shape, column): every shape is one candidate, its columns fitted together.
"""

from __future__ import annotations

from typing import NamedTuple
from warnings import catch_warnings

import numpy as np
from scipy.special import gammaln, ive, logsumexp
from scipy.stats import chi2
from scipy.stats import f as f_distribution

from .campaigns import TESTABLE
from .designs import RAMP_CODES, Design
from .effects import error
from .mde import Oracle, baseline
from .memory import friction
from .motion import BASIS, SMALL
from .other_designs import OTHER_BASIS, OTHER_SMALL

# Share of the posterior and evidence (nats) of a name that is firm.
FIRM, NEEDED = 0.95, 4.0

Array = np.ndarray
Library = dict[str, Array]


def library(design: Design, effect: str | None) -> Library:
    """Signals of every catalogue effect the design can show and the baseline lacks, on grids of shapes."""
    names = [n for n in TESTABLE[design.name] if n not in baseline(design, effect)]
    return {name: _signals(name, design) for name in names}


def _signals(name: str, design: Design) -> Array:
    time = design.true["time"]
    span = np.ptp(time)
    shapes: list[dict[str, object]] = [{}]
    small, basis = SMALL | OTHER_SMALL, BASIS | OTHER_BASIS
    if name in basis:
        size = small.get(name, 1.0)
        return np.stack([error(name, design, size, shape) for shape in basis[name]], axis=-1)[:, None]
    match name:
        case "scale_nonlinearity":
            return np.stack([error(name, design, 1.0, {"mix": row}) for row in np.eye(4)], axis=-1)[:, None]
        case "time_delay" | "bandwidth":
            sizes = design.step * np.geomspace(0.03, 5.0, 12)
            return np.stack([error(name, design, size, {}) / size for size in sizes], axis=1)[:, :, None]
        case "lock_in" | "saturation":
            sizes = np.abs(design.true["rate"]).max() * np.geomspace(1e-3, 0.3, 16)
            return np.stack([error(name, design, size, {}) for size in sizes], axis=1)[:, :, None]
        case "scale_spline":
            x = design.true["rate"] / np.abs(design.true["rate"]).max()
            return np.exp(-0.5 * ((x[:, None] - np.linspace(-1, 1, 9)) / 0.25) ** 2)[:, None]
        case "bias_periodic":
            angle = 2 * np.pi * np.outer(time, np.arange(4 / span, 0.22 / design.step, 1 / (4 * span)))
            return np.stack([np.sin(angle), np.cos(angle)], axis=-1)
        case "bias_temperature_curve" | "scale_temperature_curve":
            knots = np.percentile(design.true["temperature"], np.linspace(20, 80, 12))
            shapes = [{"kind": kind, "at": at} for kind in ("parabola", "bend") for at in knots]
        case "bias_thermal_hysteresis" | "rate_hysteresis":
            driver = design.true["rate" if name == "rate_hysteresis" else "temperature"]
            return friction(driver, np.geomspace(0.03, 0.25, 10) * np.ptp(driver))[:, :, None]
        case "bias_readout_code":
            angle = np.pi * design.true["feedback_ramp"][:, None] / RAMP_CODES * np.arange(1, 9)
            return np.concatenate([np.sin(angle), np.cos(angle)], axis=1)[:, None]
        case "bias_turn_on":
            runs = np.eye(len(np.unique(design.true["run"])))[1:]
            return np.stack([error(name, design, 1.0, {"offsets": row}) for row in runs], axis=-1)[:, None]
        case "bias_temperature_rate" | "bias_temperature_product":
            shapes = [{"tau": 2.5 * design.step}]
            if "temperature_coil" in design.true:
                # What a case and its coil differ by is the rate of a place deep in it.
                shapes = [{"tau": tau * design.step} for tau in np.geomspace(1.0, 60.0, 9)]
        case "bias_warmup":
            shapes = [{"tau": tau * span} for tau in np.geomspace(0.04, 0.3, 12)]
        case "bias_step":
            shapes = [{"at": at} for at in 0.5 * (time[1:] + time[:-1])[len(time) // 12 : -(len(time) // 12)]]
    size = 0.3 / np.abs(design.true["rate"]).max() if name == "scale_sagnac_sine" else small.get(name, 1.0)
    return np.stack([error(name, design, size, shape) for shape in shapes], axis=1)[:, :, None]


def everything(design: Design, effect: str | None) -> Library:
    """As `library`, of every effect whose columns the design has, whether or not the study hides it there."""
    signals = {}
    for name in sorted({e for effects in TESTABLE.values() for e in effects} - {*baseline(design, effect)}):
        try:
            with np.errstate(all="ignore"), catch_warnings(action="ignore"):
                block = _signals(name, design)
        except (KeyError, AssertionError):  # it needs what the design lacks
            continue
        if np.isfinite(block).all() and np.abs(block).max() > 0:
            signals[name] = block
    return signals


def smooths(design: Design, driver: tuple[str, ...]) -> Library:
    """Functions of one column or of two, by length: Gaussian kernels; none where no column is the driver itself."""
    names = ["temperature_rate" if column == "d(temperature)/dt" else column for column in driver]
    if not all(name in design.true for name in names):
        return {}
    found = {}
    for length in (0.25, 0.6) if len(names) > 1 else (0.08, 0.2, 0.5):
        block = np.ones((len(design.index), 1))
        for name in names:
            x = (design.true[name] - design.true[name].min()) / np.ptp(design.true[name])
            each = np.exp(-0.5 * ((x[:, None] - np.arange(-length, 1 + 2 * length, length)) / length) ** 2)
            block = (block[:, :, None] * each[:, None, :]).reshape(len(block), -1)
        found[f"smooth {length:g}"] = block[:, None]
    return found


def reduced(judge: Oracle, signals: Library) -> Library:
    """Whitened, projected and, within each shape, orthonormalised signals."""
    result = {}
    for name, block in signals.items():
        flat = judge.reduce(block.reshape(len(block), -1) / np.abs(block).max())
        result[name] = orthonormal(flat.reshape(block.shape))
    return result


def orthonormal(block: Array) -> Array:
    """The columns of each shape as orthonormal ones."""
    unit = block.copy()
    for j in range(unit.shape[2]):
        for i in range(j):
            unit[:, :, j] -= np.sum(unit[:, :, i] * unit[:, :, j], axis=0) * unit[:, :, i]
        unit[:, :, j] /= np.maximum(np.linalg.norm(unit[:, :, j], axis=0), 1e-300)
    return unit


def energies(unit: Library, residual: Array) -> dict[str, Array]:
    """|U^T r|^2 of every shape."""
    return {name: np.sum(np.tensordot(residual, u, 1) ** 2, axis=-1) for name, u in unit.items()}


def oracle_answer(unit: Library, residual: Array, size: float) -> tuple[str, bool]:
    """Most probable name when noise and size (lambda) are known; direction and shape uniform on their grids.

    And whether it is firm: 95 % of the posterior over names, with the evidence against nothing hidden that an addition
    needs.
    """
    score = {}
    for name, energy in energies(unit, residual).items():
        order, x = unit[name].shape[2] / 2 - 1, size * np.sqrt(energy)
        score[name] = float(
            logsumexp(gammaln(order + 1) + order * np.log(2 / x) + np.log(ive(order, x)) + x, b=1 / len(x))
        )
    first = max(score, key=score.__getitem__)
    share = np.exp(score[first] - logsumexp(list(score.values())))
    return first, bool(share >= FIRM and score[first] - size**2 / 2 >= NEEDED)


def separation_needed(unit: Library, truth: str, signal: Array) -> dict[str, float]:
    """lambda from which each rival is told from the true signal with 95 %: 1.645 sqrt(2/(1 - rho))."""
    direction = signal / np.linalg.norm(signal)
    rho = {name: np.sqrt(e.max()) for name, e in energies(unit, direction).items() if name != truth}
    return {name: float(1.645 * np.sqrt(2 / max(1 - r, 1e-12))) for name, r in rho.items()}


class Control(NamedTuple):
    """What a control method answers: the names it adds, first one first."""

    added: tuple[str, ...]
    first: str


def least_squares_f(unit: Library, residual: Array, parameters: int) -> Control:
    """F test as if the noise were white, Bonferroni over every candidate and shape, 1 %."""
    rss, tests = residual @ residual, sum(u.shape[1] for u in unit.values())
    p = {}
    for name, energy in energies(unit, residual).items():
        q, best = unit[name].shape[2], energy.max()
        nu = len(residual) - parameters - q
        p[name] = f_distribution.logsf(best / q / ((rss - best) / nu), q, nu)
    first = min(p, key=p.__getitem__)
    return Control((first,) if p[first] < np.log(0.01 / tests) else (), first)


def stepwise_bic(unit: Library, residual: Array, most: int = 4) -> Control:
    """Forward selection while the Bayesian information criterion falls."""
    n, added, first = len(residual), [], ""
    for _ in range(most):
        rss = residual @ residual
        gain, name, where = -np.inf, "", 0
        for candidate, energy in energies(unit, residual).items():
            change = -n * np.log1p(-energy.max() / rss) - unit[candidate].shape[2] * np.log(n)
            if change > gain:
                gain, name, where = change, candidate, int(energy.argmax())
        first = first or name
        if gain <= 0:
            break
        added.append(name)
        U = unit[name][:, where]
        residual = residual - U @ (U.T @ residual)
    return Control(tuple(dict.fromkeys(added)), first)


def hac_f(unit: Library, residual: Array, lags: int = 6) -> Control:
    """Wald test with the covariance of Newey and West, Bonferroni over every candidate and shape, 1 %."""
    tests, p = sum(u.shape[1] for u in unit.values()), {}
    for name, u in unit.items():
        b = np.einsum("nmq,n->mq", u, residual)
        score = u * (residual[:, None] - np.einsum("nmq,mq->nm", u, b))[:, :, None]
        V = np.einsum("nmi,nmj->mij", score, score)
        for lag in range(1, lags + 1):
            G = np.einsum("nmi,nmj->mij", score[lag:], score[:-lag])
            V += (1 - lag / (lags + 1)) * (G + G.transpose(0, 2, 1))
        wald = np.einsum("mi,mi->m", b, np.linalg.solve(V, b[:, :, None])[:, :, 0])
        p[name] = chi2.logsf(wald.max(), u.shape[2])
    first = min(p, key=p.__getitem__)
    return Control((first,) if p[first] < np.log(0.01 / tests) else (), first)


def lasso(unit: Library, residual: Array, most_columns: int = 60) -> Control:
    """Lasso on the columns that correlate best; penalty by five-fold cross-validation."""
    from sklearn.linear_model import LassoCV
    from sklearn.model_selection import KFold

    X, owner = [], []
    for name, u in unit.items():
        for m in np.argsort(-energies({name: u}, residual)[name])[:8]:
            X += list(u[:, m].T)
            owner += [name] * u.shape[2]
    keep = np.argsort(-np.abs(np.array(X) @ residual))[:most_columns]
    scale = np.sqrt(len(residual))  # columns of unit variance, as the penalty wants them
    columns, owner = scale * np.array(X)[keep].T, [owner[k] for k in keep]
    with catch_warnings(action="ignore"):
        b = LassoCV(cv=KFold(5), fit_intercept=False).fit(columns, residual / residual.std()).coef_
    order = np.argsort(-np.abs(b))
    added = tuple(dict.fromkeys(owner[i] for i in order if b[i] != 0))
    return Control(added, added[0] if added else owner[0])


def boosted_trees(design: Design, residual: Array) -> Control:
    """Gradient-boosted trees on the measured columns: the one that matters most, if left-out fifths are predicted."""
    from sklearn.ensemble import HistGradientBoostingRegressor
    from sklearn.inspection import permutation_importance
    from sklearn.model_selection import KFold, cross_val_predict

    names = [n for n in design.columns if np.ptp(design.columns[n]) > 0]
    X = np.column_stack([design.columns[n] for n in names])
    trees = HistGradientBoostingRegressor(max_iter=60, random_state=0)
    left = residual - cross_val_predict(trees, X, residual, cv=KFold(5))
    importance = permutation_importance(trees.fit(X, residual), X, residual, n_repeats=3, random_state=0)
    first = f"smooth({names[int(np.argmax(importance.importances_mean))]})"
    return Control((first,) if left @ left < residual @ residual else (), first)
