"""Specific force, field, geometry and time: simulators against closed forms, and what the diagnosis makes of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.signal import cont2discrete, lfilter
from scipy.spatial.transform import Rotation

import gyromodel
from gyromodel.campaign import Campaign
from gyromodel.diagnosis import isolability
from gyromodel.diagnosis._added_tests import added_tests
from gyromodel.diagnosis._bank import build_bank
from gyromodel.effects.acceleration import BiasAccelerationSquared
from gyromodel.effects.dynamics import Bandwidth, TimeDelay, earlier, lag, second_order_lag, slope
from gyromodel.model import GyroModel, ModelError, model_from_effects
from gyromodel.plan import read_plan
from gyromodel.signals import read_signals
from tests.truth import study
from tests.truth.effects import error
from tests.truth.motion_designs import EARTH, MOTION_DESIGNS, Sines, cube_attitudes, earth_and_gravity

DEG_H = np.pi / 180 / 3600


@pytest.mark.parametrize("name", MOTION_DESIGNS)
def test_designs_are_campaigns_that_could_have_been(name: str, rng: np.random.Generator):
    design = MOTION_DESIGNS[name](rng)
    assert 850 <= len(design.index) <= 1050
    assert set(design.columns) == set(design.units)
    assert np.array_equal(design.true["time"], design.index * design.step)
    assert np.std(design.columns["temperature"] - design.true["temperature"]) == pytest.approx(2e-3, rel=0.15)
    campaign = Campaign(
        design.columns | {"output": design.columns["time"]}, design.units | {"output": "deg/s"}, design.metadata
    )
    assert campaign.metadata["kind"] == "rate"


def test_attitudes_turn_gravity_and_the_earth_alike(rng: np.random.Generator):
    cube = np.array(cube_attitudes())
    assert len(np.unique(cube.round(9), axis=0)) == 24
    earth, force = earth_and_gravity(cube, 0.7)
    assert np.linalg.norm(force, axis=1) == pytest.approx(1.0)
    assert np.linalg.norm(earth, axis=1) == pytest.approx(EARTH)
    # The angle between them is that of the latitude, in every attitude.
    assert np.sum(earth * force, axis=1) == pytest.approx(EARTH * np.sin(0.7))
    for name in ("tumble", "one_axis_tumble"):
        design = MOTION_DESIGNS[name](rng)
        assert len(np.unique(design.columns["position"])) == 36
        rates = [design.true[name] for name in ("rate", "rate_output", "rate_spin")]
        assert np.linalg.norm(rates, axis=0) == pytest.approx(EARTH, rel=1e-6)
        if name == "one_axis_tumble":
            assert np.ptp(design.true["rate_output"]) == pytest.approx(0.0, abs=1e-12 * EARTH)


def test_simulators_follow_their_closed_forms(rng: np.random.Generator):
    a, b, c = (MOTION_DESIGNS[n](rng) for n in ("tumble", "turntable", "dynamic_rates"))
    # Of a unit vector's three components: up, down or level along the axes of the cube, each as often as the others.
    force = {axis: error(f"bias_acceleration_{axis}", a, 3.0, {}) / 3.0 for axis in ("input", "output", "spin")}
    assert sum(f**2 for f in force.values()) == pytest.approx(1.0)
    along = cube_attitudes()
    upright = replace(a, true=a.true | {"turns": np.array(along)})
    for axis in force:
        values, counts = np.unique(error(f"bias_acceleration_{axis}", upright, 3.0, {}).round(9), return_counts=True)
        assert (list(values), list(counts)) == ([-3.0, 0.0, 3.0], [4, 16, 4])
    sideways = np.array([[0.0, 0.5, 0.0], [0.5, 0.0, 0.0], [0.0, 0.0, 0.0]])
    squared = error("bias_acceleration_squared", a, 3.0, {"compliance": sideways})
    assert squared == pytest.approx(3.0 * force["input"] * force["output"], abs=1e-12)
    lean = error("misalignment", a, 1e-5, {"towards": (0.6, 0.8)})
    cross = 0.6 * a.true["rate_output"] + 0.8 * a.true["rate_spin"]
    assert lean == pytest.approx(1e-5 * cross, abs=1e-9 * EARTH)

    heading, latitude = b.true["azimuth"], 0.8
    tilt = error("table_tilt", b, 1e-4, {"at": 0.0, "latitude": latitude})
    horizontal = EARTH * np.cos(latitude)
    columns = np.column_stack([np.cos(heading), np.sin(heading), np.ones_like(heading)])
    found, *_ = np.linalg.lstsq(columns, tilt, rcond=None)
    assert columns @ found == pytest.approx(tilt, abs=1e-9 * horizontal)
    assert np.hypot(*found[:2]) == pytest.approx(1e-4 * horizontal, rel=1e-6)
    lobes = error("table_harmonic", b, 2.0, {"order": 3, "at": 0.5})
    assert lobes == pytest.approx(2.0 * np.cos(3 * b.true["table_angle"] - 0.5), abs=1e-9)

    rate, spin = c.true["rate"], c.true["rate_spin"]
    assert error("bias_anisoinertia", c, 1e-3, {}) == pytest.approx(1e-3 * rate * spin, rel=1e-9)
    # The mean of 160 samples of 64 squares each: 0.09 is more than six standard deviations.
    for level in np.unique(c.true["level"]):
        assert c.true["vibration"][c.true["level"] == level].mean() == pytest.approx(level**2, rel=0.09)


def test_simulated_delay_and_lag_have_their_frequency_response(rng: np.random.Generator):
    """One sine: a delay turns its phase by −ωδ, a lag multiplies by 1/(1 + iωτ), or 1/(1 + iωτ − ω²/w²), w = 2ζ/τ."""
    design = MOTION_DESIGNS["dynamic_rates"](rng)
    omega, phase = 2 * np.pi * 3.0, 0.4
    sine = Sines(np.ones(1), np.array([omega]), np.array([phase]))
    design = replace(design, motion={"rate": sine, "output": sine})
    t = design.true["time"]
    assert error("time_delay", design, 0.013, {}) == pytest.approx(np.sin(omega * (t - 0.013) + phase) - sine(t))
    for tau in (0.02, 1e-3, 1e-5):
        response = 1 / (1 + 1j * omega * tau)
        expected = np.imag(response * np.exp(1j * (omega * t + phase))) - sine(t)
        assert error("bandwidth", design, tau, {}) == pytest.approx(expected, abs=2e-4 * np.abs(expected).max())
    for natural, damping in ((12.0, 0.7), (5.0, 0.4), (12.0, 1.0), (8.0, 1.5)):
        w = 2 * np.pi * natural
        response = 1 / (1 + 2j * damping * omega / w - (omega / w) ** 2)
        expected = np.imag(response * np.exp(1j * (omega * t + phase))) - sine(t)
        found = error("bandwidth", design, 2 * damping / w, {"damping": damping})
        assert found == pytest.approx(expected, abs=1e-5 * np.abs(expected).max())
    assert error("output_axis_acceleration", design, 2.0, {}) == pytest.approx(2 * omega * np.cos(omega * t + phase))


@pytest.mark.long
def test_delay_lag_and_slope_keep_to_their_stretch():
    """Two runs end to end, a gap in the first, and padding: against numbers of each stretch alone."""
    stretches = [np.arange(20.0), 300 + np.arange(15.0), np.arange(12.0)]
    time = jnp.asarray(np.concatenate([*stretches, np.full(5, 11.0)]))
    values = jnp.asarray(np.concatenate([np.sin(0.3 * s) for s in stretches] + [np.full(5, np.sin(3.3))]))
    start = 0
    for s in stretches:
        alone = jnp.asarray(s), jnp.asarray(np.sin(0.3 * s))
        here = slice(start, start + len(s))
        for of in (
            lambda t, v: earlier(t, v, jnp.asarray(1.7)),
            lambda t, v: lag(t, v, jnp.asarray(0.8)),
            lambda t, v: second_order_lag(t, v, jnp.asarray(5.0), jnp.asarray(0.8)),
            slope,
        ):
            assert np.asarray(of(time, values))[here] == pytest.approx(np.asarray(of(*alone)), abs=1e-12)
        assert np.asarray(slope(*alone))[2:-2] == pytest.approx(0.3 * np.cos(0.3 * s[2:-2]), abs=1e-3)
        assert np.asarray(earlier(*alone, jnp.asarray(1.7)))[2:] == pytest.approx(np.sin(0.3 * (s[2:] - 1.7)), abs=2e-3)
        start += len(s)


def campaign_of(design, output: np.ndarray, *without: str) -> Campaign:
    columns = {k: v for k, v in design.columns.items() if k not in without}
    units = {k: design.units[k] for k in columns}
    return Campaign(columns | {"output": np.rad2deg(output)}, units | {"output": "deg/s"}, design.metadata)


@pytest.mark.long
def test_the_bank_says_what_a_campaign_cannot_show(rng: np.random.Generator):
    design = MOTION_DESIGNS["tumble"](rng)
    noise = rng.standard_normal(len(design.index))
    bank = build_bank(read_signals(campaign_of(design, noise)))
    names = bank.names()
    assert {"bias_acceleration_input", "bias_acceleration_squared", "misalignment"} <= set(names)
    # The specific effect has the column: no second name for the same line.
    assert not any(n in names for n in ("bias_column_acceleration_input", "bias_rate_spin", "bias_column_rate_spin"))
    assert "centrifuge" in bank.not_testable["part of bias_acceleration_squared"]
    assert bank.not_testable["bias_magnetic"].startswith("needs a column magnetic_field")
    assert "in steps" in bank.not_testable["time_delay"]
    # The Earth's rate alone, against gravity; a table may turn as slowly.
    curves = {"scale_nonlinearity", "scale_sagnac_sine", "scale_spline", "saturation", "rate_hysteresis"}
    for name in curves:
        assert "no gyro bends" in bank.not_testable[name]
    slow = 20.0 * np.sin(0.1 * np.arange(100.0))
    columns = {"time": np.arange(100.0), "rate": slow, "output": slow + rng.standard_normal(100)}
    table = Campaign(columns, dict.fromkeys(("rate", "output"), "deg/h") | {"time": "s"}, {"kind": "rate"})
    assert curves <= set(build_bank(read_signals(table)).names())
    shaken = table.with_column("acceleration_input", 1e-3 * rng.standard_normal(100), "m/s^2")
    assert curves <= set(build_bank(read_signals(shaken)).names())
    counted = campaign_of(design, noise)
    counted = counted.with_column("acceleration_input", 1e4 * counted.columns["acceleration_input"], "count")
    bank = build_bank(read_signals(counted))
    assert bank.not_testable["bias_acceleration_input"] == "needs a column acceleration_input in a unit like m/s^2"
    assert "bias_column_acceleration_input" in bank.names()
    with pytest.raises(ModelError, match=r"bias_acceleration_input needs acceleration_input in a unit like m/s\^2"):
        gyromodel.fit(counted, model_from_effects(["bias", "bias_acceleration_input"]))


def test_columns_by_x_y_z_keep_their_drivers(rng: np.random.Generator):
    design = MOTION_DESIGNS["tumble"](rng)
    axes = {"input": "x", "output": "y", "spin": "z"}
    turned = {
        f"{k.rpartition('_')[0]}_{axes[k.rpartition('_')[2]]}": k
        for k in design.columns
        if k.rpartition("_")[2] in axes
    }
    plain = campaign_of(design, rng.standard_normal(len(design.index)))
    columns = {next((n for n, old in turned.items() if old == k), k): v for k, v in plain.columns.items()}
    units = {next((n for n, old in turned.items() if old == k), k): u for k, u in plain.units.items()}
    bank = build_bank(read_signals(Campaign(columns, units, plain.metadata)))
    assert {"bias_acceleration_x", "bias_acceleration_z", "bias_acceleration_squared", "misalignment"} <= set(
        bank.names()
    )
    squared = next(b.effect for b in bank.blocks if b.name == "bias_acceleration_squared" and b.width == 5)
    assert isinstance(squared, BiasAccelerationSquared)
    # Six products less one square.
    assert "acceleration_z*acceleration_z" not in squared.products


@pytest.mark.long
def test_a_ripple_of_the_poles_of_a_tables_motor_is_its_harmonic(rng: np.random.Generator):
    """Eight poles, at speeds that change, so that it is no line: an angle as the drive turns it."""
    speed = np.repeat(rng.uniform(5.0, 25.0, 30), 20)
    angle = np.cumsum(speed) * 0.5
    output = speed + 0.02 * np.cos(8 * np.deg2rad(angle) - 0.9) + 0.02 * rng.standard_normal(600)
    columns = {"time": 0.5 * np.arange(600), "rate": speed, "table_angle": angle % 360.0, "output": output}
    units = {"time": "s", "rate": "deg/s", "table_angle": "deg", "output": "deg/s"}
    measured = Campaign(columns, units, {"kind": "rate"})
    found = gyromodel.diagnose(measured, gyromodel.model_from_effects(["scale_factor", "bias"]), hold_out=False)
    assert (found.verdict, [c.effect for c in found.causes]) == ("named", ["table_harmonic"])
    assert "It returns 8 times a turn of the table." in found.findings
    size = np.hypot(*(p.value for p in found.causes[0].parameters[:2])) / 3600.0
    assert size == pytest.approx(0.02, abs=5 * 0.02 * np.sqrt(2 / 600))


SUITABLE = (("tumble", "bias_acceleration_squared"), ("turntable", "table_tilt"), ("dynamic_rates", "misalignment"))


def told(design: str, effect: str, seed: int):
    built = study.build(study.Case(seed, design, "white", effect, 10.0))
    campaign = Campaign(built.columns, built.units, built.metadata)
    model = model_from_effects(built.truth.baseline)
    return gyromodel.diagnose(campaign, model, hold_out=False), campaign


# The verdicts below are examples, of fixed seeds; the study counts how often they are right.
@pytest.mark.parametrize(
    ("design", "effect"), [pytest.param(*case, marks=pytest.mark.long) for case in SUITABLE[::2]] + [SUITABLE[1]]
)
def test_hidden_effects_of_motion_are_named(design: str, effect: str):
    found, _ = told(design, effect, 1)
    assert (found.verdict, [c.effect for c in found.causes]) == ("named", [effect])


EXACT = {
    "one_axis_tumble": ({"misalignment", "bias_acceleration_input", "bias_acceleration_spin"}, "by 90° in azimuth"),
    "one_field": ({"table_tilt", "bias_magnetic", "table_harmonic"}, "Reverse the magnetic field"),
}


@pytest.mark.long
@pytest.mark.parametrize("design", EXACT)
def test_exact_confusions_are_told_of(design: str):
    members, test = EXACT[design]
    found, campaign = told(design, sorted(members)[1], 1)
    assert found.verdict == "ambiguous"
    assert set(found.credible_set) == members
    assert found.next_test is not None
    assert test in found.next_test
    if design == "one_axis_tumble":
        # The sentence is of a campaign in which gravity stays and north goes elsewhere.
        turned = next(
            t.campaign
            for t in added_tests(campaign)
            if t.sentence == "Turn every attitude by 90° in azimuth and repeat."
        )
        rates = np.array([turned.si(n) for n in ("rate", "rate_output", "rate_spin")])
        before = np.array([campaign.si(n) for n in ("rate", "rate_output", "rate_spin")])
        assert np.linalg.norm(rates, axis=0) == pytest.approx(EARTH, rel=1e-4)
        force = np.array([campaign.columns[f"acceleration_{a}"] for a in ("input", "output", "spin")])
        assert np.sum(rates * force, axis=0) == pytest.approx(np.sum(before * force, axis=0), abs=1e-4 * EARTH)


@pytest.fixture
def gyrocompass(rng: np.random.Generator) -> Campaign:
    """A gyro with a level axis at twelve azimuths, four means each, on a table that leans to the side by 0.02 rad."""
    latitude, azimuth = 0.7, np.repeat(2 * np.pi * np.arange(12) / 12, 4)
    earth = EARTH * np.array([0.0, np.cos(latitude), np.sin(latitude)])
    north, lean = np.array([0.0, 1.0, 0.0]), 0.02
    turned = Rotation.from_rotvec(-azimuth[:, None] * [0.0, 0.0, 1.0]).apply(north)
    level, leaning = (Rotation.from_rotvec([0.0, angle, 0.0]).apply(turned) @ earth for angle in (0.0, lean))
    output = leaning + np.deg2rad(1e-5) * rng.standard_normal(len(azimuth))
    columns = {"time": 300.0 * np.arange(48), "azimuth": np.rad2deg(azimuth)}
    columns |= {"rate": np.rad2deg(level), "output": np.rad2deg(output)}
    units = {"time": "s", "azimuth": "deg", "rate": "deg/s", "output": "deg/s"}
    return Campaign(columns, units, {"kind": "rate", "rate_frame": "inertial"})


def test_a_tilt_that_the_rate_hides_in_part_is_searched_for_the_rest(gyrocompass: Campaign):
    bank = build_bank(read_signals(gyrocompass))
    assert "scale error" in bank.not_testable["part of table_tilt"]
    assert [f.leading() for f in bank.forms("table_tilt")] == ["north", "east", "north"]
    scaled = gyrocompass.with_column("rate", np.linspace(0, 1, 48), "deg/s")
    assert "part of table_tilt" not in build_bank(read_signals(scaled)).not_testable


@pytest.mark.long
def test_a_tilt_of_a_gyrocompass(gyrocompass: Campaign):
    found = gyromodel.diagnose(gyrocompass, model_from_effects(["scale_factor", "bias"]), hold_out=False)
    assert (found.verdict, set(found.credible_set)) == ("ambiguous", {"table_tilt", "bias_magnetic"})
    [part] = [p for c in found.causes for p in c.parameters]
    assert part.name in ("east", "sine")
    true = 0.02 * np.rad2deg(EARTH) * 3600 * np.sin(0.7)
    assert abs(abs(part.value) - true) < 4 * part.std


@pytest.mark.long
def test_what_follows_rate_and_acceleration_together_is_unknown(rng: np.random.Generator):
    """By neither of them alone: 10 deg/h rms in noise of 20."""
    design = MOTION_DESIGNS["dynamic_rates"](rng)
    assert design.motion is not None
    product = design.true["rate"] * design.motion["rate"].derivative(design.true["time"])
    error = 10 * DEG_H * product / np.std(product) + 20 * DEG_H * rng.standard_normal(len(product))
    campaign = campaign_of(design, design.true["rate"] + error)
    found = gyromodel.diagnose(campaign, model_from_effects(["scale_factor", "bias"]), hold_out=False)
    assert found.verdict == "unknown"
    assert found.driver is not None
    assert found.driver.column == "rate and d(rate)/dt"


@pytest.mark.long
def test_delay_and_lag_are_one_to_first_order_and_two_beyond():
    built = study.build(study.Case(1, "dynamic_rates", "white", "time_delay", 3.0))
    assert built.truth.amplitude > 0.2 * built.design.step
    campaign, model = Campaign(built.columns, built.units, built.metadata), model_from_effects(built.truth.baseline)
    small = gyromodel.diagnose(campaign, model, hold_out=False)
    assert (small.verdict, set(small.credible_set)) == ("ambiguous", {"time_delay", "bandwidth"})

    # Two samples late at up to 4 Hz, the phase bends.
    rng = np.random.default_rng(1)
    design = MOTION_DESIGNS["dynamic_rates"](rng)
    late = design.true["rate"] + error("time_delay", design, 0.02, {})
    noisy = campaign_of(design, late + np.deg2rad(0.2) * rng.standard_normal(len(late)))
    large = gyromodel.diagnose(noisy, model_from_effects(["scale_factor", "bias"]), hold_out=False)
    assert (large.verdict, [c.effect for c in large.causes]) == ("named", ["time_delay"])
    delay = next(p for p in large.causes[0].parameters if p.name == "delay")
    assert delay.unit == "ms"
    assert delay.value == pytest.approx(20.0, abs=6 * delay.std)


@pytest.mark.long
@pytest.mark.parametrize("effect", ["time_delay", "bandwidth"])
def test_what_is_late_by_many_samples_is_found_beside_a_gain_of_the_wrong_sign(effect: str):
    """Ten samples of delay, or twenty of lag: in coloured noise the fit without it has the output turn backwards."""
    late, noise = {"time_delay": (0.1, "flicker_and_walk"), "bandwidth": (0.2, "white")}[effect]
    built = study.build(study.Case(1, "dynamic_rates", noise, effect, 150.0))
    assert built.truth.amplitude == pytest.approx(late, rel=0.5)
    campaign = Campaign(built.columns, built.units, built.metadata)
    found = gyromodel.diagnose(campaign, model_from_effects(built.truth.baseline), hold_out=False)
    assert (found.verdict, [c.effect for c in found.causes]) == ("named", [effect])
    last = found.causes[0].parameters[-1]
    assert 1e-3 * last.value == pytest.approx(built.truth.amplitude, abs=6e-3 * last.std)


PLAN = """
gyro: rig
kind: rate
test: multi_position
rate_frame: inertial
duration: 60 min
interval: 10 s
output: deg/h
columns:
  rate: [{for: 20 min, at: 10 deg/h}, {for: 20 min, at: 0 deg/h}, {for: 20 min, at: -10 deg/h}]
  acceleration_input: [{repeat: 3, segments: [{for: 10 min, at: 1 g}, {for: 10 min, at: -1 g}]}]
  acceleration_spin: [{for: 30 min, at: 0 g}, {for: 10 min, at: 1 g}, {for: 20 min, at: -0.5 g}]
  position: [{repeat: 3, segments: [{for: 10 min, at: 1}, {for: 10 min, at: 2}]}]
"""


@pytest.mark.long
def test_a_plan_of_positions_tells_what_it_shows(tmp_path):
    (tmp_path / "plan.yaml").write_text(PLAN, encoding="utf-8")
    model = GyroModel(model_from_effects(["bias"]).effects, {"noise_white": jnp.asarray(1e-3 * DEG_H)})
    found = isolability(read_plan(tmp_path / "plan.yaml"), model)
    assert found.detectable["bias_acceleration_input"].unit == "deg/h/g"
    assert {"bias_acceleration_spin", "bias_acceleration_squared"} <= set(found.detectable)
    assert found.not_testable["bias_acceleration_output"] == "needs a column acceleration_output"
    assert not any("acceleration" in sentence for sentence, _ in found.tests)


def answered(response: Callable[[np.ndarray, float], np.ndarray], seed: int, rows: int = 800) -> Campaign:
    """A log of six tones that begins amid the motion; the response, at a tenth of the sample interval, has its past."""
    rng, fine, before = np.random.default_rng(seed), 10, 200
    step = 0.01 / fine
    time = np.arange((rows + before) * fine) * step
    tones = np.geomspace(0.2, 3.0, 6)
    rate = sum(rng.uniform(5, 25) * np.sin(2 * np.pi * f * time + rng.uniform(0, 6)) for f in tones)
    kept = slice(before * fine, None, fine)
    output = response(rate, step)[kept] + 0.4 + 0.03 * rng.standard_normal(rows)
    columns = {"time": 0.01 * np.arange(rows), "rate": rate[kept], "output": output}
    return Campaign(columns, {"time": "s", "rate": "deg/s", "output": "deg/s"}, {"kind": "rate"})


def through(numerator: list[float], denominator: list[float]) -> Callable[[np.ndarray, float], np.ndarray]:
    """A response by its transfer function."""

    def response(rate: np.ndarray, step: float) -> np.ndarray:
        discrete = cont2discrete((numerator, denominator), step, method="bilinear")
        return lfilter(discrete[0].ravel(), discrete[1], rate)

    return response


def late(delay: float) -> Callable[[np.ndarray, float], np.ndarray]:
    def response(rate: np.ndarray, step: float) -> np.ndarray:
        time = np.arange(len(rate)) * step
        return np.interp(time - delay, time, rate)

    return response


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "size", "response"),
    [
        # Between the shapes searched, where the other name is ahead.
        ("bandwidth", 3.0, through([1.0], [0.003, 1.0])),
        ("time_delay", 33.0, late(0.033)),
        # What came before the log passes for a warm-up of 31 ms.
        ("bandwidth", 30.0, through([1.0], [0.03, 1.0])),
    ],
)
def test_a_strong_response_has_its_own_name_and_no_line_or_warm_up(name: str, size: float, response) -> None:
    found = gyromodel.diagnose(answered(response, seed=1), model_from_effects(["scale_factor", "bias"]), hold_out=False)
    assert found.causes[0].effect == name
    assert not {"bias_periodic", "bias_warmup", "bias_step"} & {c.effect for c in found.causes}
    told = {p.name: p for p in found.causes[0].parameters}["delay" if name == "time_delay" else "time_constant"]
    assert told.value == pytest.approx(size, rel=0.005)


def test_a_rate_is_followed_between_gaps() -> None:
    """Four stretches of one motion, which begin anew at another rate."""
    within = np.arange(50) * 0.01
    time = np.concatenate([within + 60.0 * i for i in range(4)])
    rate = np.concatenate([offset + 10.0 * np.sin(6.0 * within) for offset in (0.0, 40.0, -50.0, 30.0)])
    signals = {"time": jnp.asarray(time), "rate": jnp.asarray(rate)}
    assert Bandwidth.candidates(signals)
    assert TimeDelay.candidates(signals)


@pytest.mark.long
@pytest.mark.parametrize("times", [40.0, 1000.0])
@pytest.mark.parametrize(("natural", "damping"), [(12.0, 0.7), (5.0, 0.4), (12.0, 1.0)])
def test_a_loop_of_second_order_is_named_with_its_period_and_damping(natural, damping, times) -> None:
    """Of up to 1000 times the noise, where a part in 10⁴ of interpolation is a tenth of it."""
    rng = np.random.default_rng(1)
    design = MOTION_DESIGNS["dynamic_rates"](rng)
    tau = damping / (np.pi * natural)
    missing = error("bandwidth", design, tau, {"damping": damping})
    output = design.true["rate"] + missing + missing.std() / times * rng.standard_normal(len(missing))
    found = gyromodel.diagnose(
        campaign_of(design, output), model_from_effects(["scale_factor", "bias"]), hold_out=False
    )
    assert (found.verdict, [c.effect for c in found.causes]) == ("named", ["bandwidth"])
    told = {p.name: p for p in found.causes[0].parameters}
    for name, true in (("natural_period", 1 / natural), ("time_constant", tau)):
        assert told[name].value == pytest.approx(1e3 * true, abs=4 * told[name].std)


@pytest.mark.long
def test_a_loop_that_rings_is_named() -> None:
    """At 12 Hz with a damping ratio of 0.35, by tones of up to 3 Hz."""
    ringing, damping = 2 * np.pi * 12, 0.35
    campaign = answered(through([ringing**2], [1, 2 * damping * ringing, ringing**2]), seed=1)
    found = gyromodel.diagnose(campaign, model_from_effects(["scale_factor", "bias"]), hold_out=False)
    assert (found.verdict, [c.effect for c in found.causes]) == ("named", ["bandwidth"])
    told = {p.name: p for p in found.causes[0].parameters}
    assert told["natural_period"].value == pytest.approx(1e3 / 12, rel=0.005)


@pytest.mark.long
def test_a_response_that_no_lag_or_delay_is_has_no_name() -> None:
    """A notch at 1.2 Hz, amid the tones."""
    w = 2 * np.pi * 1.2
    campaign = answered(through([1.0, 0.2 * w, w**2], [1.0, 1.4 * w, w**2]), seed=1)
    found = gyromodel.diagnose(campaign, model_from_effects(["scale_factor", "bias"]), hold_out=False)
    assert found.verdict == "unknown"
    assert found.driver
    assert found.driver.column == "d(rate)/dt"


def test_a_loop_of_second_order_is_written_and_read(tmp_path) -> None:
    loop = Bandwidth(natural_period=jnp.asarray([1 / 12]), time_constant=jnp.asarray(0.0186))
    gyromodel.write_model(GyroModel((loop,)), tmp_path / "model.yaml")
    assert "natural_period" in (tmp_path / "model.yaml").read_text()
    read = gyromodel.read_model(tmp_path / "model.yaml").effects[0]
    assert isinstance(read, Bandwidth)
    assert np.asarray(read.natural_period) == pytest.approx([1 / 12], rel=1e-5)
    assert float(read.time_constant) == pytest.approx(0.0186, rel=1e-5)
    for periods in ((-0.1,), (0.1, 0.2)):
        with pytest.raises(ValueError, match="natural_period takes one value above zero"):
            Bandwidth(natural_period=jnp.asarray(periods))


@pytest.mark.parametrize("damping", [0.2, 0.999, 1.0, 1.0 + 1e-9, 4.0])
def test_a_lag_of_second_order_is_exact_at_any_damping(damping: float) -> None:
    """A rate of t², of which d = −2τt + 2(τ² − κ) once the start is forgotten, κ = 1/w²; derivatives by differences."""
    time, period = jnp.arange(800) * 0.01, 0.1
    tau, kappa = damping * period / np.pi, (period / (2 * np.pi)) ** 2
    found = second_order_lag(time, time**2, jnp.asarray(period), jnp.asarray(tau))
    expected = -2 * tau * time + 2 * (tau**2 - kappa)
    assert np.asarray(found - expected)[time > 7] == pytest.approx(0.0, abs=1e-9)
    swinging, at = jnp.sin(20 * time + 0.3), jnp.asarray([period, tau])

    def lagging(shape):
        return second_order_lag(time, swinging, shape[0], shape[1])

    derivatives = np.asarray(jax.jacfwd(lagging)(at))
    for i in (0, 1):
        step = jnp.zeros(2).at[i].set(1e-5 * at[i])
        differences = np.asarray(lagging(at + step) - lagging(at - step)) / float(2 * step[i])
        assert derivatives[:, i] == pytest.approx(differences, abs=1e-6 * np.abs(differences).max())


@pytest.mark.parametrize("delay", [0.0, 4e-3])
@pytest.mark.parametrize("kind", ["rate", "increment"])
def test_a_delay_of_a_rate_with_few_rows_a_period_is_no_lag(kind: str, delay: float) -> None:
    """Eleven rows a period of a fast wave in little noise: a cubic between rows made a lag of a delay, and of none."""
    generator, step, rows = np.random.default_rng(3), 0.1, 2000
    time, cycles, size, phase = step * np.arange(rows), (0.13, 0.41, 0.9), (20.0, 12.0, 8.0), (0.4, 1.9, 5.1)
    waves = [(2.0 * np.pi * f, a, p) for f, a, p in zip(cycles, size, phase, strict=True)]

    def angle(at: np.ndarray) -> np.ndarray:
        return sum((-a / w * np.cos(w * at + p) for w, a, p in waves), np.zeros(len(at)))

    def turning(at: np.ndarray) -> np.ndarray:
        return sum((a * np.sin(w * at + p) for w, a, p in waves), np.zeros(len(at)))

    late = time - delay
    output = turning(late) if kind == "rate" else angle(late) - angle(late - step)
    output = output + 0.0055 * (1.0 if kind == "rate" else step) * generator.standard_normal(rows)
    units = {"time": "s", "rate": "deg/s", "output": "deg/s" if kind == "rate" else "deg"}
    log = Campaign({"time": time, "rate": turning(time), "output": output}, units, {"kind": kind})
    found = gyromodel.diagnose(log, model_from_effects(["bias", "scale_factor"]), hold_out=False)
    if not delay:
        assert found.verdict == "adequate"
        return
    assert (found.verdict, [c.effect for c in found.causes]) == ("named", ["time_delay"])
    fitted = next(p for p in found.causes[0].parameters if p.name == "delay")
    assert abs(fitted.value - 1e3 * delay) < 4.0 * fitted.std < 0.1
    assert not any("noise" in line.lower() or "gross error" in line for line in found.findings)
