"""The hidden wing against the full model and closed forms."""

import numpy as np
import pytest

from benchmarks.blind.cases import Order, Workbench, make_case, workbench
from benchmarks.blind.changes import Changes, Fault
from benchmarks.blind.instruments import Chance, true_signals
from benchmarks.blind.laws import FRICTION, Law
from benchmarks.blind.plan import TrialPlan
from benchmarks.blind.wing_rig import WingRig
from fe.wing.responses import eigenmodes, solve_static

pytestmark = pytest.mark.long  # the full model is projected once, in about 20 s

STATE = {
    "young_modulus_factor": 1.013,
    "servo_mass": 0.166,
    "pitot_mass": 0.141,
    "damping_alpha": 1.05,
    "damping_beta": 7.4e-4,
}


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Workbench:
    """Build the wing's basis in a folder of its own."""
    return workbench("wing", tmp_path_factory.getbasetemp() / "blind")


@pytest.fixture(scope="module")
def rig(work: Workbench) -> WingRig:
    assert isinstance(work.rig, WingRig)
    return work.rig


def _trial(work: Workbench, name: str) -> TrialPlan:
    return next(trial for trial in work.plan.trials if trial.name == name)


def test_projected_wing_is_the_full_model(work, rig):
    operators = rig.store.operators
    structure = rig.structure(STATE, Changes())
    tip, _ = rig.respond(structure, Changes(), _trial(work, "tip 1"))
    flight, _ = rig.respond(structure, Changes(), _trial(work, "flight 1"))
    force = _trial(work, "tip 1").rows[5]
    full = solve_static(operators, 1.013, load_factor=0.0, tip_force=float(force))
    noise = 5e-6
    np.testing.assert_allclose(tip[5, :24], full.strain, atol=1e-2 * noise)
    assert tip[5, 24] == pytest.approx(operators.load_tip @ full.displacement, rel=1e-5)
    assert tip[5, 25] == pytest.approx(full.output[0], rel=1e-5)
    np.testing.assert_allclose(
        flight[2, :24], solve_static(operators, 1.013, load_factor=3.0).strain, atol=4e-2 * noise
    )
    modes = eigenmodes(operators, 1.013, (0.0, 0.0), 0.166, 0.141, 6)
    np.testing.assert_allclose(structure.angular_frequency[:6] / (2.0 * np.pi), modes.frequency, rtol=2e-6)


def test_root_compliance_turns_the_wing_as_a_rigid_body(work, rig):
    compliance = 2e-5
    changes = Changes(root_compliance=compliance)
    trial = _trial(work, "tip 1")
    before, _ = rig.respond(rig.structure(STATE, Changes()), Changes(), trial)
    after, _ = rig.respond(rig.structure(STATE, changes), changes, trial)
    arm = 1.778
    added = after[:, 24] - before[:, 24]
    np.testing.assert_allclose(added, compliance * trial.rows * arm**2, rtol=1e-4)
    np.testing.assert_allclose(after[:, :24], before[:, :24], atol=1e-9)


def test_point_mass_lowers_the_frequency_as_rayleigh_says(rig):
    mass, station = 2e-4, 1.5
    plain = rig.structure(STATE, Changes())
    heavy = rig.structure(STATE, Changes(mass=mass, mass_station=station))
    basis = rig.store.basis()
    place = np.array([np.interp(station, basis.stations, row) for row in basis.line[2].T])
    motion = float(place @ plain.shapes[:, 0])
    wanted = -0.5 * mass * motion**2
    found = heavy.angular_frequency[0] / plain.angular_frequency[0] - 1.0
    assert found == pytest.approx(wanted, rel=2e-2)


def test_displaced_force_has_the_lever_of_its_place(work, rig):
    """The bending moment at the root, which the root's rotation shows."""
    structure = rig.structure(STATE, Changes())
    spring = rig.store.basis().flap_spring

    def moment(place: str, changes: Changes) -> float:
        return spring * float(structure.ports["root"] @ structure.solve(rig.load(place, changes)))

    assert moment("tip", Changes()) == pytest.approx(1.778, rel=1e-4)
    assert moment("tip", Changes(shift_span=-0.06)) == pytest.approx(1.718, rel=1e-4)
    assert moment("tip", Changes(shift_chord=0.02)) == pytest.approx(1.778, rel=1e-4)
    assert moment("middle", Changes(shift_span=0.03)) == pytest.approx(0.944, rel=1e-4)
    assert moment("corner", Changes(shift_span=0.03, shift_chord=-0.02)) == pytest.approx(1.808, rel=1e-4)


def test_weight_and_washout_in_flight(work, rig):
    basis, design = rig.store.basis(), rig.design
    structure = rig.structure(STATE, Changes())
    trial = _trial(work, "flight 1")
    plain, _ = rig.respond(structure, Changes(), trial)
    relieved, _ = rig.respond(structure, Changes(relief=0.2), trial)
    weight = (structure.outputs @ structure.solve(basis.weight))[:24]
    np.testing.assert_allclose((relieved - plain)[:, :24], 0.2 * np.outer(trial.rows, weight), atol=1e-12)
    assert design.lift.inertia_relief
    washed, _ = rig.respond(structure, Changes(washout=0.05, washout_exponent=1.0), trial)
    lost = (plain - washed)[:, :24]
    # The loss grows with the square of the load factor.
    np.testing.assert_allclose(lost[2], 9.0 * lost[0], rtol=1e-9)
    # Outboard gauges lose a greater share.
    share = lost[2] / plain[2, :24]
    assert share[15] > share[0] > 0.0


def test_turned_gauge_reads_the_full_model_along_the_turned_direction(work, rig):
    angle = 0.2
    fault = Fault("rotation", ("g05",), (angle,))
    turned = rig.structure(STATE, Changes(faults=(fault,)))
    across = rig.structure(STATE, Changes(faults=(Fault("rotation", ("g05",), (0.5 * np.pi,)),)))
    back = rig.structure(STATE, Changes(faults=(Fault("rotation", ("g05",), (-angle,)),)))
    plain = rig.structure(STATE, Changes())
    load = rig.load("tip", Changes())
    along, wide, one, two = (float(s.outputs[5] @ s.solve(load)) for s in (plain, across, turned, back))
    # Mohr's circle: the mean of both turns has no shear in it; bending squeezes the skin sideways a little.
    mean = np.cos(angle) ** 2 * along + np.sin(angle) ** 2 * wide
    assert 0.5 * (one + two) == pytest.approx(mean, rel=1e-9)
    assert abs(wide) < 0.5 * abs(along)


def test_friction_at_the_root_stiffens_small_swings_and_damps_large_ones(work, rig):
    law = Law("root", FRICTION, (6.0, 0.0))
    chance = Chance(STATE, {trial.name: trial.release for trial in work.plan.trials})
    signals = true_signals(rig, work.plan, chance, Changes(laws=(law,)))
    trial = _trial(work, "release 40 mm up 3")
    tip = signals[trial.name][:, trial.channels.index("tip")]
    late = tip[900:]
    up = np.flatnonzero((late[:-1] < 0.0) & (late[1:] >= 0.0))
    at = up + late[up] / (late[up] - late[up + 1])
    frequency = (len(at) - 1) / (at[-1] - at[0]) * 250.0
    # Stuck, the root's spring does not move: the wing swings as on a rigid root.
    rigid = rig.structure(STATE, Changes(root_compliance=-0.999999 / rig.store.basis().flap_spring))
    assert frequency == pytest.approx(rigid.angular_frequency[0] / (2.0 * np.pi), rel=1e-3)
    free = rig.structure(STATE, Changes())
    assert frequency > 1.01 * free.angular_frequency[0] / (2.0 * np.pi)


def test_steps_and_modes_are_fine_enough(work, rig, monkeypatch):
    """Finer steps and more modes change readings by less than a tenth of the noise."""
    trial = _trial(work, "release 40 mm up 1")
    law = Law("root", FRICTION, (6.0, 0.0))
    changes = Changes(laws=(law,))

    def reading() -> np.ndarray:
        structure = rig.structure(STATE, changes)
        values, _ = rig.respond(structure, changes, trial, 0.04)
        return values[:, [2, 10, 25]] / [5e-6, 5e-6, 1e-4]

    usual = reading()
    monkeypatch.setattr("benchmarks.blind.structure.STEP", 1e-4)
    monkeypatch.setattr("benchmarks.blind.wing_rig.MODES", 30)
    assert np.abs(reading() - usual).max() < 0.1


@pytest.mark.parametrize("identifier", ["point_mass", "joint_micro_slip", "gauge_misalignment", "mains_hum"])
def test_cases_of_the_wing_repeat(work, tmp_path_factory, identifier):
    folder = tmp_path_factory.getbasetemp() / "blind"
    order = Order("case-1", "catalogue", "wing", (identifier,), 9)
    one, two = make_case(order, folder), make_case(order, folder)
    assert one.truth == two.truth
    for name, values in one.measured.values.items():
        assert np.isfinite(values).all()
        np.testing.assert_array_equal(values, two.measured.values[name])
