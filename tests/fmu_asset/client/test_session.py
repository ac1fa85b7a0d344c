"""What is particular in a session: refusals, the midst of a run, inputs in lines, starts, copies.

A start is a start: a reset that does nothing is not believed.
"""

import logging
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from fmu_asset import errors
from fmu_asset.checks.fmu_check import check_fmu
from fmu_asset.client import instance_host
from fmu_asset.client.session import FmiAsset
from tests.fmu_asset.client.kinds import (
    BINDINGS,
    HOSTILE,
    INPUTS,
    KINDS,
    SPRING_BINDING,
    WING_BINDING,
    bounces,
)
from tests.fmu_asset.making import (
    archive_of,
    bound,
    changed,
    limit_call_without_answer,
    members,
)

# ---------------------------------------------------------------------- the wing


@pytest.mark.parametrize(("name", "changes", "tables", "kind", "sentence"), INPUTS["unfit"])
def test_what_does_not_fit_the_fmu_is_one_sentence(
    fmu, foreign_fmu, name, changes, tables, kind, sentence
):
    path = fmu if name == "uav_wing" else foreign_fmu.changed(name, "other", *changes)

    with pytest.raises(getattr(errors, kind), match=sentence):
        FmiAsset(path, changed(BINDINGS[name], **tables))


@pytest.mark.parametrize(("parameters", "kind", "sentence"), INPUTS["parameters"])
def test_parameters_that_do_not_fit_are_one_sentence(fmu, parameters, kind, sentence):
    with pytest.raises(getattr(errors, kind), match=sentence):
        FmiAsset(fmu, WING_BINDING, parameters=parameters)


# ---------------------------------------------------------------------- in the midst of a run

NOT_A_NUMBER = 1
SLEEP = 2
RAISE = 4
DISCARD = 5
"""What the spring does at the input `misbehaviour`."""
PUSH = np.linspace(0.0, 1.0, 10)


@pytest.fixture(scope="module")
def well_behaved(spring_mass) -> Iterator[FmiAsset]:
    """A spring that makes the same steps one by one and does not misbehave."""
    with FmiAsset(spring_mass, SPRING_BINDING, isolated=False) as asset:
        yield asset


@pytest.fixture(scope="module", params=[True, False], ids=["worker", "in process"])
def misbehaving(request, spring_mass) -> Iterator[FmiAsset]:
    """A spring whose input may let it misbehave; each test resets it."""
    with FmiAsset(spring_mass, SPRING_BINDING, isolated=request.param) as asset:
        yield asset


@pytest.mark.parametrize("bad_step", [0, 1, 9])
@pytest.mark.parametrize(("behaviour", "kind", "sentence"), INPUTS["wrong"])
def test_a_step_that_goes_wrong_ends_a_run_there(
    misbehaving, well_behaved, behaviour, kind, sentence, bad_step, monkeypatch
):
    """Whatever blocks it is made in; as single steps end there."""
    three_steps = 3 * 6 * 8
    monkeypatch.setattr(instance_host, "_BLOCK_BYTES", three_steps)
    misbehaviour = np.where(np.arange(10) == bad_step, behaviour, 0)
    is_made = behaviour == NOT_A_NUMBER  # the step, before its result is refused
    for asset in (misbehaving, well_behaved):
        asset.reset()
        asset.step({"push": 0.3}, load={"misbehaviour": 0})
    for push in PUSH[:bad_step]:
        well_behaved.step({"push": push})

    with pytest.raises(getattr(errors, kind), match=sentence):
        misbehaving.simulate({"push": PUSH}, load={"misbehaviour": misbehaviour})

    assert misbehaving.step_index == bad_step + (2 if is_made else 1)
    if behaviour == DISCARD:
        assert_same_position(misbehaving, well_behaved)
    elif behaviour == RAISE:
        with pytest.raises(errors.FmuWorkerError, match="reset the asset"):
            misbehaving.simulate(steps=2)


def assert_same_position(asset: FmiAsset, other: FmiAsset) -> None:
    """Assert that two assets have the same state, and make the same next step."""
    assert asset.save_state() == other.save_state()
    assert asset.step().values.tobytes() == other.step().values.tobytes()


def test_a_step_that_hangs_in_a_run_ends_the_worker(spring_mass, monkeypatch):
    misbehaviour = np.where(np.arange(500) == 300, SLEEP, 0)
    limit_call_without_answer(monkeypatch, "run")

    with FmiAsset(spring_mass, SPRING_BINDING) as asset:
        sentence = r"step \d+ from .* took longer than 2 s for a step"
        with pytest.raises(errors.FmuTimeoutError, match=sentence):
            asset.simulate(load={"misbehaviour": misbehaviour})

        assert asset.step_index <= 300


# ---------------------------------------------------------------------- histories


@pytest.fixture
def spring(spring_mass) -> Iterator[FmiAsset]:
    with FmiAsset(spring_mass, SPRING_BINDING, isolated=False) as asset:
        yield asset


@pytest.mark.parametrize(("inputs", "sentence"), INPUTS["histories"])
def test_histories_that_do_not_fit_are_refused(spring, inputs, sentence):
    with pytest.raises(ValueError, match=sentence):
        spring.simulate(**inputs)

    assert spring.step_index == 0
    assert spring.simulate(steps=1).extra["steps"].tolist() == [1.0]


@pytest.mark.parametrize("name", ["reset", "renew"])
def test_an_unknown_role_of_inputs_is_refused(spring, name):
    start_again = getattr(spring, name)

    with pytest.raises(TypeError, match="control, health, load, port, but 'loads' was given"):
        start_again(loads={})


@pytest.fixture
def array(foreign_fmu) -> Iterator[FmiAsset]:
    """An FMU of FMI 3 with an array of three values as input."""
    with FmiAsset(foreign_fmu("array3"), BINDINGS["array3_whole"], isolated=False) as asset:
        yield asset


def test_a_history_of_an_array_needs_its_shape(array):
    sentence = r"load\.u must be 3 values, .* the shape \(12, 2\)"

    with pytest.raises(errors.FmuInputError, match=sentence):
        array.simulate(load={"u": np.ones((12, 2))})


def test_one_array_holds_for_all_steps(array):
    history = array.simulate(load={"u": [1.0, -2.0, 3.0]}, steps=2)

    np.testing.assert_allclose(history.values, [[6e-3, 12e-3], [12e-3, 24e-3]], rtol=1e-12)


# ---------------------------------------------------------------------- inputs in straight lines

LINES = KINDS["lines"].binding
LINE = [0.5, 2.0, -1.0, -1.0, 3.0, 3.5, 0.0]


@pytest.fixture(params=[("serialised", True), ("replay", False)], ids=["serialised", "replay"])
def follower(request, foreign_fmu) -> Iterator[FmiAsset]:
    """An input in straight lines, after three steps and a jump to 3."""
    state, isolated = request.param
    binding = changed(LINES, header={"state": state})
    with FmiAsset(foreign_fmu("follow2"), binding, isolated=isolated) as asset:
        asset.simulate({"u": LINE[:3]})
        asset.hold({"u": 3.0})
        yield asset


def test_an_input_may_jump_between_two_steps(follower):
    history = follower.simulate({"u": LINE[3:]})

    assert history.extra["seen"][0] == 3.0


def test_an_input_cannot_jump_out_of_its_range(follower):
    with pytest.raises(errors.FmuInputError, match="outside the range"):
        follower.hold({"u": 1000.0})


def test_an_input_may_jump_before_the_state_is_kept(follower):
    """A worker is told the lines with each request."""
    state = follower.save_state()
    history = follower.simulate({"u": LINE[3:]})

    with follower.sibling() as other:
        other.restore_state(state)
        other_history = other.simulate({"u": LINE[3:]})

    assert other_history.values.tobytes() == history.values.tobytes()


# ---------------------------------------------------------------------- starts


@dataclass(frozen=True)
class Flights:
    """How many steps there are in each flight, and whether they are made in one go."""

    lengths: tuple[int, ...]
    in_one_go: bool = False

    def fly(self, asset: FmiAsset, push: float, steps: int) -> list[float]:
        """Reset an asset, and return what steps show."""
        asset.reset()
        if self.in_one_go:
            (values,) = asset.simulate({"u": push}, steps=steps).values.T
            return values.tolist()
        return [asset.step({"u": push}).values[0] for _ in range(steps)]


FLIGHTS = {
    "short first": Flights((3, 7, 7)),
    "in one go": Flights((4, 1, 7, 1), in_one_go=True),
    "single steps": Flights((1,) * 7),
}
CLOCKS = {
    "instance": ("INSTANCE_CLOCK", True, 1),
    "in process": ("INSTANCE_CLOCK", False, 1),
    "process": ("process_clock", True, 2),
}
"""What the clock belongs to, whether the FMU is isolated, and how many warnings there are."""


@pytest.mark.parametrize("clock", CLOCKS)
@pytest.mark.parametrize("flights", FLIGHTS)
def test_a_hidden_clock_shows_at_no_start(foreign_fmu, clock, flights, caplog):
    """The clock adds 1 from its sixth step on.

    At the first reset that is looked at, nothing is to be seen.
    """
    clock_name, isolated, warning_count = CLOCKS[clock]
    course = FLIGHTS[flights]
    # a warning comes once for a file, so that each case has a file of its own
    case = f"CASE={sum(course.lengths)}{len(course.lengths)}{isolated}{course.in_one_go}"
    fmu = foreign_fmu("hostile2", f"CLOCK={clock_name}", "STAYS_LOADED", case)

    with caplog.at_level(logging.WARNING), FmiAsset(fmu, HOSTILE, isolated=isolated) as asset:
        first_values = [course.fly(asset, 0.1, length)[0] for length in course.lengths]
        # A start whose first step is another one has those that are known for its proof.
        course.fly(asset, 0.3, 7)
        values = course.fly(asset, 0.3, 7)
        reset_works = asset.reset_trial.works

    assert first_values == [0.1] * len(course.lengths)
    np.testing.assert_allclose(values, [0.3, 0.6, 0.9, 1.2, 1.5, 2.8, 4.1], rtol=1e-12)
    assert reset_works is False
    assert_warned(caplog.messages, warning_count)


def assert_warned(messages: list[str], count: int) -> None:
    assert "Flights that began by a reset before may be wrong" in messages[0]
    assert len(messages) == count


def test_what_never_starts_alike_is_not_started_in_ever_new_processes(foreign_fmu):
    fmu = foreign_fmu("hostile2", "NOT_DETERMINISTIC", "STAYS_LOADED", "CLOCK=process_clock")
    processes = []

    with FmiAsset(fmu, HOSTILE) as asset:
        for _ in range(11):
            asset.reset()
            asset.step()
            processes.append(asset.worker_process_id)

    assert len(set(processes[7:])) == 1


def test_a_check_names_a_reset_that_does_nothing(foreign_fmu):
    fmu = foreign_fmu("spring2", "RESET_DOES_NOTHING")

    (problem,) = check_fmu(fmu, step_size=0.1).problems

    assert problem.startswith("Its reset returns OK and does not bring it back to its start")


def test_a_negative_zero_after_a_reset_is_the_start(foreign_fmu):
    assert check_fmu(foreign_fmu("hostile2", "NEGATIVE_ZERO_AFTER_RESET")).passed


@pytest.mark.parametrize(
    ("header", "tolerance"),
    [({}, 1e-4), ({"tolerance": 1e-7}, 1e-7)],
    ids=["of the FMU", "of the binding"],
)
def test_the_tolerance_is_that_of_the_fmu_unless_the_binding_says_otherwise(
    foreign_fmu, isolated, header, tolerance
):
    binding = bound(0.1, {"tolerance": ("tolerance", "1")}, header=header)

    with FmiAsset(foreign_fmu("spring2"), binding, isolated=isolated) as asset:
        assert asset.observe().values[0] == tolerance


# ---------------------------------------------------------------------- many instances of one FMU


def count_extracted(scratch: Path) -> int:
    return len(list(scratch.rglob("modelDescription.xml")))


def test_copies_share_the_extracted_fmu_until_the_last_is_closed(foreign_fmu, scratch, isolated):
    with FmiAsset(foreign_fmu("hostile2"), HOSTILE, isolated=isolated) as asset:
        asset.step({"u": 2.0})
        forks = [asset.fork() for _ in range(3)]

    first_fork, *other_forks = forks
    first_fork.close()
    assert count_extracted(scratch) == 1
    assert [fork.step({"u": 1.0}).values[0] for fork in other_forks] == [3.0, 3.0]

    for fork in other_forks:
        fork.close()
    assert not list(scratch.iterdir())


def test_an_asset_is_renewed_in_its_process(foreign_fmu, isolated):
    with FmiAsset(foreign_fmu("hostile2"), HOSTILE, isolated=isolated) as asset:
        asset.step({"u": 2.0})
        process = asset.worker_process_id
        for _ in range(20):
            asset.renew()
            assert asset.step({"u": 3.0}).values[0] == 3.0

        assert asset.worker_process_id == process
    assert not isolated or not (Path("/proc") / str(process)).exists()  # gone at once


def test_siblings_have_parameters_of_their_own(foreign_fmu):
    with (
        FmiAsset(foreign_fmu("lag1"), BINDINGS["lag1"]) as first,
        first.sibling({"gain": 3.0}) as other,
    ):
        values = [asset.step({"speed": 1.0}).values for asset in (first, other)]

    expected = (1.0 - np.exp(-0.3)) * np.array([[2.0], [3.0]])
    np.testing.assert_allclose(values, expected, rtol=1e-12)


# ---------------------------------------------------------------------- errors of others' FMUs


@pytest.fixture
def lag(foreign_fmu, isolated) -> Iterator[FmiAsset]:
    """An FMU of FMI 1, whose state is kept by replay."""
    with FmiAsset(
        foreign_fmu("lag1"), BINDINGS["lag1"], isolated=isolated, parameters={"gain": 3.0}
    ) as asset:
        yield asset


def test_a_parameter_outside_its_range_is_refused_at_a_reset(lag):
    sentence = r"parameter\.gain = 101\.0 lies outside .* 0 to 100"

    with pytest.raises(errors.FmuInputError, match=sentence):
        lag.reset({"gain": 101.0})


def test_an_error_is_the_end_of_an_instance_and_a_state_goes_on(lag):
    values = lag.step({"speed": 2.0}).values
    state = lag.save_state()
    with pytest.raises(errors.FmuInputError, match=r"parameter\.gain"):
        lag.reset({"gain": 101.0})

    with pytest.raises(errors.FmuCallError, match=r"(?s)fmiDoStep returned Error.*saturates"):
        lag.step({"speed": 1500.0})

    lag.restore_state(state)
    np.testing.assert_array_equal(lag.observe().values, values)


def test_a_refusal_between_two_observations_leaves_nothing_to_go_on_from(foreign_fmu, isolated):
    sentence = r"It was step 5\d of the 100 between two observations"

    with FmiAsset(foreign_fmu("fixed2"), BINDINGS["fixed2"], isolated=isolated) as asset:
        asset.step({"u": 3.0})
        state = asset.save_state()
        following = asset.step({"u": -1.0}).values
        with pytest.raises(errors.FmuCallError, match=sentence):
            asset.step({"u": 2e6})

        asset.restore_state(state)
        np.testing.assert_array_equal(asset.step({"u": -1.0}).values, following)


@pytest.mark.parametrize(
    ("offset", "sentence"),
    [(99, "asked to end the simulation in the step"), (98, "returned early")],
)
def test_fmi_3_asks_to_end_or_returns_early(foreign_fmu, isolated, offset, sentence):
    with (
        FmiAsset(foreign_fmu("array3"), BINDINGS["array3"], isolated=isolated) as asset,
        pytest.raises(errors.FmuCallError, match=sentence),
    ):
        asset.step(load={"offset": offset})


def test_a_nominal_of_zero_counts_as_one_and_an_identifier_may_have_a_hyphen(foreign_fmu, tmp_path):
    contents = {
        name.replace("ball2", "ball-2"): text.replace(
            b'modelIdentifier="ball2"', b'modelIdentifier="ball-2"'
        )
        for name, text in members(foreign_fmu("ball2", "NOMINAL=0.0")).items()
    }
    path = archive_of(tmp_path / "ball-2.fmu", contents)

    with FmiAsset(path, BINDINGS["ball2"], isolated=False) as asset:
        history = asset.simulate(steps=8)

    expected = [bounces(0.7, 9.81, time)[:2] for time in history.time]
    np.testing.assert_allclose(history.values * [1e-3, 1.0], expected, rtol=1e-6)


# ---------------------------------------------------------------------- simulations that end

SECOND_BOUNCE = math.sqrt(2.0 / 9.81) * 2.4


@dataclass(frozen=True)
class EndingModel:
    """An FMU that ends its simulation by itself.

    Attributes
    ----------
    output, unit : str
        What is observed.
    step_size : float
    end : float
        When it ends.
    last_value : float
        What is seen at the end.
    """

    output: str
    unit: str
    step_size: float
    end: float
    last_value: float

    @property
    def whole_steps(self) -> int:
        return int(self.end / self.step_size)


ENDING_MODELS = {
    "hostile2": EndingModel("y", "m", 1.0, 2.5, 2.5),
    "ball2": EndingModel("h", "m", 0.1, SECOND_BOUNCE, 0.0),
    "decay1": EndingModel("x", "K", 0.3, 1.0, math.exp(-1.0)),
    "swing3": EndingModel("a", "1", 0.3, 1.0, 1.0),
}
"""Discard and `fmi2Terminated`; events of model exchange in FMI 2, 1 and 3."""


@dataclass(frozen=True)
class EndingAsset:
    """An asset whose FMU ends its simulation; each test resets it."""

    model: EndingModel
    asset: FmiAsset


@pytest.fixture(scope="module", params=[True, False], ids=["worker", "in process"])
def ending_in_worker(request) -> bool:
    return bool(request.param)


@pytest.fixture(scope="module", params=ENDING_MODELS)
def ending(request, foreign_fmu, ending_in_worker) -> Iterator[EndingAsset]:
    model = ENDING_MODELS[request.param]
    roles = {"control": {"u": ("u", "m/s")}} if request.param == "hostile2" else {}
    binding = bound(model.step_size, {"y": (model.output, model.unit)}, **roles)
    path = foreign_fmu(request.param, "ENDS")
    with FmiAsset(path, binding, isolated=ending_in_worker) as asset:
        yield EndingAsset(model, asset)


def test_an_fmu_that_ends_its_simulation_leaves_what_was_simulated(ending):
    model = ending.model
    steps = model.step_size * np.arange(1, model.whole_steps + 1)
    ending.asset.reset()

    history = ending.asset.simulate(steps=50)

    assert f"ended at t = {model.end:g} s" in history.ended
    np.testing.assert_allclose(history.time, [*steps, model.end], rtol=1e-6)
    assert history.values[-1, 0] == pytest.approx(model.last_value, abs=1e-5)


def test_an_fmu_that_has_ended_its_simulation_can_be_reset(ending):
    ending.asset.reset()
    history = ending.asset.simulate(steps=50)
    with pytest.raises(errors.FmuEndedError, match="has ended its simulation at t = "):
        ending.asset.step()

    ending.asset.reset()
    ending.asset.step()
    remaining = ending.asset.simulate(steps=50)

    np.testing.assert_allclose(remaining.time, history.time[1:], rtol=1e-12)


def test_an_fmu_ends_its_simulation_in_single_steps_as_in_a_run(ending):
    asset = ending.asset
    asset.reset()
    (values_of_run,) = asset.simulate(steps=50).values.T
    asset.reset()

    values = [asset.step().values[0] for _ in range(ending.model.whole_steps)]
    sentence = "asked to end the simulation in the step"
    with pytest.raises(errors.FmuEndedError, match=sentence) as caught:
        asset.step()
    values.append(asset.observe().values[0])

    assert values == values_of_run.tolist()
    assert caught.value.time == pytest.approx(ending.model.end, rel=1e-6)


# ---------------------------------------------------------------------- ports


def test_ports_are_sent_and_read(foreign_fmu):
    beam = foreign_fmu.changed("room2", "beam", *INPUTS["beam"])
    steady = 283.15 + 1000.0 / 100.0
    expected = steady + (293.15 - steady) * math.exp(-60.0 * 100.0 / 5e4)

    with FmiAsset(beam, BINDINGS["port_root"]) as asset:
        step = asset.step(port={"p.force": 1.0e6})

        assert step.extra["p.displacement"] == pytest.approx(1e3 * expected)
        assert asset.recorded_units == {"p.displacement": "mm", "p.velocity": "m/s"}


@pytest.fixture
def port_of_arrays(foreign_fmu) -> Iterator[FmiAsset]:
    """A port whose force is elements of an array, and whose displacement is a whole array."""
    in_newton = ('min="-10" max="10"', 'min="-10" max="10" unit="N"')
    fmu = foreign_fmu.changed("array3", "forces", in_newton)
    with FmiAsset(fmu, BINDINGS["port_tip"]) as asset:
        yield asset


def test_elements_of_an_array_go_in_and_a_whole_array_comes_out(port_of_arrays):
    step = port_of_arrays.step(port={"p.force": [0.002, -0.001]})

    displacement = [step.extra["p.displacement[1]"], step.extra["p.displacement[2]"]]
    np.testing.assert_allclose(displacement, [-1e-3, 2e-3], rtol=1e-12)


def test_a_port_of_two_elements_takes_two_values(port_of_arrays):
    with pytest.raises(
        errors.FmuInputError, match=r"port\.p\.force takes 2 values, but 1 were given"
    ):
        port_of_arrays.step(port={"p.force": 1.0})


# ---------------------------------------------------------------------- model exchange


def test_a_model_without_states_is_solved_as_well(foreign_fmu):
    with_both_interfaces = (
        "<CoSimulation",
        '<ModelExchange modelIdentifier="fixed2"/><CoSimulation',
    )
    fmu = foreign_fmu.changed("fixed2", "both", with_both_interfaces)
    header = {"interface": "model-exchange"}
    binding = bound(0.01, {"y": ("y", "1")}, control={"u": ("u", "1")}, header=header)

    with FmiAsset(fmu, binding) as asset:
        assert asset.step({"u": 3.0}).values[0] == 0.0


def test_events_that_pile_up_are_one_sentence(foreign_fmu):
    sentence = r"10000 events in the step from t = 2 s .* pile up"

    with FmiAsset(foreign_fmu("ball2"), bound(1.0, {"h": ("h", "mm")})) as asset:
        asset.step()
        asset.step()
        with pytest.raises(errors.FmuCallError, match=sentence):
            asset.step()
        with pytest.raises(errors.FmuWorkerError, match="reset the asset"):
            asset.step()
