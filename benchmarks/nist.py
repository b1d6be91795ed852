"""The NIST reference problems of nonlinear regression, through this package's fit and its peers.

    python -m benchmarks.nist

writes benchmarks/results/nist.md. GYROMODEL_DATA names the folder that holds nist_strd; peers that are not installed
are left out and named.
"""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from scipy.optimize import curve_fit, least_squares

from benchmarks._measure import ROOT, table, write_result
from gyromodel.estimate import EstimateError, fit_function
from tests.truth import nist

Answer = tuple[np.ndarray, np.ndarray | None]
# Digits that count as reached: parameters, and their standard deviations.
PARAMETERS, DEVIATIONS = 6, 5


def _gyromodel(p: nist.Problem, start: np.ndarray) -> Answer:
    found = fit_function(p.model, jnp.asarray(start), p.response, jnp.asarray(p.predictor))
    return found.parameters.vector, found.parameters.std


def _curve_fit(p: nist.Problem, start: np.ndarray) -> Answer:
    def model(x: Any, *b: float) -> np.ndarray:
        return np.asarray(p.model(np.asarray(b), p.predictor))

    value, covariance = curve_fit(model, np.arange(len(p.response)), p.response, start, maxfev=20_000)
    return value, np.sqrt(np.diag(covariance))


@eqx.filter_jit
def _residual(b, model, predictor, response):
    return model(b, predictor) - response


_jacobian = eqx.filter_jit(jax.jacfwd(_residual))


def _scipy_trf(p: nist.Problem, start: np.ndarray) -> Answer:
    arguments = (p.model, jnp.asarray(p.predictor), jnp.asarray(p.response))
    found = least_squares(
        lambda b: np.asarray(_residual(jnp.asarray(b), *arguments)),
        start,
        lambda b: np.asarray(_jacobian(jnp.asarray(b), *arguments)),
        x_scale="jac",
        ftol=1e-15,
        xtol=1e-15,
        gtol=1e-15,
        max_nfev=10_000,
    )
    spread = 2 * found.cost / (len(p.response) - len(start))
    return found.x, np.sqrt(np.diag(np.linalg.inv(found.jac.T @ found.jac)) * spread)


def _optimistix(solver: Any) -> Callable[[nist.Problem, np.ndarray], Answer]:
    def solve(p: nist.Problem, start: np.ndarray) -> Answer:
        def residual(b: Any, _: Any) -> Any:
            return p.model(b, jnp.asarray(p.predictor)) - p.response

        found = optx.least_squares(residual, solver, jnp.asarray(start), max_steps=10_000, throw=False)
        return np.asarray(found.value), None

    return solve


def _lmfit(p: nist.Problem, start: np.ndarray) -> Answer:
    import lmfit

    names = [f"b{i + 1}" for i in range(len(start))]
    parameters = lmfit.create_params(**dict(zip(names, start, strict=True)))

    def residual(b: Any) -> np.ndarray:
        return np.asarray(p.model(np.array([b[n].value for n in names]), p.predictor)) - p.response

    found = lmfit.minimize(residual, parameters, max_nfev=20_000)
    value = np.array([found.params[n].value for n in names])
    return value, np.array([found.params[n].stderr or np.nan for n in names])


METHODS: dict[str, Callable[[nist.Problem, np.ndarray], Answer]] = {
    "**gyromodel `fit_function`**": _gyromodel,
    "scipy `curve_fit` (MINPACK), as it comes": _curve_fit,
    "scipy `least_squares` trf, exact Jacobian, tolerances 1e-15": _scipy_trf,
    "optimistix Levenberg-Marquardt 1e-10": _optimistix(optx.LevenbergMarquardt(rtol=1e-10, atol=1e-10)),
    "optimistix Dogleg 1e-10": _optimistix(optx.Dogleg(rtol=1e-10, atol=1e-10)),
    "optimistix Gauss-Newton 1e-10": _optimistix(optx.GaussNewton(rtol=1e-10, atol=1e-10)),
    "lmfit `minimize` (MINPACK), as it comes": _lmfit,
}


def _digits(method: Callable[[nist.Problem, np.ndarray], Answer], p: nist.Problem, start: np.ndarray) -> list[float]:
    """Digits of the parameters and of their deviations, NaN where the method gives none."""
    try:
        value, deviations = method(p, start)
    except (EstimateError, RuntimeError, ValueError, np.linalg.LinAlgError):
        return [0.0, 0.0]
    with np.errstate(all="ignore"):
        of_deviations = np.nan if deviations is None else nist.digits(np.nan_to_num(deviations), p.deviations)
        return [nist.digits(np.nan_to_num(value), p.certified), of_deviations]


def main(argv: list[str] | None = None) -> None:
    argv = sys.argv[1:] if argv is None else argv
    warnings.simplefilter("ignore")  # what peers say of their own difficulties is in the digits
    folder = Path(os.environ.get("GYROMODEL_DATA", ROOT.parent / "shared" / "data")) / "nist_strd"
    problems = [nist.read(path) for path in sorted(folder.glob("*.dat"))]
    absent = [] if find_spec("lmfit") else ["lmfit is not installed and was left out."]
    methods = {k: m for k, m in METHODS.items() if m is not _lmfit or not absent}
    with_errors = np.array([p.name != nist.WITHOUT_ERRORS for p in problems])
    rows, missed = [], []
    for name, method in methods.items():
        found = np.array([[_digits(method, p, s) for s in p.starts] for p in problems])
        reached = found[:, :, 0] >= PARAMETERS
        counts = [f"{int(n)}" for n in reached.sum(axis=0)]
        if np.isnan(found[:, 1, 1]).all():
            counts += ["–", "–"]
        else:
            counts += [f"{int(n)}" for n in (found[with_errors, :, 1] >= DEVIATIONS).sum(axis=0)]
        rows.append([name, *counts])
        each = [f"{p.name} from start {k + 1}" for i, p in enumerate(problems) for k in (0, 1) if not reached[i, k]]
        missed.append(f"- {name}: {', '.join(each) or 'none'}")
        print(rows[-1], flush=True)
    head = ["method", "start 1", "start 2", "deviations, start 1", "deviations, start 2"]
    lines = [
        f"{len(problems)} problems, two starts each, start 1 far and start 2 near. Counted are problems with at least "
        f"{PARAMETERS} certified digits in every parameter, and {DEVIATIONS} in every standard deviation (of "
        f"{with_errors.sum()}: the residual of {nist.WITHOUT_ERRORS} is below double precision).",
        "",
        *table(head, rows),
        "",
        "Missed parameters:",
        "",
        *missed,
        *(["", *absent] if absent else []),
    ]
    write_result("nist", "NIST reference problems of nonlinear regression", "nist", argv, lines)


if __name__ == "__main__":
    main()
