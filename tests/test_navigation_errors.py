"""Fitted gyros pushed through navigation: closed forms of a short run at rest, and Monte Carlo."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from gyromodel.campaign import Campaign
from gyromodel.estimate import Estimate, fit
from gyromodel.model import GyroModel, model_from_effects
from gyromodel.platform import Navigation, earth_rate, gravity, navigation_error, radii
from gyromodel.platform._errors import _errors

STEPS, EVERY, STEP = 4000, 10, 0.1
DEG_H = np.pi / 180 / 3600
START = Navigation(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.zeros(3), jnp.array([0.6, 0.0, 100.0]))
TIME = np.arange(STEPS) * STEP


def fitted(rng: np.random.Generator, bias: float) -> Estimate:
    """A gyro at rest over temperature: `bias` deg/h at 20 °C and 0.02 deg/h/°C, white noise of 0.5 deg/h a sample."""
    time = np.arange(256) * 20.0
    temperature = 20.0 + 15.0 * np.sin(time / 700.0)
    output = bias + 0.02 * (temperature - 20.0) + 0.5 * rng.standard_normal(256)
    units = {"time": "s", "temperature": "degC", "output": "deg/h"}
    log = Campaign({"time": time, "temperature": temperature, "output": output}, units, {"kind": "rate"})
    model = model_from_effects(["bias", "bias_temperature"])
    white = {"noise_white": 0.5 * DEG_H * np.sqrt(20.0)}
    return fit(log, GyroModel(model.effects, white, model.fixed, model.gyro))


def at_rest() -> jax.Array:
    """What ideal accelerometers sense in axes that keep still while the Earth turns: g, upwards."""
    turn = np.asarray(earth_rate(START.position[0])) * (TIME[:, None] + 0.5 * STEP)
    up = np.array([0.0, float(gravity(START.position[0], START.position[2])), 0.0])
    return jnp.asarray(Rotation.from_rotvec(turn).apply(up) * STEP)


def mission(temperature: float) -> dict[str, jax.Array]:
    return {"time": jnp.asarray(TIME), "temperature": jnp.full(STEPS, temperature)}


@pytest.fixture(scope="module")
def gyros() -> list[Estimate]:
    rng = np.random.default_rng(1)
    return [fitted(rng, bias) for bias in (0.0, 0.0, 5.0)]


def test_a_bias_about_east_tilts_and_runs_north(gyros: list[Estimate]):
    """The platform drifts by minus what its gyro shows at rest, b: Schuler oscillation of the tilt, b sin(ω t)/ω."""
    made = navigation_error(gyros, [mission(20.0)] * 3, START, at_rest(), STEP, EVERY).errors.value
    rate = float(gyros[2].model.predict(mission(20.0))[0])
    time, g = TIME[EVERY - 1 :: EVERY] + STEP, float(gravity(START.position[0], START.position[2]))
    # The rate of the Earth turns a part of the tilt into azimuth: 3 % in this time.
    w = np.sqrt(g / float(radii(START.position[0])[0]))
    assert np.asarray(made.attitude)[:, 2] == pytest.approx(rate * np.sin(w * time) / w, rel=0.03)
    speed = -g * rate / w**2 * (1 - np.cos(w * time))
    assert np.asarray(made.velocity)[:, 0] == pytest.approx(speed, rel=0.03)
    way = -g * rate / w**2 * (time - np.sin(w * time) / w)
    assert np.asarray(made.position)[5:, 0] == pytest.approx(way[5:], rel=0.03)


@pytest.mark.long
def test_the_covariance_is_that_of_draws(gyros: list[Estimate]):
    """400 draws of all parameters, each run through the whole navigation."""
    found = navigation_error(gyros, [mission(35.0)] * 3, START, at_rest(), STEP, EVERY)
    rng, draws = np.random.default_rng(2), 400
    vectors = [rng.multivariate_normal(np.asarray(g.model.vector()), g.covariance, draws) for g in gyros]
    signals, sensed = tuple([mission(35.0)] * 3), at_rest()

    def last(*v: jax.Array) -> jax.Array:
        models = tuple(g.model.with_vector(x) for g, x in zip(gyros, v, strict=True))
        made = _errors(models, signals, START, sensed, STEP, EVERY)
        return jnp.concatenate([e[-1] for e in made])

    spread = np.var(np.asarray(jax.lax.map(lambda v: last(*v), tuple(map(jnp.asarray, vectors)))), axis=0, ddof=1)
    std = found.errors.propagate(lambda e: jnp.concatenate([x[-1] for x in e])).std
    ratio = (draws - 1) * spread / std**2
    assert ((ratio > chi2.ppf(1e-5, draws - 1)) & (ratio < chi2.isf(1e-5, draws - 1))).all()


def test_shares_add_up_and_name_the_parameter(gyros: list[Estimate]):
    """At the mean temperature of the fit the bias is all; far from it the temperature's coefficient is most."""
    for temperature, most in ((float(gyros[2].model.effects[1].reference), "z bias value"),
                              (60.0, "z bias_temperature coefficient")):  # fmt: skip
        shares = navigation_error(gyros, [mission(temperature)] * 3, START, at_rest(), STEP, EVERY).shares
        north = {name: float(s.velocity[-1, 0]) for name, s in shares.items()}
        assert sum(north.values()) == pytest.approx(1.0)
        assert max(north, key=lambda name: north[name]) == most
        assert north[most] > 0.6
