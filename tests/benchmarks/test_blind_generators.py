"""Hidden effects against closed forms and other integrators."""

import ast
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline

import benchmarks.blind
from benchmarks.blind.cases import DETECTABLE, KINDS, Order, finite_signals, make_case, orders, workbench
from benchmarks.blind.changes import Changes, Fault
from benchmarks.blind.detectability import reference
from benchmarks.blind.effects import DRAWS, LUMPED, jenkins
from benchmarks.blind.instruments import draw_chance, measure, true_signals
from benchmarks.blind.laws import BOUC_WEN, DRAG, FRICTION, GAP, POWER, Law
from benchmarks.blind.lumped_rig import PORTS, model_text
from benchmarks.blind.structure import Release, Structure
from benchmarks.blind.traps import TRAPS
from benchmarks.blind.writing import write_case

pytestmark = pytest.mark.long  # the loops of the generators are compiled in half a minute

RATE = 250.0
STIFFNESS, W = 1000.0, 10.0 * np.pi  # N/m, rad/s: 5 Hz
ONE = np.ones((1, 1))
OSCILLATOR = Structure(STIFFNESS * ONE, STIFFNESS / W**2 * ONE, 0.0, 0.0, ONE, {"x": ONE[0]}, 1)


def moved(structure: Structure, law: Law, amplitude: float = 0.01, refinement: int = 1) -> np.ndarray:
    """Return the outputs (500, C) after a release of the last coordinate."""
    end = np.eye(len(structure.mass))[-1]
    return structure.ringdown(Release(amplitude, end, end, np.arange(500) / RATE), [law], refinement)


# ---------------------------------------------------------------- laws


@pytest.mark.parametrize("exponent", [0.0, 1.0])
def test_friction_takes_its_work_from_every_half_swing(exponent):
    """Dry: two widths, and it stops within one. Structural, g k |x|: from rest at a to rest at b
    (1 + g) b^2 = (1 - g) a^2, on a softer spring inwards and a stiffer one outwards."""
    g, width, half = 0.05, 4e-4, np.arange(12)
    values = moved(OSCILLATOR, Law("x", FRICTION, (STIFFNESS * (g if exponent else width), exponent)))[:, 0]
    swing = np.pi / W * (0.5 * ((1.0 - g) ** -0.5 + (1.0 + g) ** -0.5) if exponent else 1.0)
    turns = CubicSpline(np.arange(len(values)) / RATE, values)(half * swing)
    wanted = 0.01 * ((1.0 - g) / (1.0 + g)) ** (half / 2.0) if exponent else 0.01 - 2.0 * width * half
    np.testing.assert_allclose(turns, wanted * (-1.0) ** half, atol=5e-6)
    if not exponent:
        assert np.ptp(values[-50:]) == 0.0
        assert abs(values[-1]) <= width


def test_masing_rule_holds_for_jenkins_elements():
    """Loads up, down, up: the unloading branch is the first branch twice as large."""
    law = jenkins("x", 0.8 * STIFFNESS, 5.0, -0.5)
    forces = np.concatenate([np.linspace(0.1, 6.0, 60), np.linspace(6.0, -6.0, 121)[1:]])
    values = OSCILLATOR.static(forces[None], [law])[:, 0]
    first = np.interp(np.linspace(0.0, 6.0, 25), [0.0, *forces[:60]], [0.0, *values[:60]])
    down = values[59] - np.interp(np.linspace(0.0, 12.0, 25), 6.0 - forces[59:180], values[59:180])
    np.testing.assert_allclose(down, 2.0 * first, atol=2e-3 * values.max())
    assert values[59] > 6.0 / STIFFNESS * 1.05
    for chi in (-0.5, 0.0, -0.8):  # when all slip they hold the stated force
        law = jenkins("x", 800.0, 5.0, chi, 4000)
        assert float(law.stiffness @ law.slip) == pytest.approx(5.0, rel=2e-3)


@pytest.mark.parametrize(
    "changes",
    [
        Changes(),  # in closed form
        Changes(clock_rate=0.01, clock_zero=0.02),
        Changes(stiffness_rate=0.05),
        Changes(laws=(Law("joint", GAP, (2000.0, 4e-4)),), clock_zero=1.3e-3),
        Changes(laws=(Law("joint", POWER, (-1500.0, 1.0, -1.0)),)),
        Changes(laws=(Law("end", POWER, (4e6, 3.0, 0.0)),)),
        Changes(laws=(Law("end", DRAG, (8.0,)),)),
        Changes(laws=(Law("joint", BOUC_WEN, (2000.0, 0.002, 1.0)),)),
    ],
)
def test_motion_of_the_rig_against_a_general_integrator(changes):
    work = workbench("lumped")
    trial = next(trial for trial in work.plan.trials if trial.release == 0.012)
    structure = work.rig.structure(work.mean.parameters, changes)
    values = work.rig.respond(structure, changes, trial, 0.012)[0][:250]
    shown = true_signals(work.rig, work.plan, work.mean, changes)[trial.name][:250]
    np.testing.assert_allclose(shown, values[:, [0, 2, 4]] / [1e-3, 1e-3, 1e-6])
    law = changes.laws[0] if changes.laws else Law("end", DRAG, (0.0,))
    port, inverse = PORTS[law.port], np.linalg.inv(structure.mass)
    damping = structure.alpha * structure.mass + structure.beta * structure.stiffness

    def force(x: float, z: float) -> float:
        a, b, *_ = (*law.numbers, 0.0, 0.0)
        if law.kind == GAP:
            return -a * float(np.clip(x, -b, b))
        if law.kind == POWER:
            return 0.0 if law.numbers[2] * x < 0.0 else a * abs(x) ** b * np.sign(x)
        return a * (z - x) if law.kind == BOUC_WEN else 0.0

    def rates(t: float, state: np.ndarray) -> np.ndarray:
        u, v, z = state[:3], state[3:6], state[6]
        x, speed = port @ u, port @ v
        inside = force(x, z) if law.kind != DRAG else law.numbers[0] * abs(speed) * speed
        elastic = (1.0 + changes.stiffness_rate * t) * structure.stiffness @ u
        a = inverse @ (-elastic - damping @ v - port * inside)
        dz = (
            speed * (1.0 if speed * z <= 0.0 else 1.0 - abs(z) / law.numbers[1])
            if law.kind == BOUC_WEN
            else 0.0
        )
        return np.concatenate([v, a, [dz]])

    # The held state: the rig's own first sample, checked for equilibrium apart from the holding force.
    at_once = replace(changes, clock_zero=0.0)
    start = work.rig.respond(structure, at_once, trial, 0.012)[0][0, :3]
    z = law.numbers[1] * (1.0 - np.exp(-(port @ start) / law.numbers[1])) if law.kind == BOUC_WEN else 0.0
    rest = structure.stiffness @ start + port * force(port @ start, z)
    np.testing.assert_allclose(rest[:2], 0.0, atol=2e-3)
    assert start[2] == pytest.approx(0.012)
    times = (1.0 + changes.clock_rate) * trial.rows[:250] + changes.clock_zero
    begin = [*start, 0.0, 0.0, 0.0, z]
    found = solve_ivp(rates, (0.0, times[-1]), begin, "DOP853", times, rtol=1e-9, atol=1e-12, max_step=1e-3)
    np.testing.assert_allclose(values[:, :3], found.y[:3].T, atol=0.012 * (3e-4 if changes.laws else 1e-6))


def behind_a_spring(light: float, alpha: float, beta: float, modes: int) -> Structure:
    """A mass behind a light one; its higher modes may move without inertia."""
    stiffness, port = np.array([[3000.0, -2000.0], [-2000.0, 2000.0]]), np.array([1.0, 0.0])
    return Structure(stiffness, np.diag([light, 1.0]), alpha, beta, np.eye(2), {"root": port}, modes)


def test_flexibility_behind_a_port_is_the_limit_of_light_masses():
    """Higher modes without inertia: the same as with all modes, where their masses are small."""
    few, all_modes = (behind_a_spring(1e-3, 0.2, 2e-3, modes) for modes in (1, 2))
    law = Law("root", GAP, (600.0, 0.001))
    # The light mass is stiff: a small step for it.
    np.testing.assert_allclose(moved(few, law, 0.02), moved(all_modes, law, 0.02, 10), atol=0.02 * 3e-3)


def test_friction_behind_a_flexibility_sticks_where_a_rigid_one_sticks():
    """The joint of a beam on a stiff spring: it holds until the spring's force exceeds the friction."""
    values = moved(behind_a_spring(1e-6, 0.0, 1e-3, 1), Law("root", FRICTION, (5.0, 0.0)), 0.02)
    moves = np.abs(np.diff(values[:, 0])) > 1e-6
    assert moves[:20].any()
    assert not moves[-250:].any()
    # Stuck, the end swings on the second spring alone.
    end = values[-250:, 1] - values[-250:, 1].mean()
    up = np.flatnonzero((end[:-1] < 0.0) & (end[1:] >= 0.0))
    crossing = (up + end[up] / (end[up] - end[up + 1])) / RATE
    period = (crossing[-1] - crossing[0]) / (len(crossing) - 1)
    assert period == pytest.approx(2.0 * np.pi / np.sqrt(2000.0), rel=5e-3)


@pytest.mark.parametrize("share", [0.5, 0.97, 1.01, 5.0])  # the last two have another branch far away
def test_a_softening_spring_holds_loads_up_to_its_limit(share):
    """k x - c x^3 = F has a state on the way from rest up to F = 2/3 k sqrt(k / (3 c))."""
    cubic = 4e5
    limit = 2.0 / 3.0 * STIFFNESS * np.sqrt(STIFFNESS / (3.0 * cubic))
    law = Law("x", POWER, (-cubic, 3.0, 0.0))
    (at_half,), (at_share,) = OSCILLATOR.static(np.array([[0.5 * limit, share * limit]]), (law,))
    assert STIFFNESS * at_half - cubic * at_half**3 == pytest.approx(0.5 * limit)
    if share > 1.0:
        assert np.isnan(at_share)
    else:
        assert STIFFNESS * at_share - cubic * at_share**3 == pytest.approx(share * limit)
        assert 0.0 < at_share < np.sqrt(STIFFNESS / (3.0 * cubic))


# ---------------------------------------------------------------- instruments


def _signals(changes: Changes) -> dict[str, np.ndarray]:
    work = workbench("lumped")
    return true_signals(work.rig, work.plan, work.mean, changes)


def test_high_pass_turns_and_shrinks_a_steady_tone_as_its_transfer_function_says():
    tau = 0.05
    before, after = _signals(Changes()), _signals(Changes(faults=(Fault("high_pass", ("x3",), (tau,)),)))
    trial = next(t for t in workbench("lumped").plan.trials if t.release == 0.012)
    k = trial.channels.index("x3")
    assert after[trial.name][0, k] == 0.0
    late = slice(250, 850)
    work = workbench("lumped")
    structure = work.rig.structure(work.mean.parameters, Changes())
    w = structure.angular_frequency[0]
    decay = 0.5 * (structure.alpha + structure.beta * w**2)
    pole = complex(-decay, np.sqrt(w**2 - decay**2))
    t = trial.rows[late]
    basis = np.column_stack([np.exp(pole * t).real, -np.exp(pole * t).imag])
    (a, b), (c, d) = (np.linalg.lstsq(basis, s[trial.name][late, k], rcond=None)[0] for s in (before, after))
    wanted = pole * tau / (1.0 + pole * tau)
    assert complex(c, d) / complex(a, b) == pytest.approx(wanted, rel=2e-2)


def test_gain_offset_drift_line_and_temperature():
    plan = workbench("lumped").plan
    plain = _signals(Changes())
    shown = _signals(
        Changes(
            faults=(
                Fault("gain", ("s1",), (0.1,)),
                Fault("drift", ("s3",), (50.0, 1.0)),
                Fault("thermal", ("s2",), (2e-6,)),
                Fault("offset", ("x1",), (3e-4,), "B"),
                Fault("line", ("x3",), (50.0, 0.4, 0.3)),
            )
        )
    )
    warm = next(t for t in plan.trials if t.kind == "static" and t.temperature)
    other = next(t for t in plan.trials if t.run == "B")
    columns = {name: k for k, name in enumerate(warm.channels)}
    change = shown[warm.name] - plain[warm.name]
    np.testing.assert_allclose(change[:, columns["s1"]], 0.1 * plain[warm.name][:, columns["s1"]])
    np.testing.assert_allclose(change[:, columns["s2"]], 2.0 * warm.temperature)
    np.testing.assert_allclose(change[:, columns["s3"]], 50.0 * warm.campaign_times / plan.duration)
    np.testing.assert_allclose(change[:, columns["x1"]], 0.0)
    np.testing.assert_allclose((shown[other.name] - plain[other.name])[:, columns["x1"]], 0.3)
    ring = next(t for t in plan.trials if t.kind == "ringdown")
    x = ring.channels.index("x3")
    line = 0.5 * np.cos(100.0 * np.pi * ring.rows - np.arctan2(0.3, 0.4))
    np.testing.assert_allclose((shown[ring.name] - plain[ring.name])[:, x], line, atol=1e-9)


def test_load_cell_and_modulus():
    plan = workbench("lumped").plan
    plain = _signals(Changes())
    trial = plan.trials[0]
    shown = _signals(Changes(force_gain=0.03, force_tare=0.5))[trial.name]
    np.testing.assert_allclose(shown, plain[trial.name] * (1.03 + 0.5 / trial.rows[:, None]), rtol=1e-9)
    warm = next(t for t in plan.trials if t.kind == "static" and t.temperature)
    soft = _signals(Changes(modulus_temperature=2e-3))
    np.testing.assert_allclose(soft[warm.name], plain[warm.name] / (1.0 - 2e-3 * 15.0))
    np.testing.assert_allclose(soft[trial.name], plain[trial.name])


def test_noise_is_as_large_and_as_coloured_as_asked():
    work = workbench("lumped")
    generator = np.random.default_rng(3)
    measured = measure(generator, work.plan, work.nominal, Changes(), correlation=0.7)
    for name, samples in measured.noise.items():
        assert np.std(samples) == pytest.approx(work.plan.channels[name].noise, rel=0.25)
        assert np.corrcoef(samples[1:], samples[:-1])[0, 1] == pytest.approx(0.7, abs=0.12)


# ---------------------------------------------------------------- detectability and cases


def test_distance_is_zero_for_what_calibration_absorbs_and_large_for_what_it_cannot():
    work = workbench("lumped")
    known = reference(work.rig, work.plan, work.mean)
    assert known.distance(known.nominal) == 0.0
    shifted = {**work.mean.parameters, "stiffness_factor": 1.01}
    moved = true_signals(work.rig, work.plan, replace(work.mean, parameters=shifted), Changes())
    assert known.distance(moved) <= 1.05  # one prior deviation
    law = Law("joint", FRICTION, (0.3, 0.0))
    assert known.distance(_signals(Changes(laws=(law,)))) > 1e4


# all of them take a minute
@pytest.mark.parametrize(
    "identifier",
    [
        pytest.param(name, marks=() if name in {"coulomb_friction", "cubic_stiffness"} else pytest.mark.long)
        for name in LUMPED
    ],
)
def test_every_effect_of_the_rig_is_detectable_and_repeats_bit_for_bit(identifier):
    order = Order("case-1", "catalogue", "lumped", (identifier,), 5)
    one, two = make_case(order), make_case(order)
    assert one.truth == two.truth
    assert one.truth["d2"][identifier] >= DETECTABLE
    assert one.truth["identifiers"] == [identifier]
    for name, values in one.measured.values.items():
        assert np.isfinite(values).all()
        np.testing.assert_array_equal(values, two.measured.values[name])


@pytest.mark.parametrize("trap", [name for name, trap in TRAPS.items() if "lumped" in trap.rigs])
def test_traps_are_set(trap):
    case = make_case(Order("case-1", "trap", "lumped", (), 8, trap))
    assert case.truth["trap"] == trap
    assert case.truth["accepted"]
    if TRAPS[trap].largest is not None:
        assert max(case.truth["d2"].values()) <= TRAPS[trap].largest
    if trap == "wrong noise label":
        assert not case.measured.noise


def test_written_case_tells_nothing_and_seals_everything(tmp_path):
    case = make_case(Order("case-0007", "catalogue", "lumped", ("coulomb_friction",), 5))
    write_case(case, tmp_path / "campaigns", tmp_path / "sealed")
    folder = tmp_path / "campaigns" / "case-0007"
    text = "".join(file.read_text(encoding="utf-8") for file in sorted(folder.iterdir()))
    assert not any(identifier in text for identifier in set(DRAWS) - {"load_place"})  # a key
    assert (folder / "model.toml").read_text(encoding="utf-8") == model_text()
    sealed = json.loads((tmp_path / "sealed" / "case-0007.json").read_text(encoding="utf-8"))
    assert sealed["identifiers"] == ["coulomb_friction"]
    rows = np.loadtxt(folder / "05.csv", delimiter=",", skiprows=1)
    trial = case.plan.trials[4]
    np.testing.assert_allclose(rows[:, 0], trial.rows, atol=1e-9)
    np.testing.assert_allclose(rows[:, 1:], case.measured.values[trial.name], rtol=1e-6)


def test_orders_hold_every_kind_and_names_tell_nothing():
    made = orders(2, 10, 6, 1, 1, seed=4)
    assert {order.kind for order in made} == set(KINDS)
    assert sum(order.kind == "catalogue" for order in made) == 2 * len(DRAWS)
    assert [order.name for order in made] == [f"case-{k:04d}" for k in range(1, len(made) + 1)]
    assert len({order.seed for order in made}) == len(made)
    assert made == orders(2, 10, 6, 1, 1, seed=4)
    assert made != orders(2, 10, 6, 1, 1, seed=5)


def test_generators_share_no_code_with_what_names():
    forbidden = (
        "discrepancy",
        "fe.runtime.patch",
        "fe.runtime.motion",
        "fe.runtime.patched_wing",
        "fe.runtime.sensors",
        "fe.runtime.reduced",
    )
    for file in Path(benchmarks.blind.__file__).parent.glob("*.py"):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            names = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            names += [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            assert not [name for name in names if name.startswith(forbidden)], file


def test_chance_stays_within_reach_of_the_prior():
    plan = workbench("lumped").plan
    for seed in range(20):
        chance = draw_chance(np.random.default_rng(seed), plan)
        for name, (mean, deviation) in plan.priors.items():
            assert abs(chance.parameters[name] - mean) <= 2.5 * deviation


def test_motion_that_runs_away_is_no_campaign():
    """A law that takes more stiffness from a joint than it has lets it snap; some releases nothing holds."""
    work = workbench("lumped")
    joint, end = work.bench.joint, work.bench.free
    chance = draw_chance(np.random.default_rng(1), work.plan)
    for law, runs_away in (
        (Law(joint.port, BOUC_WEN, (0.5 * joint.stiffness, 0.3 * joint.displacement, 1.0)), False),
        (Law(joint.port, BOUC_WEN, (3.0 * joint.stiffness, 0.3 * joint.displacement, 1.0)), True),
        (Law("end", POWER, (-2.0 * end.stiffness / work.bench.release**2, 3.0, 0.0)), True),
    ):
        assert (finite_signals(work, chance, Changes(laws=(law,))) is None) is runs_away
