"""Navigation against closed forms and against an independent one (`tests/truth/navigation.py`).

Closed forms: coning motion, a rate that stays, rest and the way round the equator on a turning Earth, free fall with
its eastward deflection, the Schuler and Foucault oscillation of the linear error equations, scale factor and bias.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from gyromodel.model import model_from_effects
from gyromodel.numerics.rotations import from_matrix, inverse, logarithm, product, to_matrix
from gyromodel.platform import (
    Navigation,
    attitude_sensitivity,
    attitudes,
    coning,
    earth_rate,
    gravity,
    integrals,
    navigate,
    radii,
    residual_drift,
    sculling,
    transport_rate,
)
from tests.truth import navigation as truth

LEVEL = jnp.array([1.0, 0.0, 0.0, 0.0])
OMEGA, EQUATOR, POLE = 7.292115e-5, 6378137.0, 6356752.3142
STEPS, EVERY = 4000, 10
"""Of most tests here: one shape, compiled once."""


def cone(time: np.ndarray, angle: float, frequency: float) -> tuple[np.ndarray, np.ndarray]:
    """Attitude and rate of an axis that goes round a cone: q = exp(A (0, cos wt, sin wt)), ω = 2 q* q̇."""
    w, s, c = 2 * np.pi * frequency, np.sin(2 * np.pi * frequency * time), np.cos(2 * np.pi * frequency * time)
    half = np.full_like(time, 0.5 * angle)
    q = np.stack([np.cos(half), 0 * time, np.sin(half) * c, np.sin(half) * s], 1)
    rate = np.stack([-w * (1 - np.cos(2 * half)), -w * np.sin(2 * half) * s, w * np.sin(2 * half) * c], 1)
    return q, rate


def left_over(found: jax.Array, expected: np.ndarray) -> np.ndarray:
    """Rotation vector between two attitudes."""
    return np.asarray(logarithm(product(found, inverse(jnp.asarray(expected)))))


def coning_drift(step: float, corrected: bool) -> float:
    q, rate = cone(np.arange(STEPS + 1) * step, np.deg2rad(1.0), 10.0)
    turns = integrals(jnp.asarray(rate), step)
    end = attitudes(jnp.asarray(q[0]), coning(turns) if corrected else turns, EVERY)[-1]
    return float(np.linalg.norm(left_over(end, q[-1]))) / (STEPS * step)


def test_coning():
    """Uncorrected drift by Savage's closed form, ½ w sin²A (1 − sin(wT)/(wT)); corrected, of fourth order in T."""
    fine = coning_drift(1e-3, True)
    assert fine < 1e-8
    w, angle = 2 * np.pi * 10.0, np.deg2rad(1.0)
    expected = 0.5 * w * np.sin(angle) ** 2 * (1 - np.sin(w * 1e-3) / (w * 1e-3))
    assert coning_drift(1e-3, False) == pytest.approx(expected, rel=2e-3)
    assert 3.8 < np.log2(coning_drift(2e-3, True) / fine) < 4.2


def test_a_rate_that_stays_is_exact():
    turn = np.array([0.02, -0.05, 0.03])
    found = attitudes(LEVEL, jnp.tile(jnp.asarray(turn), (STEPS, 1)), EVERY)
    number = np.arange(EVERY, STEPS + 1, EVERY)
    expected = Rotation.from_rotvec(number[:, None] * turn).as_matrix()
    assert np.abs(np.asarray(to_matrix(found)) - expected).max() < 1e-12


def test_a_million_steps_stay_orthonormal(rng: np.random.Generator):
    turns = 0.05 * rng.standard_normal((1_000_000, 3))
    matrix = np.asarray(to_matrix(attitudes(LEVEL, jnp.asarray(turns), 10_000)))
    assert np.abs(matrix @ matrix.transpose(0, 2, 1) - np.eye(3)).max() < 1e-12


def test_integrals_of_a_cubic_are_exact(rng: np.random.Generator):
    cubics = [np.polynomial.Polynomial(c) for c in rng.standard_normal((3, 4))]
    time = np.arange(9) * 0.5
    found = integrals(jnp.asarray(np.stack([p(time) for p in cubics], 1)), 0.5)
    assert np.allclose(found, np.stack([np.diff(p.integ()(time)) for p in cubics], 1), rtol=0, atol=1e-12)
    with pytest.raises(ValueError, match="a cubic needs 4 samples, and there are 3"):
        integrals(jnp.zeros((3, 3)), 0.5)


def test_sculling():
    """Rate and force that stay are exact; a swing a/w and a force b in phase push by ½ a b/w on average."""
    turn, push = np.array([0.3, -0.2, 0.1]), np.array([0.5, 1.0, -2.0])
    nodes, weights = np.polynomial.legendre.leggauss(20)
    mean = np.tensordot(weights / 2, Rotation.from_rotvec(np.outer((nodes + 1) / 2, turn)).as_matrix(), 1)
    found = sculling(*(jnp.tile(jnp.asarray(x), (STEPS, 1)) for x in (turn, push)))
    assert np.allclose(found, mean @ push, atol=1e-14)

    step, w, a, b = 1e-3, 2 * np.pi * 10.0, 1.0, 10.0
    phase = w * np.arange(STEPS + 1) * step
    angle = np.outer(np.diff(-np.cos(phase)) * a / w, [1.0, 0.0, 0.0])
    velocity = np.outer(np.diff(np.sin(phase)) * b / w, [0.0, 1.0, 0.0])
    turns = jnp.asarray(angle)
    start = Navigation(LEVEL, jnp.zeros(3), jnp.array([0.7, 0.0, 0.0]))
    still = navigate(start, turns, jnp.zeros((STEPS, 3)), step, EVERY).velocity
    moved = navigate(start, turns, sculling(turns, jnp.asarray(velocity)), step, EVERY).velocity - still
    # α(t) = a/w (1 − cos wt) turns the force b cos wt towards z: on average −½ a b/w.
    assert float(moved[-1, 2]) / (STEPS * step) == pytest.approx(-0.5 * a * b / w, rel=5e-4)


def test_the_earth():
    """Values at equator and pole of the defining report; in between by the closed form with both of them."""
    latitude = np.deg2rad([0.0, 30.0, 45.0, 90.0])
    height = np.array([0.0, 1000.0, 10000.0, 0.0])
    meridian, across = (np.asarray(r) for r in radii(jnp.asarray(latitude)))
    assert meridian[[0, -1]] == pytest.approx([POLE**2 / EQUATOR, EQUATOR**2 / POLE], rel=1e-10)
    assert across[[0, -1]] == pytest.approx([EQUATOR, EQUATOR**2 / POLE], rel=1e-10)
    expected = [truth.normal_gravity(*place) for place in zip(latitude, height, strict=True)]
    assert np.asarray(gravity(jnp.asarray(latitude), jnp.asarray(height))) == pytest.approx(expected, rel=1e-10)
    # Axes at two moments, differentiated.
    place, velocity, small = np.array([0.7, 0.3, 5000.0]), np.array([200.0, 5.0, -150.0]), 1e-3
    m, n = (float(r) for r in radii(jnp.asarray(0.7)))
    rates = velocity[0] / (m + 5000), velocity[2] / ((n + 5000) * np.cos(0.7))
    before, after = (truth.axes(0.7 + k * rates[0], 0.3 + k * rates[1]) for k in (-small, small))
    turned = Rotation.from_matrix(before.T @ after).as_rotvec() / (2 * small)
    found = transport_rate(jnp.asarray(place[0]), jnp.asarray(place[2]), jnp.asarray(velocity))
    assert np.asarray(found) == pytest.approx(turned, rel=1e-9)
    assert np.asarray(earth_rate(jnp.asarray(0.7))) == pytest.approx(truth.axes(0.7, 0.3)[2] * OMEGA, rel=1e-14)


def at_rest(rate: np.ndarray, force: np.ndarray, step: float) -> np.ndarray:
    """Integrals over steps of a force that stands still in axes turning at −rate, as seen from the platform."""
    time = np.arange(STEPS) * step
    nodes, weights = np.polynomial.legendre.leggauss(6)
    turned = [Rotation.from_rotvec(np.outer(time + (x + 1) / 2 * step, rate)).apply(force) for x in nodes]
    return step * np.tensordot(weights / 2, np.stack(turned), 1)


def test_rest_and_round_the_equator():
    """The axes turn at a rate that stays; in them so does the force that holds a vehicle in them."""
    step, latitude = 0.1, np.deg2rad(40.0)
    earth = OMEGA * np.array([np.cos(latitude), np.sin(latitude), 0.0])
    force = np.array([0.0, truth.normal_gravity(latitude, 300.0), 0.0])
    start = Navigation(LEVEL, jnp.zeros(3), jnp.array([latitude, 0.4, 300.0]))
    found = navigate(start, jnp.zeros((STEPS, 3)), jnp.asarray(at_rest(earth, force, step)), step, EVERY)
    epochs = np.arange(EVERY, STEPS + 1, EVERY) * step
    expected = Rotation.from_rotvec(-np.outer(epochs, earth)).as_matrix()
    assert np.abs(np.asarray(to_matrix(found.attitude)) - expected).max() < 1e-10
    # An epoch T leaves Ω²T² g/12 of the specific force: 4e-9 m/s².
    assert np.abs(np.asarray(found.velocity)).max() < 3e-6
    assert np.abs(np.asarray(found.position) - np.asarray(start.position)).max() < 1e-3

    speed = 250.0
    over = speed / (EQUATOR + 300.0)
    force = np.array([0.0, truth.normal_gravity(0.0, 300.0) - (2 * OMEGA + over) * speed, 0.0])
    start = Navigation(LEVEL, jnp.array([0.0, 0.0, speed]), jnp.array([0.0, 0.4, 300.0]))
    pushes = at_rest(np.array([OMEGA + over, 0.0, 0.0]), force, step)
    found = navigate(start, jnp.zeros((STEPS, 3)), jnp.asarray(pushes), step, EVERY)
    assert np.asarray(found.position[:, 1]) == pytest.approx(0.4 + over * epochs, abs=1e-10)
    assert np.abs(np.asarray(found.position[:, ::2]) - [0.0, 300.0]).max() < 1e-3


def round_a_circle(latitude: float, heading: float, step: float) -> tuple[Navigation, np.ndarray]:
    """What is at the beginning and after each step, and pushes in inertial axes, 3 km up, the normal going 6e-4 rad/s.

    The pushes are changes of the inertial velocity less gravitation, by Gauss and Legendre's rule of two points.
    """
    turn, height, time = 6e-4, 3000.0, np.arange(STEPS + 1) * step
    _, up, east = truth.axes(latitude, 0.4).T
    towards = np.cos(heading) * truth.axes(latitude, 0.4)[:, 0] + np.sin(heading) * east

    def at(time: np.ndarray) -> tuple[np.ndarray, ...]:
        return *truth.along(time, up, towards, turn, height), np.stack([truth.spin(OMEGA * t) for t in time])

    def turned(matrices: np.ndarray, vectors: np.ndarray) -> np.ndarray:
        return np.einsum("kij,kj->ki", matrices, vectors)

    normal, r, v, spin = at(time)
    pushes = np.diff(turned(spin, v + np.cross([0.0, 0.0, OMEGA], r)), axis=0)
    for part in (0.5 - 12**-0.5, 0.5 + 12**-0.5):
        _, between, _, then = at(time[:-1] + part * step)
        pushes -= 0.5 * step * turned(then, np.stack([truth.gravitation(x) for x in between]))
    place = np.stack([np.arcsin(normal[:, 2]), np.arctan2(normal[:, 1], normal[:, 0]), 0 * time + height], 1)
    local = np.stack([truth.axes(*p[:2]) for p in place]).transpose(0, 2, 1)
    return Navigation(local @ spin.transpose(0, 2, 1), turned(local, v), place), pushes


@pytest.mark.parametrize(("latitude", "heading"), [(-20.0, 0.0), (30.0, 1.0)], ids=["meridian", "oblique"])
def test_along_a_great_circle(latitude: float, heading: float):
    """Over 70° in 2000 s against its closed form, and errors of second order in the epoch, height free or kept."""
    step = 0.5
    true, pushes = round_a_circle(np.deg2rad(latitude), heading, step)
    start = Navigation(*(jnp.asarray(x[0]) for x in true))._replace(attitude=from_matrix(jnp.asarray(true.attitude[0])))

    def wrong(every: int, level: bool) -> np.ndarray:
        found = navigate(start, jnp.zeros((STEPS, 3)), jnp.asarray(pushes), step, every, level)
        ends = (x[every::every] for x in true)
        matrix, velocity, metres = (np.asarray(x) - y for x, y in zip(_as_matrix(found), ends, strict=True))
        return np.array([np.abs(x).max() for x in (matrix, velocity, metres * [6.4e6, 6.4e6, 1.0])])

    for level, limits in ((False, [4e-8, 1e-3, 0.5]), (True, [2e-8, 2e-4, 0.2])):
        fine = wrong(1, level)
        assert (fine < limits).all(), fine
        assert wrong(2, level) / fine == pytest.approx(4.0, rel=0.02)


def _as_matrix(found: Navigation) -> Navigation:
    return found._replace(attitude=to_matrix(found.attitude))


def test_free_fall():
    """h = −½ g t² (1 + g t²/(6R)), as gravity grows by 2/R, eastward ⅓ Ω g t³ cos L (W. Thomson and Tait), at 10 s."""
    start = Navigation(LEVEL, jnp.zeros(3), jnp.array([0.7, 0.0, 1000.0]))
    none = jnp.zeros((STEPS, 3))
    found = navigate(start, none, none, 10.0 / STEPS, EVERY)
    g = truth.normal_gravity(0.7, 1000.0)
    assert float(found.position[-1, 2]) - 1000.0 == pytest.approx(-0.5 * g * 100 * (1 + g * 100 / 6 / 6.37e6), rel=1e-6)
    across = float(radii(jnp.asarray(0.7))[1])
    east = float(found.position[-1, 1]) * (across + 800.0) * np.cos(0.7)
    assert east == pytest.approx(OMEGA * g * 1000 * np.cos(0.7) / 3, rel=1e-3)


def schuler(latitude: float, push: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Times, and velocities (north, up, east) after a push while navigation is told of rest."""
    earth = OMEGA * np.array([np.cos(latitude), np.sin(latitude), 0.0])
    force = np.array([0.0, truth.normal_gravity(latitude, 0.0), 0.0])
    pushes = jnp.asarray(at_rest(earth, force, step))
    found, still = (
        navigate(
            Navigation(LEVEL, jnp.asarray(v), jnp.array([latitude, 0.0, 0.0])),
            jnp.zeros((STEPS, 3)),
            pushes,
            step,
            EVERY,
        ).velocity
        for v in (push, 0 * push)
    )
    return np.arange(EVERY, STEPS + 1, EVERY) * step, np.asarray(found - still)


def test_schuler_period():
    """2π √(R/g) along the meridian at the equator; what is published as 84.4 min is that of a mean radius."""
    time, velocity = schuler(0.0, np.array([1e-3, 0.0, 0.0]), 1.0)
    north = velocity[:, 0]
    where = np.flatnonzero(np.diff(np.sign(north)))
    zeros = time[where] - north[where] * (time[where + 1] - time[where]) / np.diff(north)[where]
    period = 2 * float(np.diff(zeros)[0])
    # Gravity grows with latitude and takes 2 (γ_p − γ_e)/γ_e of the restoring force with it.
    assert period == pytest.approx(2 * np.pi * np.sqrt(POLE**2 / EQUATOR / 9.7803253359), rel=1e-3)
    assert period / 60 == pytest.approx(84.4, rel=3e-3)


def test_foucault_modulation():
    """The linear equations of three axes, by the matrix exponential; in it, the plane turns at Ω sin L."""
    latitude, push = np.deg2rad(80.0), np.array([1e-3, 0.0, 0.0])
    time, velocity = schuler(latitude, push, 0.65)
    flat = 1 - (1 - (POLE / EQUATOR) ** 2) * np.sin(latitude) ** 2
    m, n = EQUATOR * (POLE / EQUATOR) ** 2 / flat**1.5, EQUATOR / np.sqrt(flat)
    g = truth.normal_gravity(latitude, 0.0)
    north, up = OMEGA * np.cos(latitude), OMEGA * np.sin(latitude)
    coriolis = -2 * np.array([[0.0, 0.0, up], [0.0, 0.0, -north], [-up, north, 0.0]])
    restoring = np.diag([-g / m, 2 * g / np.sqrt(m * n), -g / n])
    linear = np.block([[coriolis, restoring], [np.eye(3), np.zeros((3, 3))]])
    expected = np.stack([(expm(linear * t) @ [*push, 0, 0, 0])[:3] for t in time[::50]])
    assert np.abs(velocity[::50] - expected)[:, ::2].max() < 3e-3 * 1e-3
    back = np.argmin(velocity[:, 0])  # half a period later
    assert np.arctan(velocity[back, 2] / velocity[back, 0]) == pytest.approx(up * time[back], rel=0.1)


RATE = np.array([[0.3, 0.2, -0.4], [5.0, 7.0, 4.0], [0.3, 1.1, 2.0]])
FORCE = np.array([[3.0, 2.0, 4.0], [3.0, 6.0, 5.0], [0.0, 1.0, -1.0]])


def motion(time: float | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rate (rad/s) and specific force (m/s²) in the axes of the body: one tone an axis, and what carries it."""
    tones = [a * np.sin(np.multiply.outer(time, w) + p) for a, w, p in (RATE, FORCE)]
    return tones[0], tones[1] + [1.0, 9.8, 0.5]


def integrated(end: float, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Integrals of the motion over steps, in closed form."""
    time = np.linspace(0.0, end, steps + 1)
    angle, velocity = (np.diff(-a / w * np.cos(np.multiply.outer(time, w) + p), axis=0) for a, w, p in (RATE, FORCE))
    return angle, velocity + np.multiply.outer(np.diff(time), [1.0, 9.8, 0.5])


TILTED = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix()
START = Navigation(from_matrix(jnp.asarray(TILTED)), jnp.array([150.0, 5.0, -200.0]), jnp.array([0.8, 0.3, 2000.0]))
END = 20.0


@pytest.fixture(scope="module")
def independent() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    start = TILTED, np.asarray(START.velocity), np.asarray(START.position)
    return truth.navigate(*start, lambda t: motion(t)[0], lambda t: motion(t)[1], END)


def ends(steps: int, every: int) -> Navigation:
    angle, velocity = (jnp.asarray(x) for x in integrated(END, steps))
    history = navigate(START, coning(angle), sculling(angle, velocity), END / steps, every)
    return jax.tree.map(lambda x: x[-1], history)


def differences(found: Navigation, expected: tuple[np.ndarray, np.ndarray, np.ndarray]) -> np.ndarray:
    """Attitude (rad), velocity (m/s) and position (m), largest of each."""
    matrix, velocity, position = expected
    metres = (np.asarray(found.position) - position) * [6.4e6, 6.4e6, 1.0]
    attitude = np.asarray(to_matrix(found.attitude)) - matrix
    return np.array([np.abs(x).max() for x in (attitude, np.asarray(found.velocity) - velocity, metres)])


def test_the_same_as_an_independent_navigation(independent: tuple[np.ndarray, np.ndarray, np.ndarray]):
    """Attitude converges with the fourth power of the step; velocity and position with the square of the epoch."""
    fine = differences(ends(STEPS, EVERY), independent)
    assert (fine < [1e-8, 1e-5, 1e-3]).all(), fine
    rough, rougher = (differences(ends(STEPS, n), independent) for n in (40, 80))
    order = np.log2(rougher / rough)[1:]
    assert ((order > 1.8) & (order < 2.5)).all(), (rougher, rough)


def test_the_same_increments_by_an_independent_strapdown(rng: np.random.Generator):
    """Increments of no smooth motion: with an epoch of one step all is the same, with longer ones to second order."""
    step = END / STEPS
    turns = 1e-2 * rng.standard_normal((STEPS, 3))
    pushes = step * (10 * rng.standard_normal((STEPS, 3)) + [1.0, 9.8, 0.5])
    start = TILTED, np.asarray(START.velocity), np.asarray(START.position)
    expected = truth.strapdown(*start, turns, pushes, step)

    def wrong(every: int) -> np.ndarray:
        history = navigate(START, jnp.asarray(turns), jnp.asarray(pushes), step, every)
        return differences(jax.tree.map(lambda x: x[-1], history), expected)

    fine = wrong(1)
    assert (fine < [1e-12, 3e-8, 3e-6]).all(), fine
    longer = wrong(EVERY)
    assert (longer < [1e-6, 1e-4, 3.0]).all(), longer


def test_runs_side_by_side(rng: np.random.Generator):
    turns, pushes = 1e-3 * rng.standard_normal((2, 3, STEPS, 3))
    together = jax.vmap(navigate, (None, 0, 0, None, None))(START, turns, pushes, 0.01, EVERY)
    alone = navigate(START, jnp.asarray(turns[1]), jnp.asarray(pushes[1]), 0.01, EVERY)
    for a, b in zip(together, alone, strict=True):
        assert np.allclose(a[1], b, rtol=1e-12, atol=1e-12)
    with pytest.raises(ValueError, match="4000 steps are not a whole number of epochs of 7 steps"):
        navigate(START, jnp.asarray(turns[0]), jnp.asarray(pushes[0]), 0.01, 7)


def corrected(parameters: dict[str, jax.Array], rows: tuple[jax.Array, jax.Array]) -> jax.Array:
    """Rotation vectors by a gyro's matrix and bias, from increments and those before."""
    now, before = (x @ parameters["matrix"].T - parameters["bias"] for x in rows)
    return now + jnp.cross(before, now) / 12


def test_sensitivity_is_the_derivative():
    """By jvp along a direction in all parameters."""
    angle = jnp.asarray(integrated(END, STEPS)[0])
    rows = angle, jnp.concatenate([angle[:1], angle[:-1]])
    parameters = {"bias": jnp.array([1e-5, -2e-5, 3e-5]), "matrix": jnp.eye(3) + 0.01 * jnp.arange(9.0).reshape(3, 3)}
    history, found = attitude_sensitivity(corrected, parameters, rows, START.attitude, EVERY * 4)
    direction = {"bias": jnp.array([1.0, 2.0, -1.0]), "matrix": 1e-2 * jnp.sin(jnp.arange(9.0)).reshape(3, 3)}

    def history_of(p):
        return attitudes(START.attitude, corrected(p, rows), EVERY * 4)

    plain, moved = jax.jit(lambda p, d: jax.jvp(history_of, (p,), (d,)))(parameters, direction)
    assert np.allclose(history, plain, atol=1e-14)
    expected = 2 * np.asarray(product(moved, inverse(plain)))[:, 1:]
    along = np.tensordot(found["bias"], direction["bias"], 1) + np.tensordot(found["matrix"], direction["matrix"], 2)
    assert np.abs(along - expected).max() < 1e-12 * np.abs(expected).max()


def last(start: Navigation, turns: jax.Array, pushes: jax.Array, step: jax.Array) -> jax.Array:
    """All at the end, in units that errors of gyros move alike: arcsec or so, m/s and m."""
    end = jax.tree.map(lambda x: x[-1], navigate(start, turns, pushes, step, 40))
    return jnp.concatenate([1e5 * end.attitude, end.velocity, end.position * jnp.array([6.4e6, 6.4e6, 1.0])])


@pytest.mark.long
def test_forward_mode(rng: np.random.Generator):
    """Along a direction in all that goes in, as by differences and as reverse mode has it."""
    turns, pushes = (jnp.asarray(x) for x in integrated(END, STEPS))
    at = START, turns, pushes, jnp.asarray(END / STEPS)
    units = Navigation(*map(jnp.asarray, (1e-5, 1e-2, [1e-9, 1e-9, 1e-2]))), 1e-8, 1e-6, 1e-8
    units = jax.tree.map(lambda x, u: jnp.broadcast_to(u, x.shape), at, (units[0], *map(jnp.asarray, units[1:])))
    along = jax.tree.map(lambda u: u * rng.standard_normal(u.shape), units)
    forward = jax.jit(lambda x, d: jax.jvp(last, x, d)[1])(at, along)

    shifted = [last(*jax.tree.map(lambda x, d, s=s: x + s * d, at, along)) for s in (10.0, -10.0)]
    by_differences = np.asarray(shifted[0] - shifted[1]) / 20
    assert np.asarray(forward) == pytest.approx(by_differences, abs=1e-6 * np.abs(by_differences).max())

    weights = jnp.asarray(rng.standard_normal(10))
    back = jax.jit(lambda x, w: jax.vjp(last, *x)[1](w))(at, weights)
    backwards = sum(jax.tree.leaves(jax.tree.map(lambda g, d: jnp.sum(g * d), back, along)))
    size = float(jnp.abs(weights) @ jnp.abs(forward))
    assert float(weights @ forward) == pytest.approx(float(backwards), abs=1e-9 * size)


@pytest.mark.parametrize("what", ["attitudes", "navigate"])
def test_reverse_mode_keeps_no_states_of_steps(what: str):
    """What it takes beside its input grows with the epochs: ten times the steps, less than a number for each."""

    def size(steps: int) -> int:
        def end(start: Navigation, turns: jax.Array) -> jax.Array:
            if what == "attitudes":
                return jnp.sum(attitudes(start.attitude, turns, 100)[-1])
            return jnp.sum(navigate(start, turns, turns, 1e-3, 100).position[-1])

        compiled = jax.jit(jax.grad(end)).lower(START, jnp.zeros((steps, 3))).compile()
        return compiled.memory_analysis().temp_size_in_bytes

    assert size(40_000) - size(4_000) < 36_000 * 8


def miss(bias: jax.Array, turns: jax.Array, pushes: jax.Array) -> jax.Array:
    """A number that depends on everything at the end."""
    last = jax.tree.map(lambda x: x[-1], navigate(START, turns - 1e-3 * bias, pushes, 1e-3, 40))
    return jnp.sum(last.velocity) + 1e6 * jnp.sum(last.position[:2]) + jnp.sum(last.attitude)


@pytest.mark.long
def test_gradient_of_navigation_and_its_memory():
    """Reverse mode equals finite differences; it keeps less than the states of all steps."""
    turns, pushes = (1e-3 * jnp.asarray(x) for x in motion(np.arange(STEPS) * 1e-3))
    bias = jnp.array([0.1, -0.2, 0.3])
    compiled = jax.jit(jax.grad(miss)).lower(bias, turns, pushes).compile()
    back = np.asarray(compiled(bias, turns, pushes))
    shifted = [float(miss((1 + s) * bias, turns, pushes)) for s in (1e-4, -1e-4)]
    assert back @ np.asarray(bias) == pytest.approx((shifted[0] - shifted[1]) / 2e-4, rel=1e-6)
    states = STEPS * 10 * 8
    inputs = turns.nbytes + pushes.nbytes
    assert compiled.memory_analysis().temp_size_in_bytes < states + inputs


def test_data_are_no_part_of_what_is_compiled():
    turns = jnp.zeros((STEPS, 3))
    navigate(START, turns, turns, 0.01, EVERY)
    before = navigate._cache_size()
    for step in (0.02, 0.03):
        navigate(START._replace(velocity=jnp.array([1.0, 0.0, step])), turns + step, turns, step, EVERY)
    assert navigate._cache_size() == before


def test_gyro_errors_turn_the_platform():
    """A bias b turns it at −b whatever the scale factor; one that follows temperature at minus its line."""
    warm = model_from_effects(["scale_factor", "bias", "bias_temperature"])
    temperature = jnp.linspace(20.0, 40.0, STEPS)
    signals = {"time": jnp.arange(STEPS) * 1.0, "temperature": temperature, "rate": jnp.full(STEPS, 0.1)}
    signals["output"] = signals["rate"]
    warm = warm.prepared(signals)
    models = [warm.with_vector(jnp.array([v, b, k])) for v, b, k in ((1, 1e-6, 0), (3, -2e-6, 1e-8), (2, 0.0, 0))]
    drift = np.asarray(residual_drift(models, [signals] * 3))
    assert drift[:, 0] == pytest.approx(-1e-6, rel=1e-12)
    assert np.diff(drift[:, 1]) == pytest.approx(-1e-8 * np.diff(np.asarray(temperature)), rel=1e-6)
    assert np.abs(drift[:, 2]).max() == 0
    end = attitudes(LEVEL, jnp.asarray(drift) * 1.0, EVERY)[-1]
    assert np.asarray(logarithm(end))[0] == pytest.approx(-1e-6 * STEPS, rel=1e-4)
