"""The hidden wing against the full model and closed forms."""

import numpy as np
import pytest

from benchmarks.blind.cases import Order, Workbench, make_case, workbench
from benchmarks.blind.changes import Changes, Fault
from benchmarks.blind.instruments import Chance, true_signals
from benchmarks.blind.laws import FRICTION, Law
from benchmarks.blind.structure import Structure
from fe.wing.responses import eigenmodes, solve_static

pytestmark = pytest.mark.long  # the full model is projected once, in about 20 s

STATE = {
    "young_modulus_factor": 1.013,
    "servo_mass": 0.166,
    "pitot_mass": 0.141,
    "damping_alpha": 1.05,
    "damping_beta": 7.4e-4,
}
STICKING = Changes(laws=(Law("root", FRICTION, (6.0, 0.0)),))
TIP = 1.778  # m from the root


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Workbench:
    """Build the wing's basis in a folder of its own."""
    return workbench("wing", tmp_path_factory.getbasetemp() / "blind")


def wing(work: Workbench, **changes: object) -> Structure:
    return work.rig.structure(STATE, Changes(**changes))


def shown(work: Workbench, name: str, amplitude: float = 0.0, **changes: object) -> np.ndarray:
    """Return the outputs of a trial."""
    trial = next(trial for trial in work.plan.trials if trial.name == name)
    return work.rig.respond(wing(work, **changes), Changes(**changes), trial, amplitude)[0]


def rows(work: Workbench, name: str) -> np.ndarray:
    return next(trial.rows for trial in work.plan.trials if trial.name == name)


def test_projected_wing_is_the_full_model(work):
    operators, noise = work.rig.store.operators, 5e-6
    tip, flight, force = shown(work, "tip 1"), shown(work, "flight 1"), float(rows(work, "tip 1")[5])
    full = solve_static(operators, 1.013, load_factor=0.0, tip_force=force)
    np.testing.assert_allclose(tip[5, :24], full.strain, atol=1e-2 * noise)
    expected = [operators.load_tip @ full.displacement, full.output[0]]
    np.testing.assert_allclose(tip[5, 24:26], expected, rtol=1e-5)
    turn = solve_static(operators, 1.013, load_factor=3.0).strain
    np.testing.assert_allclose(flight[2, :24], turn, atol=4e-2 * noise)
    modes = eigenmodes(operators, 1.013, (0.0, 0.0), 0.166, 0.141, 6)
    np.testing.assert_allclose(wing(work).angular_frequency[:6] / (2.0 * np.pi), modes.frequency, rtol=2e-6)


def test_root_compliance_turns_the_wing_as_a_rigid_body(work):
    added = shown(work, "tip 1", root_compliance=2e-5) - shown(work, "tip 1")
    np.testing.assert_allclose(added[:, 24], 2e-5 * rows(work, "tip 1") * TIP**2, rtol=1e-4)
    np.testing.assert_allclose(added[:, :24], 0.0, atol=1e-9)


def test_point_mass_lowers_the_frequency_as_rayleigh_says(work):
    mass, station, plain, basis = 2e-4, 1.5, wing(work), work.rig.store.basis()
    heavy = wing(work, mass=mass, mass_station=station)
    motion = [np.interp(station, basis.stations, row) for row in basis.line[2].T] @ plain.shapes[:, 0]
    found = heavy.angular_frequency[0] / plain.angular_frequency[0] - 1.0
    assert found == pytest.approx(-0.5 * mass * motion**2, rel=2e-2)


@pytest.mark.parametrize(
    ("place", "shift", "lever"),
    [
        ("tip", {}, TIP),
        ("tip", {"shift_span": -0.06}, TIP - 0.06),
        ("tip", {"shift_chord": 0.02}, TIP),
        ("middle", {"shift_span": 0.03}, 0.944),
        ("corner", {"shift_span": 0.03, "shift_chord": -0.02}, 1.808),
    ],
)
def test_displaced_force_has_the_lever_of_its_place(work, place, shift, lever):
    """The bending moment at the root, which the root's rotation shows."""
    turn = wing(work).ports["root"] @ wing(work).solve(work.rig.load(place, Changes(**shift)))
    assert work.rig.store.basis().flap_spring * turn == pytest.approx(lever, rel=1e-4)


def test_weight_and_washout_in_flight(work):
    plain, structure = shown(work, "flight 1")[:, :24], wing(work)
    weight = (structure.outputs @ structure.solve(work.rig.store.basis().weight))[:24]
    relieved = shown(work, "flight 1", relief=0.2)[:, :24] - plain
    np.testing.assert_allclose(relieved, 0.2 * np.outer(rows(work, "flight 1"), weight), atol=1e-12)
    assert work.rig.design.lift.inertia_relief
    lost = plain - shown(work, "flight 1", washout=0.05, washout_exponent=1.0)[:, :24]
    # The loss grows with the square of the load factor, and outboard gauges lose a greater share.
    np.testing.assert_allclose(lost[2], 9.0 * lost[0], rtol=1e-9)
    share = lost[2] / plain[2]
    assert share[15] > share[0] > 0.0


def test_turned_gauge_reads_the_full_model_along_the_turned_direction(work):
    """Mohr's circle: the mean of both turns has no shear; bending squeezes the skin sideways a little."""
    angle, load, read = 0.2, work.rig.load("tip", Changes()), []
    for turn in (0.0, 0.5 * np.pi, angle, -angle):
        turned = wing(work, faults=(Fault("rotation", ("g05",), (turn,)),))
        read.append(turned.outputs[5] @ turned.solve(load))
    along, wide, one, two = read
    assert along == pytest.approx(wing(work).outputs[5] @ wing(work).solve(load), rel=1e-12)
    mean = np.cos(angle) ** 2 * along + np.sin(angle) ** 2 * wide
    assert 0.5 * (one + two) == pytest.approx(mean, rel=1e-9)
    assert abs(wide) < 0.5 * abs(along)


def test_friction_at_the_root_stiffens_small_swings_and_damps_large_ones(work):
    chance = Chance(STATE, {trial.name: trial.release for trial in work.plan.trials})
    signals = true_signals(work.rig, work.plan, chance, STICKING)
    trial = next(trial for trial in work.plan.trials if trial.name == "release 40 mm up 3")
    late = signals[trial.name][900:, trial.channels.index("tip")]
    up = np.flatnonzero((late[:-1] < 0.0) & (late[1:] >= 0.0))
    at = up + late[up] / (late[up] - late[up + 1])
    frequency = (len(at) - 1) / (at[-1] - at[0]) * 250.0
    # Stuck, the root's spring does not move: the wing swings as on a rigid root.
    rigid = wing(work, root_compliance=-0.999999 / work.rig.store.basis().flap_spring)
    assert frequency == pytest.approx(rigid.angular_frequency[0] / (2.0 * np.pi), rel=1e-3)
    assert frequency > 1.01 * wing(work).angular_frequency[0] / (2.0 * np.pi)


def test_steps_and_modes_are_fine_enough(work, monkeypatch):
    """Finer steps and more modes change readings by less than a tenth of the noise."""

    def reading() -> np.ndarray:
        values = shown(work, "release 40 mm up 1", 0.04, laws=STICKING.laws)
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
