"""What runs inside our FMUs, called as FMI 2 says: the one in Python and the compiled one alike.

Phases, refusals that change nothing, lazy outputs, serialised state; and that both give the same numbers.
"""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fe.runtime.modal_system import rayleigh_damping_ratio
from fe.runtime.reduced import ReducedModel
from fe.runtime.state import TIP_FORCE, DigitalState
from fmu_asset.packing.structure_fmu import build_fmu
from fmu_asset.slaves.variables import (
    STATUS_BAD_CALL,
    STATUS_BAD_STATE,
    STATUS_BAD_STEP,
    STATUS_INTERNAL,
    STATUS_NOT_FINITE,
    STATUS_OK,
    STATUS_OUTSIDE_RANGE,
)
from tests.fmu_asset.ours import OurFmus
from tests.fmu_asset.slaves.slave import DISCARD, ERROR, OK, Slave
from tests.kept import compiled_wing
from tests.wings import wing_integrator

STRAIN, TIP, BOUND, LOAD_POINT, MODAL = slice(10, 34), 34, 35, 36, slice(37, 49)
"""Places in `everything()` of a wing, the real variables in order."""
PARAMETERS = {"mass.servo": 0.169, "mass.pitot": 0.134, "damping.alpha": 1.0, "damping.beta": 1e-4}
GOOD = [2.0, 0.1, 0.2, 1.0]
NAMES = ("load_factor", "health.z1", "health.z2", "tip_force")


@pytest.fixture(scope="module", params=["python", "compiled"])
def pair(request: pytest.FixtureRequest, ours: OurFmus) -> Iterator[tuple[Slave, Slave]]:
    """Two instances of one kind; every test starts them anew."""
    with closing(Slave(ours(request.param))) as one, closing(Slave(ours(request.param))) as two:
        yield one, two


@pytest.fixture
def slave(pair: tuple[Slave, Slave]) -> Slave:
    return pair[0]


@pytest.fixture(scope="module")
def both(ours: OurFmus) -> Iterator[tuple[Slave, Slave]]:
    """The compiled one and the one in Python."""
    with closing(Slave(ours("compiled"))) as one, closing(Slave(ours("python"))) as two:
        yield one, two


def is_compiled(slave: Slave) -> bool:
    return slave.description.path.stem.startswith("compiled")


# ---------------------------------------------------------------------- numbers


def test_a_start_is_the_equilibrium_and_modal_outputs_follow(slave: Slave, model: ReducedModel) -> None:
    values = {name.replace(".", "__"): value for name, value in PARAMETERS.items()}
    assert slave.start(load_factor=2.0, health__z1=0.3, **values) == OK
    expected = model.static_response({"z1": 0.3, "load_factor": 2.0})
    everything = slave.everything()
    np.testing.assert_allclose(everything[STRAIN], expected.strain, rtol=1e-12)
    assert everything[TIP] == pytest.approx(expected.displacement[0], rel=1e-12)
    assert slave.status == STATUS_OK
    before = slave.of("frequency[1]")
    assert slave.step([2.0, 0.6, 0.0, 0.0], 0.0, 1.0) == OK
    frequency = model.modes({"z1": 0.6}).frequency
    assert slave.of("frequency[1]") == pytest.approx(frequency[0], rel=1e-12)
    assert slave.of("frequency[1]") < before
    ratio = rayleigh_damping_ratio(1.0, 1e-4, frequency)[1]
    assert slave.of("damping_ratio[2]") == pytest.approx(ratio, rel=1e-12)
    integrator = wing_integrator(model, damping_alpha=1.0, damping_beta=1e-4)
    assert slave.start(response=2, initial_tip_displacement=0.03, **values) == OK
    released = integrator.outputs(integrator.released(0.03, (1.0, 0.0), TIP_FORCE))
    scale = np.abs(released[:-1]).max()
    np.testing.assert_allclose(slave.everything()[STRAIN], released[:-1], rtol=0.0, atol=1e-12 * scale)


def test_start_values_come_from_the_state(ours: OurFmus, model: ReducedModel, tmp_path: Path) -> None:
    ours("compiled")  # skips where there is no compiler
    given = {"young_modulus_factor": 1.0 + 1e-15, "stiffness_loss": (0.1, 1.0 / 3.0)}
    with closing(Slave(compiled_wing(model, tmp_path, state=DigitalState(**given)))) as slave:
        assert slave.everything()[1:3] == [0.1, 1.0 / 3.0]
        assert slave.of("young_modulus_factor") == 1.0 + 1e-15
        assert slave.start() == OK
        expected = model.static_response(**given, load_factor=1.0)
        np.testing.assert_allclose(slave.everything()[STRAIN], expected.strain, rtol=1e-12)


@settings(deadline=None)
@given(size=st.floats(1e-4, 0.5), parts=st.integers(2, 7))
def test_the_transient_does_not_depend_on_the_step_size(pair: Any, size: float, parts: int) -> None:
    whole, split = pair
    for slave in pair:
        slave.start(response=2, initial_tip_displacement=0.02)
    inputs = [3.0, 0.5, 0.0, 0.0]
    assert whole.step(inputs, 0.0, size) == OK
    for part in range(parts):
        assert split.step(inputs, part * size / parts, size / parts) == OK
    places = slice(10, 35)
    np.testing.assert_allclose(whole.everything()[places], split.everything()[places], rtol=1e-9, atol=1e-12)


def random_flight(slave: Slave, seed: int, response: int, *, overdamped: bool, steps: int = 25) -> np.ndarray:
    """Parameters, inputs and steps at random: health mostly stays, a load is often none at all."""
    rng = np.random.default_rng(seed)
    ranged = [v for v in slave.description.variables if v.kind == "Real" and v.maximum is not None]
    start = {
        v.name.replace(".", "__"): rng.uniform(v.minimum, v.maximum)
        for v in ranged
        if v.causality == "parameter" and not v.name.startswith(("damping", "initial"))
    }
    if "initial_tip_displacement" in slave.reference:
        start["initial_tip_displacement"] = rng.uniform(-0.1, 0.1)
        start["damping__beta"] = rng.uniform(3e-4, 2e-2 if overdamped else 1e-3)
    start["damping__alpha"] = (
        rng.uniform(60.0, 900.0) if overdamped else rng.choice([0.0, rng.uniform(0.5, 5.0)])
    )
    assert slave.start(response=response, **start) == OK, slave.log
    inputs = [v for v in ranged if v.causality == "input"]
    values, time, seen = [1.0 * (v.name == "load_factor") for v in inputs], 0.0, [slave.everything()]
    for _ in range(steps):
        for number, variable in enumerate(inputs):
            if rng.random() < (0.3 if variable.name.startswith("health") else 0.5):
                values[number] = float(rng.uniform(variable.minimum, variable.maximum))
        loads = [number for number, v in enumerate(inputs) if not v.name.startswith("health")]
        if rng.random() < 0.2:
            values[int(rng.choice(loads))] = 0.0
        size = float(rng.choice([1e-5, 1e-4, 1e-3, 0.01, 0.1, 1.0]))
        assert slave.step(values, time, size) == OK, slave.log
        time += size
        seen.append(slave.everything())
    return np.array(seen)


def assert_same_numbers(
    names: list[str], ours: np.ndarray, expected: np.ndarray, *, so_far: bool = True
) -> None:
    """Compare to 1e-12: with the largest of its kind in the flight (so far), modal outputs with each."""
    size = np.maximum.accumulate(np.abs(expected))
    size = size if so_far else np.broadcast_to(size[-1], size.shape)

    def largest(*beginnings: str) -> np.ndarray:
        return size[:, [name.startswith(beginnings) for name in names]].max(axis=1)

    # A bound is made of outputs that cancel, so that its digits end where theirs do.
    strain, moved = largest("strain[", "strain."), largest("tip_displacement", "displacement.")
    scales = {"strain": strain, "tip": moved, "displacement": moved, "load_point": moved}
    for number, name in enumerate(names):
        scale = next(
            (each for begin, each in scales.items() if name.startswith(begin)), np.abs(expected[:, number])
        )
        if name.startswith("acceleration"):
            scale = size[-1, number]
        assert np.all(np.abs(ours[:, number] - expected[:, number]) <= 1e-12 * scale), name


@pytest.mark.parametrize(
    ("response", "overdamped"), [(1, False), (2, False), (2, True)], ids=["steady", "transient", "overdamped"]
)
@pytest.mark.parametrize("structure", ["wing", "beam"])
def test_the_compiled_one_gives_the_numbers_of_that_in_python(
    ours: OurFmus, structure: str, response: int, overdamped: bool
) -> None:
    """Strains, displacements, accelerations, bounds, frequencies, damping ratios."""
    files = ("compiled", "python") if structure == "wing" else ("compiled_beam", "beam")
    with closing(Slave(ours(files[0]))) as one, closing(Slave(ours(files[1]))) as two:
        for seed in range(12):
            seen = [random_flight(each, seed, response, overdamped=overdamped) for each in (one, two)]
            assert_same_numbers(one.names, *seen, so_far=structure == "wing")
            if structure == "beam":
                shaken = seen[0][1:, one.names.index("acceleration.shake")]
                assert (np.abs(shaken).max() > 0.0) == (response == 2)


def test_an_undamped_ringdown_equals_that_in_python(both: tuple[Slave, Slave]) -> None:
    seen: list[list[list[float]]] = [[], []]
    for one, rows in zip(both, seen, strict=True):
        still = {"damping__alpha": 0.0, "damping__beta": 0.0}
        assert one.start(response=2, initial_tip_displacement=0.1, **still) == OK
        for index in range(100):
            assert one.step([1.0, 0.5 if index > 50 else 0.0, 0.0, 0.0], 0.002 * index, 0.002) == OK
            rows.append(one.everything())
    assert_same_numbers(both[0].names, *map(np.array, seen))


def test_outputs_can_be_read_while_initialising(both: tuple[Slave, Slave]) -> None:
    seen = []
    for one in both:
        one.fmu.reset()
        one.fmu.setupExperiment(startTime=3.0)
        one.fmu.enterInitializationMode()
        one.fmu.setReal([0], [2.5])
        one.everything()
        one.fmu.setReal([0, 1], [3.5, 0.4])
        seen.append(np.array([one.everything()]))
        one.fmu.exitInitializationMode()
        assert one.step([3.5, 0.4, 0.0, 0.0], 3.0, 0.5) == OK
    assert_same_numbers(both[0].names, *seen)


def test_modes_that_coincide_are_those_in_python(
    compiler: Any, beam_model: ReducedModel, tmp_path: Path
) -> None:
    """A double mode, two 1e-7 apart, two 1e-3, whatever the loss: motion and frequencies to 1e-9."""
    size = beam_model.modal_load.shape[1]
    turn = np.linalg.qr(np.random.default_rng(5).normal(size=(size, size)))[0]
    squares = 1e6 * np.arange(1.0, size + 1.0) ** 2
    squares[2], squares[4] = squares[1], squares[3] * (1.0 + 1e-7)
    squares[6] = squares[5] * 1.001
    shares = np.full(len(beam_model.modal_stiffness), 1.0 / len(beam_model.modal_stiffness))
    masses = np.zeros_like(beam_model.modal_mass)
    masses[0] = np.eye(size)
    model = replace(
        beam_model,
        modal_stiffness=np.multiply.outer(shares, (turn * squares) @ turn.T),
        modal_mass=masses,
        cross_mass=np.zeros_like(beam_model.cross_mass),
    )
    kinds: tuple[Literal["compiled", "python"], ...] = ("compiled", "python")
    files = [build_fmu(model, tmp_path / f"{kind}.fmu", kind=kind).path for kind in kinds]
    with closing(Slave(files[0])) as one, closing(Slave(files[1])) as two:
        for seed in range(3):
            seen, expected = (random_flight(each, seed, 2, overdamped=False) for each in (one, two))
            scale = np.maximum(np.abs(expected).max(axis=0), 1e-300)
            assert (np.abs(seen - expected).max(axis=0) <= 1e-9 * scale).all()


def test_a_compiled_fmu_bounds_as_the_model_does(
    compiler: Any, plate_model: ReducedModel, tmp_path: Path
) -> None:
    rng = np.random.default_rng(3)
    with closing(Slave(compiled_wing(plate_model, tmp_path))) as slave:
        assert slave.start() == OK, slave.log
        for number in range(5):
            regions = plate_model.regions
            values = {name: float(rng.uniform(*plate_model.validity[name])) for name in regions}
            values |= {"pull": 2e4, "bend": -30.0 * number}
            given = [slave.reference.get(name, slave.reference.get(f"health.{name}")) for name in values]
            slave.fmu.setReal(given, list(values.values()))
            assert slave.status_of(slave.fmu.doStep, 0.1 * number, 0.1) == OK, slave.log
            found = plate_model.static_response(values)
            for kind in ("strain", "displacement"):
                wanted = getattr(found, f"{kind}_error_bound")
                assert slave.of(f"{kind}_error_bound") == pytest.approx(wanted, rel=1e-6)


# ---------------------------------------------------------------------- refusals


WRONG_VALUES = (
    st.sampled_from([math.nan, math.inf, -math.inf]) | st.floats(30.0, 1e300) | st.floats(-1e300, -30.0)
)
WRONG_TIMES = [(0.01, size) for size in (0.0, -1.0, math.nan, math.inf)]
WRONG_TIMES += [(time, 0.01) for time in (0.0, 0.5, math.nan)]


def assert_refused(
    pair: tuple[Slave, Slave], inputs: list[float], time: float, size: float, status: int
) -> None:
    """Assert that a step is refused with Discard and changes nothing; the other instance never made it."""
    slave, twin = pair
    before = slave.everything()
    assert slave.step(inputs, time, size) == DISCARD
    assert slave.log[-1][0] == DISCARD
    assert slave.status == status
    assert slave.everything()[10:] == before[10:] == twin.everything()[10:]


@settings(deadline=None)
@given(index=st.integers(0, 3), value=WRONG_VALUES, response=st.sampled_from([1, 2]))
def test_refused_inputs_change_nothing(pair: Any, index: int, value: float, response: int) -> None:
    for one in pair:
        one.start(response=response, initial_tip_displacement=0.01)
        assert one.step(GOOD, 0.0, 0.01) == OK
    wrong = [value if k == index else given for k, given in enumerate(GOOD)]
    status = STATUS_OUTSIDE_RANGE if math.isfinite(value) else STATUS_NOT_FINITE
    assert_refused(pair, wrong, 0.01, 0.01, status)
    assert pair[0].log[-1][1].startswith(NAMES[index])
    assert pair[0].status_of(pair[0].fmu.getRealStatus, 2) == OK
    for one in pair:
        assert one.step(GOOD, 0.01, 0.01) == OK
        assert one.status == STATUS_OK
    assert pair[0].everything() == pair[1].everything()


def test_steps_of_no_size_or_from_another_time_are_refused(pair: tuple[Slave, Slave]) -> None:
    for one in pair:
        one.start(response=2, initial_tip_displacement=0.01)
        assert one.step(GOOD, 0.0, 0.01) == OK
    for time, size in WRONG_TIMES:
        assert_refused(pair, GOOD, time, size, STATUS_BAD_STEP)
    assert any("stands at t = 0.01" in text for _, text in pair[0].log[-3:])
    for one in pair:
        assert one.step(GOOD, 0.01, 0.01) == OK
    assert pair[0].everything() == pair[1].everything()


def test_calls_in_the_wrong_phase(slave: Slave) -> None:
    fmu, reference, still = slave.fmu, slave.reference, [1.0, 0.0, 0.0, 0.0]
    fmu.reset()
    assert slave.status_of(fmu.doStep, 0.0, 1.0) != OK
    assert "before initialisation" in slave.log[-1][1]
    assert slave.start() == OK
    slave.status_of(fmu.enterInitializationMode)
    assert slave.status == STATUS_BAD_CALL
    compiled = is_compiled(slave)
    for call in (
        lambda: fmu.setReal([reference["mass.servo"]], [0.2]),
        lambda: fmu.setInteger([reference["response"]], [2]),
        lambda: fmu.setReal([reference["strain[1]"]], [1.0]),
        lambda: fmu.setReal([reference["response"]], [1.0]),
        lambda: fmu.setReal([999], [1.0]),
        lambda: fmu.setBoolean([0], [True]),
        lambda: fmu.setString([0], ["x"]),
    ):
        before = slave.everything()
        assert slave.status_of(call) == (DISCARD if compiled else OK)
        assert slave.status == STATUS_BAD_CALL
        assert slave.everything() == before
    if compiled:
        for call in (
            lambda: fmu.getReal([999]),
            lambda: fmu.getReal([reference["status"]]),
            lambda: fmu.getInteger([reference["strain[1]"]]),
        ):
            assert slave.status_of(call) == ERROR
    else:
        for unknown in ([999], [49, 50, 51], [0, 999]):
            assert math.isnan(fmu.getReal(unknown)[-1])
        assert fmu.getString([0]) == [b""]
        assert list(fmu.getReal([])) == []
        assert any("fixed parameter" in text for _, text in slave.log)
    assert slave.step(still, 0.0, 1.0) == OK
    fmu.terminate()
    assert slave.step(still, 1.0, 1.0) != OK
    assert "after termination" in slave.log[-1][1] or compiled
    assert slave.everything()[10] != 0.0
    assert slave.start() == OK
    if compiled:
        fmu.reset()
        assert slave.status_of(fmu.exitInitializationMode) == ERROR
        assert slave.status_of(fmu.setupExperiment, None, math.nan) == ERROR


@pytest.mark.parametrize(
    ("name", "value", "right"),
    [("mass.servo", 9.0, 0.17), ("damping.alpha", math.nan, 0.0), ("response", 3, 1)],
)
def test_parameters_that_are_refused_stop_the_start(slave: Slave, name: str, value: Any, right: Any) -> None:
    key, still = name.replace(".", "__"), [1.0, 0.0, 0.0, 0.0]
    slave.start(**{key: value})
    assert slave.status in (STATUS_OUTSIDE_RANGE, STATUS_NOT_FINITE)
    assert slave.log[-1][1].startswith(name)
    assert slave.step(still, 0.0, 1.0) != OK
    assert slave.start(anew=False, **{key: right}) == OK
    assert slave.step(still, 0.0, 1.0) == OK


@pytest.mark.parametrize("kind", ["python", "compiled"])
def test_a_computation_that_fails_is_a_refusal(
    ours: OurFmus, model: ReducedModel, tmp_path: Path, kind: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A model that is not positive definite within its own validity box: nothing changes, nothing crashes."""
    ours(kind)  # skips where there is no compiler
    box = model.validity_box.copy()
    box[1] = (0.0, 5.0)
    broken = build_fmu(replace(model, validity_box=box), tmp_path / "broken.fmu", kind=kind).path

    def fail(*_: object) -> None:
        raise np.linalg.LinAlgError("not positive definite")

    with closing(Slave(broken)) as one, monkeypatch.context() as patch:
        assert one.start() == OK
        assert one.step([1.0, 0.1, 0.0, 0.0], 0.0, 1.0) == OK
        before = one.everything()
        if kind == "python":  # which solves it all the same
            packed = sys.modules[f"{one.description.model_identifier}_runtime.fe.reduced"].ReducedModel
            patch.setattr(packed, "static_response", fail)
        assert one.step([1.0, 4.0, 0.0, 0.0], 1.0, 1.0) == DISCARD
        assert one.status == STATUS_INTERNAL
        assert "not positive definite" in one.log[-1][1]
        assert one.everything()[10:] == before[10:]
        patch.undo()
        assert one.step([1.0, 0.2, 0.0, 0.0], 1.0, 1.0) == OK


# ---------------------------------------------------------------------- state and instances

HEALTH = st.floats(0.0, 0.8), st.sampled_from([0.0, 0.3])
STEPS = st.tuples(st.floats(-1.0, 4.0), *HEALTH, st.floats(-20.0, 20.0), st.floats(1e-3, 2.0))


def fly(slave: Slave, time: float, course: list[tuple[float, ...]]) -> float:
    for *inputs, size in course:
        assert slave.step(inputs, time, size) == OK, slave.log
        time += size
    return time


@settings(deadline=None)
@given(
    st.lists(STEPS, max_size=4),
    st.lists(STEPS, max_size=3),
    st.lists(STEPS, max_size=2),
    st.sampled_from([1, 2]),
)
def test_a_restored_state_has_the_same_future(
    pair: Any, steps: Any, later: Any, elsewhere: Any, response: int
) -> None:
    """To the bit, whatever the other instance did before."""
    slave, other = pair
    slave.start(response=response, initial_tip_displacement=0.02, mass__pitot=0.11, damping__alpha=1.5)
    time = fly(slave, 0.0, steps)
    slave.fmu.setReal([3], [3.0])  # set, and not yet stepped with
    other.start(response=3 - response)
    fly(other, 0.0, elsewhere)
    assert other.restore(slave.saved()) == OK
    assert other.everything() == slave.everything()
    assert fly(slave, time, later) == fly(other, time, later)
    assert other.everything() == slave.everything()
    assert other.saved() == slave.saved()


@settings(deadline=None, max_examples=20)
@given(past=st.lists(STEPS, max_size=12), course=st.lists(STEPS, min_size=1, max_size=6))
def test_the_past_of_an_instance_does_not_show(pair: Any, past: Any, course: Any) -> None:
    """What an instance has kept of other states of health never changes a bit of its outputs."""
    pair[0].start(response=2, young_modulus_factor=1.05, mass__pitot=0.11)
    fly(pair[0], 0.0, past)
    pair[0].everything()
    for one in pair:
        one.start(response=2, initial_tip_displacement=0.02, mass__pitot=0.13)
        fly(one, 0.0, course)
    assert pair[0].everything() == pair[1].everything()


def test_states_of_something_else_are_refused(slave: Slave, ours: OurFmus) -> None:
    compiled = is_compiled(slave)
    foreign = []
    for name in ("python" if compiled else "compiled", "compiled_regions" if compiled else "regions"):
        with closing(Slave(ours(name))) as other:
            other.start()
            foreign.append(other.saved())
    assert slave.start(response=2) == OK
    state, before = slave.saved(), slave.everything()
    wrong = [b"", b"x" * 500, state[:-8], *foreign]
    if compiled:
        tagged = state[:8] + bytes([state[8] ^ 1]) + state[9:]
        bad_count = state[:24] + b"\xff\xff\xff\xff" + state[28:]
        not_finite = state[:-8] + np.float64(math.nan).tobytes()
        too_short = state[:24] + (20).to_bytes(4, "little") + state[28 : 28 + 160]
        wrong += [state + b"12345678", tagged, bad_count, not_finite, too_short]
    for content in wrong:
        assert slave.restore(content) == ERROR or not compiled
        assert slave.status == STATUS_BAD_STATE
        assert "was not restored" in slave.log[-1][1]
    assert slave.everything()[:36] == before[:36]
    assert slave.step([1.0, 0.0, 0.0, 0.0], 0.0, 1.0) == OK


def test_two_instances_in_threads_do_not_touch_each_other(both: tuple[Slave, Slave]) -> None:
    """Two instances of one loaded library, each in a thread of its own, give what each gives alone."""

    def flown(one: Slave, seed: int) -> bytes:
        return random_flight(one, seed, 2, overdamped=False, steps=300).tobytes()

    compiled = both[0]
    with closing(Slave(compiled.description.path, like=compiled)) as twin:
        alone = [flown(one, seed) for seed, one in enumerate((compiled, twin))]
        with ThreadPoolExecutor(2) as threads:
            assert list(threads.map(flown, (compiled, twin), (0, 1))) == alone
        assert alone[0] != alone[1]


def test_six_hundred_instances_leave_no_memory_behind(both: tuple[Slave, Slave]) -> None:
    resident = []
    for number in range(600):
        with closing(Slave(both[0].description.path, like=both[0])) as one:
            assert one.start(response=2) == OK
            assert one.step([2.0, 0.1, 0.0, 0.0], 0.0, 0.1) == OK
            one.saved()
        if number in (99, 599):
            pages = int(Path("/proc/self/statm").read_text().split()[1])
            resident.append(pages * os.sysconf("SC_PAGE_SIZE"))
    # One instance holds about half a megabyte.
    assert resident[1] - resident[0] < 4_000_000
