"""What runs inside our FMUs, called as FMI says.

There are FMUs in Python and compiled ones, of FMI 2 and of FMI 3. All have the same phases,
refusals that change nothing, lazy outputs and serialised state, and all give the same numbers.
"""

import ctypes
import math
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
from fmpy.fmi3 import fmi3IntermediateUpdateCallback, fmi3LogMessageCallback
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from fmu_asset.packing.structure_fmu import build_fmu
from fmu_asset.slaves.variables import Status
from tests.fmu_asset.ours import OurFmus
from tests.fmu_asset.slaves.flights import assert_same_numbers, fly_at_random
from tests.fmu_asset.slaves.slave import DISCARD, ERROR, OK, Slave

RESULTS = slice(10, None)
"""Places of the results in `everything()` of a wing, behind inputs and parameters."""
GOOD_INPUTS = [2.0, 0.1, 0.2, 1.0]
"""Load factor, health of both regions, force at the tip."""
LEVEL_FLIGHT = [1.0, 0.0, 0.0, 0.0]


@dataclass(frozen=True)
class Pair:
    """Two instances of one kind."""

    first: Slave
    twin: Slave


@pytest.fixture(scope="module", params=["python", "compiled", "fmi3"])
def pair(request: pytest.FixtureRequest, ours: OurFmus) -> Iterator[Pair]:
    """Every test starts both instances anew."""
    path = ours(request.param)
    with closing(Slave(path)) as first, closing(Slave(path)) as twin:
        yield Pair(first, twin)


@pytest.fixture
def slave(pair: Pair) -> Slave:
    return pair.first


@pytest.fixture(scope="module")
def python_slave(ours: OurFmus) -> Iterator[Slave]:
    with closing(Slave(ours("python"))) as slave:
        yield slave


@pytest.fixture(scope="module", params=["compiled", "fmi3"])
def compiled_slave(request: pytest.FixtureRequest, ours: OurFmus) -> Iterator[Slave]:
    with closing(Slave(ours(request.param))) as slave:
        yield slave


def is_compiled(slave: Slave) -> bool:
    return slave.description.path.stem != "python"


# ---------------------------------------------------------------------- the same numbers


@dataclass(frozen=True)
class Response:
    """A value of the parameter `response`, and damping as `draw_parameters` has it."""

    number: int
    damping: str = ""


RESPONSES = {
    "steady": Response(1),
    "transient": Response(2),
    "overdamped": Response(2, "over"),
    "undamped": Response(2, "none"),
}


@dataclass(frozen=True)
class Flights:
    """All real variables of six flights at random, and their names."""

    names: list[str]
    rows: list[NDArray[np.float64]]


@pytest.fixture(scope="module")
def fly_six_times(ours: OurFmus) -> Callable[[str, str], Flights]:
    """Fly an FMU with a response, once for all tests that ask for it."""

    @cache
    def fly(name: str, response: str) -> Flights:
        number = RESPONSES[response].number
        damping = RESPONSES[response].damping
        with closing(Slave(ours(name))) as slave:
            rows = [fly_at_random(slave, seed, number, damping) for seed in range(6)]
            return Flights(slave.names, rows)

    return fly


@pytest.mark.parametrize("response", RESPONSES)
@pytest.mark.parametrize(
    ("compiled_name", "python_name"),
    [("compiled", "python"), ("fmi3", "python"), ("compiled_beam", "beam")],
)
def test_compiled_fmus_give_the_numbers_of_the_one_in_python(
    fly_six_times, compiled_name, python_name, response
):
    """Strains, displacements, accelerations, bounds, frequencies, damping ratios."""
    compiled = fly_six_times(compiled_name, response)
    python = fly_six_times(python_name, response)

    for compiled_rows, python_rows in zip(compiled.rows, python.rows, strict=True):
        assert_same_numbers(
            python.names, compiled_rows, python_rows, so_far=python_name == "python"
        )


@pytest.mark.parametrize("response", RESPONSES)
def test_a_beam_has_accelerations_unless_its_response_is_steady(fly_six_times, response):
    beam = fly_six_times("compiled_beam", response)
    column = beam.names.index("acceleration.shake")

    for rows in beam.rows:
        _, *accelerations = rows[:, column]
        assert (np.abs(accelerations).max() > 0.0) == (response != "steady")


def beam_with_close_modes(model):
    """Return a beam with a double mode, two modes 1e-7 apart and two 1e-3, whatever its loss."""
    size = model.modal_load.shape[1]
    term_count = len(model.modal_stiffness)
    random = np.random.default_rng(5)
    rotation, _ = np.linalg.qr(random.normal(size=(size, size)))
    squares = 1e6 * np.arange(1.0, size + 1.0) ** 2
    squares[2] = squares[1]
    squares[4] = squares[3] * (1.0 + 1e-7)
    squares[6] = squares[5] * 1.001
    stiffness = (rotation * squares) @ rotation.T
    masses = np.zeros_like(model.modal_mass)
    masses[0] = np.eye(size)
    return replace(
        model,
        modal_stiffness=np.multiply.outer(np.full(term_count, 1.0 / term_count), stiffness),
        modal_mass=masses,
        cross_mass=np.zeros_like(model.cross_mass),
    )


def test_modes_that_coincide_are_those_in_python(compiler, ours, tmp_path):
    """Motion and frequencies agree to 1e-9."""
    model = beam_with_close_modes(ours.model("beam"))
    compiled_path = build_fmu(model, tmp_path / "compiled.fmu", kind="compiled").path
    python_path = build_fmu(model, tmp_path / "python.fmu").path

    with closing(Slave(compiled_path)) as compiled, closing(Slave(python_path)) as python:
        for seed in range(3):
            compiled_rows = fly_at_random(compiled, seed, 2)
            python_rows = fly_at_random(python, seed, 2)

            scale = np.maximum(np.abs(python_rows).max(axis=0), 1e-300)
            error = np.abs(compiled_rows - python_rows).max(axis=0)
            assert (error <= 1e-9 * scale).all()


# ---------------------------------------------------------------------- initialisation


def initialise(slave, response, load_factors, inputs):
    """Set load factors one after another while initialising, and read everything after each."""
    slave.initialising(3.0)
    slave.choose(response)
    values = []
    for load_factor in load_factors:
        slave.set(inputs | {"load_factor": load_factor, "health.z1": 0.4})
        values = slave.everything()
    assert slave.status_of(slave.fmu.exitInitializationMode) == OK
    return values


@pytest.fixture(scope="module", params=["python", "compiled", "fmi3", "sensing"])
def initialised_kind(request, ours):
    """The path of a kind, and what its inputs need."""
    inputs = {"effect.coupling.active": 1.0} if request.param == "sensing" else {}
    return ours(request.param), inputs


@pytest.mark.parametrize("response", [1, 2])
def test_what_is_read_while_initialising_is_that_of_the_start(initialised_kind, response):
    path, inputs = initialised_kind

    with closing(Slave(path)) as slave:
        while_initialising = initialise(slave, response, (2.5, 3.5), inputs)

        assert slave.everything() == while_initialising


@pytest.mark.parametrize("response", [1, 2])
def test_values_that_were_set_before_the_last_ones_leave_no_trace(initialised_kind, response):
    path, inputs = initialised_kind

    after_step = []
    for load_factors in ((2.5, 3.5), (3.5,)):
        with closing(Slave(path)) as slave:
            initialise(slave, response, load_factors, inputs)
            assert slave.status_of(slave.fmu.doStep, 3.0, 0.5) == OK
            after_step.append(slave.everything())

    assert after_step[0] == after_step[1]


# ---------------------------------------------------------------------- refused steps


@dataclass(frozen=True)
class RefusedStep:
    """A step that is refused with Discard.

    Attributes
    ----------
    status : Status
        The output `status` after it.
    place : int or None
        The input that is wrong, if one is.
    value : float
        What it is set to.
    time, length : float
        The communication point and the length of the step [s].
    """

    status: Status
    place: int | None = None
    value: float = 0.0
    time: float = 0.01
    length: float = 0.01

    @property
    def inputs(self) -> list[float]:
        inputs = list(GOOD_INPUTS)
        if self.place is not None:
            inputs[self.place] = self.value
        return inputs

    def sentence(self, slave: Slave) -> str:
        """Return what the log must say: the wrong input, or where the instance stands."""
        if self.place is not None:
            health = "health[{}]" if slave.three else "health.z{}"
            names = ("load_factor", health.format(1), health.format(2), "tip_force")
            return names[self.place]
        return "stands at t = 0.01" if self.time in (0.0, 0.5) else ""


PLACES = st.integers(0, 3)
FAR_VALUES = st.floats(130.0, 1e300).map(lambda value: value if value % 2.0 else -value)
WRONG_INPUTS = st.one_of(
    st.builds(
        RefusedStep,
        status=st.just(Status.NOT_FINITE),
        place=PLACES,
        value=st.sampled_from([math.nan, math.inf, -math.inf]),
    ),
    st.builds(RefusedStep, status=st.just(Status.OUTSIDE_RANGE), place=PLACES, value=FAR_VALUES),
)
WRONG_TIMES = st.sampled_from(
    [RefusedStep(Status.BAD_STEP, length=length) for length in (0.0, -1.0, math.nan, math.inf)]
    + [RefusedStep(Status.BAD_STEP, time=time) for time in (0.0, 0.5, math.nan)]
)


def step_both(pair: Pair, time: float) -> None:
    """Make a good step with both instances, and compare them."""
    for slave in (pair.first, pair.twin):
        assert slave.step(GOOD_INPUTS, time, 0.01) == OK
        assert slave.status == Status.OK
    assert pair.first.everything() == pair.twin.everything()


@settings(deadline=None)
@given(WRONG_INPUTS | WRONG_TIMES, st.sampled_from([1, 2]))
def test_refused_steps_change_nothing(pair, refused_step, response):
    """They are refused with Discard; the other instance never makes them."""
    slave = pair.first
    for instance in (pair.first, pair.twin):
        instance.start(response=response, initial_tip_displacement=0.01)
    step_both(pair, 0.0)
    results_before = slave.everything()[RESULTS]

    status = slave.step(refused_step.inputs, refused_step.time, refused_step.length)

    assert (status, slave.status) == (DISCARD, refused_step.status)
    assert_logged(slave, DISCARD, refused_step.sentence(slave))
    assert slave.everything()[RESULTS] == results_before == pair.twin.everything()[RESULTS]
    if not slave.three and refused_step.place is not None:
        assert slave.status_of(slave.fmu.getRealStatus, 2) == OK
    step_both(pair, 0.01)


def assert_logged(slave: Slave, status: int, sentence: str) -> None:
    """Assert that the last message has a status and holds a sentence."""
    logged_status, text = slave.log[-1]
    assert logged_status == status
    assert sentence in text


# ---------------------------------------------------------------------- calls in the wrong phase


def test_a_step_before_initialisation_is_refused(slave):
    slave.fmu.reset()

    assert slave.status_of(slave.fmu.doStep, 0.0, 1.0) != OK
    assert "before initialisation" in slave.log[-1][1]


def test_a_second_initialisation_is_refused(slave):
    assert slave.start() == OK

    slave.status_of(slave.fmu.enterInitializationMode)

    assert slave.status == Status.BAD_CALL


WRONG_SETS = {
    "a parameter": ("real", "mass.servo", 0.2),
    "a structural parameter": ("whole", "response", 2),
    "an output": ("real", "strain[1]", 1.0),
    "another type": ("real", "response", 1.0),
    "an unknown variable": ("real", "", 1.0),
    "a Boolean": ("Boolean", "load_factor", True),
    "a text": ("String", "load_factor", "x"),
}


@pytest.fixture
def initialised(slave: Slave) -> Slave:
    """An instance that was initialised with the values of its description."""
    assert slave.start() == OK
    return slave


@pytest.mark.parametrize("case", WRONG_SETS)
def test_a_variable_that_cannot_be_set_in_flight_is_refused(initialised, case):
    """That in Python returns OK all the same, because pythonfmu has no other status."""
    kind, name, value = WRONG_SETS[case]
    type_name = {"real": initialised.real, "whole": initialised.whole}.get(kind, kind)
    before = initialised.everything()

    setter = getattr(initialised.fmu, f"set{type_name}")
    status = initialised.status_of(setter, [initialised.reference.get(name, 999)], [value])

    assert (status != OK) == is_compiled(initialised)
    assert initialised.status == Status.BAD_CALL
    assert initialised.everything() == before


def test_a_fixed_parameter_is_named_in_the_log_of_python(python_slave):
    assert python_slave.start() == OK

    python_slave.fmu.setReal([python_slave.reference["mass.servo"]], [0.2])

    assert any("fixed parameter" in text for _, text in python_slave.log)


@pytest.mark.parametrize("references", [[999], [49, 50, 51], [0, 999]])
def test_unknown_variables_in_python_are_not_a_number(python_slave, references):
    assert python_slave.start() == OK

    assert math.isnan(python_slave.fmu.getReal(references)[-1])


def test_no_variables_in_python_have_no_values(python_slave):

    assert python_slave.fmu.getString([0]) == [b""]
    assert list(python_slave.fmu.getReal([])) == []


@pytest.fixture
def terminated(slave) -> Slave:
    """An instance that was terminated after a step."""
    assert slave.start() == OK
    assert slave.step(LEVEL_FLIGHT, 0.0, 1.0) == OK
    slave.fmu.terminate()
    return slave


def test_a_step_after_termination_is_refused(terminated):
    assert terminated.step(LEVEL_FLIGHT, 1.0, 1.0) != OK
    assert "after termination" in terminated.log[-1][1] or is_compiled(terminated)


def test_results_can_be_read_after_termination(terminated):
    first_result = terminated.everything()[RESULTS.start]

    assert first_result != 0.0


def test_an_instance_starts_again_after_termination(terminated):
    assert terminated.start() == OK


def test_an_initialisation_that_was_not_entered_cannot_be_left(compiled_slave):
    compiled_slave.fmu.reset()

    assert compiled_slave.status_of(compiled_slave.fmu.exitInitializationMode) == ERROR


# ---------------------------------------------------------------------- calls of FMI 3 itself


@dataclass(frozen=True)
class Fmi3Call:
    """A wrong call, its status, and what the log says."""

    name: str
    arguments: tuple[object, ...]
    status: int
    sentence: str


@pytest.fixture(scope="module")
def flying_fmi3(ours) -> Iterator[Slave]:
    """A wing of FMI 3 after one step, with a loss of stiffness that the next step would refuse."""
    with closing(Slave(ours("fmi3"))) as wing:
        assert wing.start(anew=False) == OK
        assert wing.step(GOOD_INPUTS, 0.0, 1.0) == OK
        wing.set({"health.z1": 0.95})
        yield wing


REACHED_TIME = ctypes.c_double()


def wrong_calls(health_reference: int) -> list[Fmi3Call]:
    """Return calls of functions of FMI 3 with wrong numbers of values, types and modes."""

    def reference(offset: int) -> object:
        return (ctypes.c_uint * 1)(health_reference + offset)

    health = reference(0)
    second_element = reference(1)
    tip_displacement = reference(34)
    values = (ctypes.c_double * 3)(0.1, 0.2, 0.3)
    whole_values = (ctypes.c_int32 * 1)()
    times = (ctypes.c_double(1.0), ctypes.c_double(1.0), ctypes.c_bool(True))
    flags = [ctypes.byref(ctypes.c_bool()) for _ in range(3)]
    step_arguments = (*times, *flags, ctypes.byref(REACHED_TIME))
    wrong_count = "not the number that the variables have"
    outside = "health[1] = 0.94999999999999996 lies outside its range 0 to 0.8"
    return [
        Fmi3Call("SetFloat64", (health, 1, values, 1), DISCARD, wrong_count),
        Fmi3Call("GetFloat64", (health, 1, values, 3), DISCARD, wrong_count),
        Fmi3Call("GetFloat64", (second_element, 1, values, 1), ERROR, "value reference 2"),
        Fmi3Call("SetFloat64", (tip_displacement, 1, values, 1), DISCARD, ""),
        Fmi3Call("GetInt32", (health, 1, whole_values, 1), DISCARD, ""),
        Fmi3Call("EnterEventMode", (), DISCARD, ""),
        Fmi3Call("DoStep", step_arguments, DISCARD, outside),
    ]


def test_wrong_calls_of_fmi_3_are_refused_and_change_nothing(flying_fmi3):
    results_before = flying_fmi3.everything()[RESULTS]

    for call in wrong_calls(flying_fmi3.reference["health.z1"]):
        function = getattr(flying_fmi3.fmu.dll, f"fmi3{call.name}")
        assert function(flying_fmi3.fmu.component, *call.arguments) == call.status, call.name
        assert call.sentence in flying_fmi3.log[-1][1]

    assert flying_fmi3.everything()[RESULTS] == results_before


def test_the_time_stays_at_a_refused_step_of_fmi_3(flying_fmi3):
    *_, refused_step = wrong_calls(flying_fmi3.reference["health.z1"])
    flying_fmi3.fmu.dll.fmi3DoStep(flying_fmi3.fmu.component, *refused_step.arguments)

    assert REACHED_TIME.value == 1.0
    assert flying_fmi3.read([51]) == [1.0]


@pytest.mark.parametrize("fault", ["another token", "a missing folder"])
def test_a_wrong_instantiation_of_fmi_3_is_refused(flying_fmi3, fault):
    token = "{wrong}" if fault == "another token" else flying_fmi3.fmu.guid
    folder = b"x" if fault == "another token" else b"/nowhere/"
    callbacks = fmi3LogMessageCallback(flying_fmi3.take), fmi3IntermediateUpdateCallback()
    flags = (False, False, False, False)

    instance = flying_fmi3.fmu.dll.fmi3InstantiateCoSimulation(
        b"wing", token.encode(), folder, *flags, None, 0, None, *callbacks
    )

    assert not instance
    if fault == "a missing folder":
        assert "/nowhere//reduced_model.bin" in flying_fmi3.log[-1][1]


# ---------------------------------------------------------------------- refused starts and failures


@pytest.mark.parametrize(
    ("name", "wrong", "right"),
    [("mass.servo", 9.0, 0.17), ("damping.alpha", math.nan, 0.0), ("response", 3, 1)],
)
def test_parameters_that_are_refused_stop_the_start(slave, name, wrong, right):
    key = name.replace(".", "__")

    slave.start(**{key: wrong})

    assert slave.status in (Status.OUTSIDE_RANGE, Status.NOT_FINITE)
    assert slave.log[-1][1].startswith(name)
    assert slave.step(LEVEL_FLIGHT, 0.0, 1.0) != OK
    assert_starts_with(slave, key, right)


def assert_starts_with(slave: Slave, key: str, value: float) -> None:
    """Assert that the start is made up for once the parameter is right."""
    assert slave.start(anew=False, **{key: value}) == OK
    assert slave.step(LEVEL_FLIGHT, 0.0, 1.0) == OK


@pytest.fixture(params=["python", "compiled"])
def broken(request, compiler, model, tmp_path, monkeypatch) -> Iterator[Slave]:
    """A model that is not positive definite within its own validity box, after one good step."""
    box = model.validity_box.copy()
    box[1] = (0.0, 5.0)
    wider = replace(model, validity_box=box)
    path = build_fmu(wider, tmp_path / "broken.fmu", kind=request.param).path
    with closing(Slave(path)) as slave:
        assert slave.start() == OK
        assert slave.step([1.0, 0.1, 0.0, 0.0], 0.0, 1.0) == OK
        yield slave


def fail_in_python(slave: Slave, patch: pytest.MonkeyPatch) -> None:
    """Let the static response fail, which Python solves without a positive definite matrix, too."""

    def fail(*_: object) -> None:
        raise np.linalg.LinAlgError("not positive definite")

    if not is_compiled_path(slave):
        module = sys.modules[f"{slave.description.model_identifier}_runtime.fe.reduced"]
        patch.setattr(module.ReducedModel, "static_response", fail)


def is_compiled_path(slave: Slave) -> bool:
    """Return whether the sources of an FMU are compiled, which have no module here."""
    return f"{slave.description.model_identifier}_runtime.fe.reduced" not in sys.modules


def test_a_computation_that_fails_is_a_refusal(broken, monkeypatch):
    """Nothing changes, nothing crashes."""
    results_before = broken.everything()[RESULTS]
    with monkeypatch.context() as patch:
        fail_in_python(broken, patch)
        status = broken.step([1.0, 4.0, 0.0, 0.0], 1.0, 1.0)

        assert (status, broken.status) == (DISCARD, Status.INTERNAL)
        assert "not positive definite" in broken.log[-1][1]
        assert broken.everything()[RESULTS] == results_before


def test_steps_go_on_after_a_computation_that_failed(broken, monkeypatch):
    with monkeypatch.context() as patch:
        fail_in_python(broken, patch)
        broken.step([1.0, 4.0, 0.0, 0.0], 1.0, 1.0)

    assert broken.step([1.0, 0.2, 0.0, 0.0], 1.0, 1.0) == OK


# ---------------------------------------------------------------------- state and instances


@pytest.fixture
def started(slave: Slave) -> Slave:
    """An instance whose input was set and not yet stepped with."""
    assert slave.start(response=2) == OK
    slave.set({"tip_force": 3.0})
    return slave


def state_of(path) -> bytes:
    """Return the serialised state of another FMU."""
    with closing(Slave(path)) as other:
        other.start()
        return other.saved()


def wrong_states(slave: Slave, ours: OurFmus) -> list[bytes]:
    """Return states that are no state of an instance, made from its own state and of other FMUs."""
    state = slave.saved()
    states = [b"", b"x" * 500, state[:-8]]
    if not is_compiled(slave):
        return [*states, state_of(ours("compiled")), state_of(ours("regions"))]
    other_tag = state[:8] + bytes([state[8] ^ 1]) + state[9:]
    other_count = state[:24] + b"\xff\xff\xff\xff" + state[28:]
    not_finite = state[:-8] + np.float64(math.nan).tobytes()
    too_short = state[:24] + (20).to_bytes(4, "little") + state[28 : 28 + 160]
    states += [state + b"12345678", other_tag, other_count, not_finite, too_short]
    return [*states, state_of(ours("python")), state_of(ours("compiled_regions"))]


def test_states_of_something_else_are_refused(started, ours):
    for state in wrong_states(started, ours):
        assert started.restore(state) == ERROR or not is_compiled(started)
        assert started.status == Status.BAD_STATE
        assert "was not restored" in started.log[-1][1]


def test_an_instance_goes_on_after_states_of_something_else(started, ours):
    before = started.everything()
    for state in wrong_states(started, ours):
        started.restore(state)

    real_count = 36  # results behind are not evaluated once a state was refused
    assert started.everything()[:real_count] == before[:real_count]
    assert started.step(LEVEL_FLIGHT, 0.0, 1.0) == OK


def test_a_state_is_restored_with_inputs_that_were_not_yet_stepped_with(started):
    state = started.saved()
    before = started.everything()
    assert started.step(LEVEL_FLIGHT, 0.0, 1.0) == OK

    assert started.restore(state) == OK

    assert started.everything() == before


def test_two_instances_of_one_library_in_threads_give_what_each_gives_alone(ours):
    def fly(slave: Slave, seed: int) -> bytes:
        return fly_at_random(slave, seed, 2, steps=300).tobytes()

    path = ours("compiled")
    with closing(Slave(path)) as first, closing(Slave(path, like=first)) as twin:
        alone = [fly(first, 0), fly(twin, 1)]
        with ThreadPoolExecutor(2) as threads:
            together = list(threads.map(fly, (first, twin), (0, 1)))

    assert together == alone
    assert alone[0] != alone[1]
