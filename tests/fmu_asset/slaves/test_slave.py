"""What runs inside our FMUs, called as FMI says: in Python, and compiled of FMI 2 and of FMI 3, alike.

Phases, refusals that change nothing, lazy outputs, serialised state; and that all give the same numbers.
"""

import ctypes
import math
import re
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest
from fmpy.fmi3 import fmi3IntermediateUpdateCallback, fmi3LogMessageCallback
from hypothesis import given, settings
from hypothesis import strategies as st

from fmu_asset.packing.structure_fmu import build_fmu
from fmu_asset.slaves import variables
from tests.fmu_asset.ours import OurFmus
from tests.fmu_asset.slaves.slave import DISCARD, ERROR, OK, Slave

RESULTS = slice(10, None)
"""Places in `everything()` of a wing, the real variables in order."""
GOOD, STILL = [2.0, 0.1, 0.2, 1.0], [1.0, 0.0, 0.0, 0.0]


@pytest.fixture(scope="module", params=["python", "compiled", "fmi3"])
def pair(request: pytest.FixtureRequest, ours: OurFmus) -> Iterator[tuple[Slave, Slave]]:
    """Two instances of one kind; every test starts them anew."""
    with closing(Slave(ours(request.param))) as one, closing(Slave(ours(request.param))) as two:
        yield one, two


@pytest.fixture
def slave(pair: tuple[Slave, Slave]) -> Slave:
    return pair[0]


def is_compiled(slave: Slave) -> bool:
    return slave.description.path.stem != "python"


# ---------------------------------------------------------------------- numbers


def random_flight(slave: Slave, seed: int, response: int, damping: str = "", steps: int = 25) -> np.ndarray:
    """Parameters, inputs and steps at random: health mostly stays, a load is often none at all."""
    rng = np.random.default_rng(seed)
    ranged = {
        n: (v.minimum, v.maximum, v.causality) for n, v in slave.variables.items() if v.maximum is not None
    }
    start = {
        name.replace(".", "__"): rng.uniform(low, high)
        for name, (low, high, causality) in ranged.items()
        if causality == "parameter" and not name.startswith(("damping", "initial", "response"))
    }
    alpha, beta = rng.choice([0.0, rng.uniform(0.5, 5.0)]), rng.uniform(3e-4, 1e-3)
    if "initial_tip_displacement" in slave.reference:
        start["initial_tip_displacement"] = rng.uniform(-0.1, 0.1)
        start["damping__beta"] = {"": beta, "over": 20.0 * beta, "none": 0.0}[damping]
    start["damping__alpha"] = {"": alpha, "over": rng.uniform(60.0, 900.0), "none": 0.0}[damping]
    assert slave.start(response=response, **start) == OK, slave.log
    values = {name: float(name == "load_factor") for name in slave.inputs}
    time, seen = 0.0, [slave.everything()]
    for _ in range(steps):
        for name in values:
            if rng.random() < (0.3 if name.startswith("health") else 0.5):
                values[name] = float(rng.uniform(*ranged[name][:2]))
        if rng.random() < 0.2:
            values[str(rng.choice([name for name in values if not name.startswith("health")]))] = 0.0
        size = float(rng.choice([1e-5, 1e-4, 1e-3, 0.01, 0.1, 1.0][: 4 if damping == "none" else 6]))
        assert slave.step(list(values.values()), time, size) == OK, slave.log
        time += size
        seen.append(slave.everything())
    return np.array(seen)


def assert_same_numbers(
    names: list[str], ours: np.ndarray, expected: np.ndarray, *, so_far: bool = True
) -> None:
    """Compare to 1e-12: with the largest of its kind in the flight (so far), modal outputs with each.

    A bound is made of strains or displacements that cancel; accelerations jump.
    """
    each = np.abs(expected)
    largest = np.maximum.accumulate(each)
    kinds = [re.match("strain|acceleration|(tip_|load_point_)?displacement|", name)[0][-6:] for name in names]
    for number, kind in enumerate(kinds):
        alike = largest[:, [other == kind for other in kinds]].max(axis=1) if kind else each[:, number]
        scale = alike[-1] if kind == "ration" or (kind and not so_far) else alike
        assert np.all(np.abs(ours[:, number] - expected[:, number]) <= 1e-12 * scale), names[number]


RESPONSES = {"steady": (1, ""), "transient": (2, ""), "overdamped": (2, "over"), "undamped": (2, "none")}


@pytest.mark.parametrize("response", RESPONSES)
@pytest.mark.parametrize("file", ["compiled", "fmi3", "compiled_beam"])
def test_the_compiled_ones_give_the_numbers_of_that_in_python(ours, file, response) -> None:
    """Strains, displacements, accelerations, bounds, frequencies, damping ratios."""
    python = file.removeprefix("compiled_") if "_" in file else "python"
    with closing(Slave(ours(file))) as one, closing(Slave(ours(python))) as two:
        for seed in range(6):
            seen = [random_flight(each, seed, *RESPONSES[response]) for each in (one, two)]
            assert_same_numbers(two.names, *seen, so_far=python == "python")
            if file == "compiled_beam":
                shaken = seen[0][1:, one.names.index("acceleration.shake")]
                assert (np.abs(shaken).max() > 0.0) == (response != "steady")


@pytest.mark.parametrize("response", [1, 2])
@pytest.mark.parametrize("file", ["python", "compiled", "fmi3", "sensing"])
def test_what_is_read_while_initialising_is_that_of_the_start(ours, file, response) -> None:
    """And leaves no trace."""
    seen, given = [], {"effect.coupling.active": 1.0} if file == "sensing" else {}
    for factors in ((2.5, 3.5), (3.5,)):
        with closing(Slave(ours(file))) as slave:
            slave.initialising(3.0)
            slave.choose(response)
            for factor in factors:
                slave.set(given | {"load_factor": factor, "health.z1": 0.4})
                told = slave.everything()
            assert slave.status_of(slave.fmu.exitInitializationMode) == OK
            assert slave.everything() == told
            assert slave.status_of(slave.fmu.doStep, 3.0, 0.5) == OK
            seen.append(slave.everything())
    assert seen[0] == seen[1]


def test_modes_that_coincide_are_those_in_python(compiler, ours, tmp_path) -> None:
    """A double mode, two 1e-7 apart, two 1e-3, whatever the loss: motion and frequencies to 1e-9."""
    beam_model = ours.model("beam")
    size, terms = beam_model.modal_load.shape[1], len(beam_model.modal_stiffness)
    turn = np.linalg.qr(np.random.default_rng(5).normal(size=(size, size)))[0]
    squares = 1e6 * np.arange(1.0, size + 1.0) ** 2
    squares[2], squares[4], squares[6] = squares[1], squares[3] * (1.0 + 1e-7), squares[5] * 1.001
    masses = np.zeros_like(beam_model.modal_mass)
    masses[0] = np.eye(size)
    model = replace(
        beam_model,
        modal_stiffness=np.multiply.outer(np.full(terms, 1.0 / terms), (turn * squares) @ turn.T),
        modal_mass=masses,
        cross_mass=np.zeros_like(beam_model.cross_mass),
    )
    compiled = build_fmu(model, tmp_path / "compiled.fmu", kind="compiled").path
    python = build_fmu(model, tmp_path / "python.fmu").path
    with closing(Slave(compiled)) as one, closing(Slave(python)) as two:
        for seed in range(3):
            seen, expected = (random_flight(each, seed, 2) for each in (one, two))
            scale = np.maximum(np.abs(expected).max(axis=0), 1e-300)
            assert (np.abs(seen - expected).max(axis=0) <= 1e-9 * scale).all()


# ---------------------------------------------------------------------- refusals


WRONG_VALUES = st.sampled_from([math.nan, math.inf, -math.inf]) | st.floats(130.0, 1e300).map(
    lambda value: value if value % 2.0 else -value
)
WRONG_TIMES = [(0.01, size) for size in (0.0, -1.0, math.nan, math.inf)]
WRONG_TIMES += [(time, 0.01) for time in (0.0, 0.5, math.nan)]


def both_step(pair: tuple[Slave, Slave], time: float) -> None:
    for one in pair:
        assert one.step(GOOD, time, 0.01) == OK
        assert one.status == variables.Status.OK
    assert pair[0].everything() == pair[1].everything()


@settings(deadline=None)
@given(st.tuples(st.integers(0, 3), WRONG_VALUES) | st.sampled_from(WRONG_TIMES), st.sampled_from([1, 2]))
def test_refused_steps_change_nothing(pair, wrong, response) -> None:
    """They are refused with Discard; the other instance never makes them."""
    slave, twin = pair
    for one in pair:
        one.start(response=response, initial_tip_displacement=0.01)
    both_step(pair, 0.0)
    inputs, times, status, said = list(GOOD), (0.01, 0.01), variables.Status.BAD_STEP, ""
    if wrong in WRONG_TIMES:
        times = wrong
        said = "stands at t = 0.01" if times[0] in (0.0, 0.5) else ""
    else:
        index, inputs[wrong[0]] = wrong
        status = variables.Status.OUTSIDE_RANGE if math.isfinite(wrong[1]) else variables.Status.NOT_FINITE
        health = "health[{}]" if slave.three else "health.z{}"
        said = ("load_factor", health.format(1), health.format(2), "tip_force")[index]
    before = slave.everything()
    assert slave.step(inputs, *times) == DISCARD
    assert slave.status == status
    assert slave.log[-1][0] == DISCARD
    assert said in slave.log[-1][1]
    assert slave.everything()[RESULTS] == before[RESULTS] == twin.everything()[RESULTS]
    if not slave.three and wrong not in WRONG_TIMES:
        assert slave.status_of(slave.fmu.getRealStatus, 2) == OK
    both_step(pair, 0.01)


def test_calls_in_the_wrong_phase(slave) -> None:
    fmu, compiled = slave.fmu, is_compiled(slave)
    fmu.reset()
    assert slave.status_of(fmu.doStep, 0.0, 1.0) != OK
    assert "before initialisation" in slave.log[-1][1]
    assert slave.start() == OK
    slave.status_of(fmu.enterInitializationMode)
    assert slave.status == variables.Status.BAD_CALL
    for kind, name, value in (
        (slave.real, "mass.servo", 0.2),
        (slave.whole, "response", 2),
        (slave.real, "strain[1]", 1.0),
        (slave.real, "response", 1.0),
        (slave.real, "", 1.0),
        ("Boolean", "load_factor", True),
        ("String", "load_factor", "x"),
    ):
        before, call = slave.everything(), getattr(fmu, f"set{kind}")
        assert (slave.status_of(call, [slave.reference.get(name, 999)], [value]) != OK) == compiled
        assert slave.status == variables.Status.BAD_CALL
        assert slave.everything() == before
    if not compiled:
        assert all(math.isnan(fmu.getReal(unknown)[-1]) for unknown in ([999], [49, 50, 51], [0, 999]))
        assert (fmu.getString([0]), list(fmu.getReal([]))) == ([b""], [])
        assert any("fixed parameter" in text for _, text in slave.log)
    assert slave.step(STILL, 0.0, 1.0) == OK
    fmu.terminate()
    assert slave.step(STILL, 1.0, 1.0) != OK
    assert "after termination" in slave.log[-1][1] or compiled
    assert slave.everything()[10] != 0.0
    assert slave.start() == OK
    if compiled:
        fmu.reset()
        assert slave.status_of(fmu.exitInitializationMode) == ERROR


def test_wrong_calls_of_fmi_3_are_refused_and_change_nothing(ours) -> None:
    with closing(Slave(ours("fmi3"))) as wing:
        assert wing.start(anew=False) == OK
        assert wing.step(GOOD, 0.0, 1.0) == OK
        before = wing.everything()
        health, second, tip = ((ctypes.c_uint * 1)(wing.reference["health.z1"] + n) for n in (0, 1, 34))
        values, reached = (ctypes.c_double * 3)(0.1, 0.2, 0.3), ctypes.c_double()
        flags = [ctypes.byref(item) for item in (*(ctypes.c_bool() for _ in range(3)), reached)]
        times = ctypes.c_double(1.0), ctypes.c_double(1.0), ctypes.c_bool(True)
        wing.set({"health.z1": 0.95})
        for name, arguments, status, said in (
            ("SetFloat64", (health, 1, values, 1), DISCARD, "not the number that the variables have"),
            ("GetFloat64", (health, 1, values, 3), DISCARD, "not the number that the variables have"),
            ("GetFloat64", (second, 1, values, 1), ERROR, "value reference 2"),
            ("SetFloat64", (tip, 1, values, 1), DISCARD, ""),
            ("GetInt32", (health, 1, (ctypes.c_int32 * 1)(), 1), DISCARD, ""),
            ("EnterEventMode", (), DISCARD, ""),
            (
                "DoStep",
                (*times, *flags),
                DISCARD,
                "health[1] = 0.94999999999999996 lies outside its range 0 to 0.8",
            ),
        ):
            assert int(getattr(wing.fmu.dll, f"fmi3{name}")(wing.fmu.component, *arguments)) == status
            assert said in wing.log[-1][1]
        assert reached.value == 1.0
        assert wing.everything()[RESULTS] == before[RESULTS]
        assert wing.read([51]) == [1.0]
        callbacks = fmi3LogMessageCallback(wing.take), fmi3IntermediateUpdateCallback()
        for token, path in (("{wrong}", b"x"), (wing.fmu.guid, b"/nowhere/")):
            words = (b"wing", token.encode(), path, False, False, False, False, None, 0, None)
            assert not wing.fmu.dll.fmi3InstantiateCoSimulation(*words, *callbacks)
        assert "/nowhere//reduced_model.bin" in wing.log[-1][1]


@pytest.mark.parametrize(
    ("name", "value", "right"),
    [("mass.servo", 9.0, 0.17), ("damping.alpha", math.nan, 0.0), ("response", 3, 1)],
)
def test_parameters_that_are_refused_stop_the_start(slave, name, value, right) -> None:
    key = name.replace(".", "__")
    slave.start(**{key: value})
    assert slave.status in (variables.Status.OUTSIDE_RANGE, variables.Status.NOT_FINITE)
    assert slave.log[-1][1].startswith(name)
    assert slave.step(STILL, 0.0, 1.0) != OK
    assert slave.start(anew=False, **{key: right}) == OK
    assert slave.step(STILL, 0.0, 1.0) == OK


@pytest.mark.parametrize("kind", ["python", "compiled"])
def test_a_computation_that_fails_is_a_refusal(compiler, model, tmp_path, kind, monkeypatch) -> None:
    """A model that is not positive definite within its own validity box: nothing changes, nothing crashes."""
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
        assert one.status == variables.Status.INTERNAL
        assert "not positive definite" in one.log[-1][1]
        assert one.everything()[RESULTS] == before[RESULTS]
        patch.undo()
        assert one.step([1.0, 0.2, 0.0, 0.0], 1.0, 1.0) == OK


# ---------------------------------------------------------------------- state and instances


def test_states_of_something_else_are_refused(slave, ours) -> None:
    compiled = is_compiled(slave)
    foreign = []
    for name in ("python" if compiled else "compiled", "compiled_regions" if compiled else "regions"):
        with closing(Slave(ours(name))) as other:
            other.start()
            foreign.append(other.saved())
    assert slave.start(response=2) == OK
    slave.set({"tip_force": 3.0})  # and not yet stepped with
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
        assert slave.status == variables.Status.BAD_STATE
        assert "was not restored" in slave.log[-1][1]
    assert slave.everything()[:36] == before[:36]
    assert slave.step(STILL, 0.0, 1.0) == OK
    assert slave.restore(state) == OK
    assert slave.everything() == before


def test_two_instances_of_one_library_in_threads_give_what_each_gives_alone(ours) -> None:
    def flown(one: Slave, seed: int) -> bytes:
        return random_flight(one, seed, 2, steps=300).tobytes()

    path = ours("compiled")
    with closing(Slave(path)) as first, closing(Slave(path, like=first)) as twin:
        alone = [flown(one, seed) for seed, one in enumerate((first, twin))]
        with ThreadPoolExecutor(2) as threads:
            assert list(threads.map(flown, (first, twin), (0, 1))) == alone
        assert alone[0] != alone[1]
