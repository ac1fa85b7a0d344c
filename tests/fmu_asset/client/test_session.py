"""What is particular in a session: refusals, units, the midst of a run, inputs in lines, starts and copies.

A start is a start: a reset that does nothing is not believed.
"""

import logging
import math
from pathlib import Path

import numpy as np
import pytest

from fmu_asset import errors
from fmu_asset.checks.fmu_check import check_fmu
from fmu_asset.client import stepped_fmu
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
from tests.fmu_asset.making import archive_of, bound, changed, members

# ---------------------------------------------------------------------- the wing


@pytest.mark.parametrize(("name", "changes", "tables", "kind", "sentence"), INPUTS["unfit"])
def test_what_does_not_fit_the_fmu_is_one_sentence(
    fmu, foreign_fmu, name, changes, tables, kind, sentence
) -> None:
    path = fmu if name == "uav_wing" else foreign_fmu.changed(name, "other", *changes)
    with pytest.raises(getattr(errors, kind), match=sentence):
        FmiAsset(path, changed(BINDINGS[name], **tables))


@pytest.mark.parametrize(("parameters", "kind", "sentence"), INPUTS["parameters"])
def test_parameters_that_do_not_fit_are_one_sentence(fmu, parameters, kind, sentence) -> None:
    with pytest.raises(getattr(errors, kind), match=sentence):
        FmiAsset(fmu, WING_BINDING, parameters=parameters)


# ---------------------------------------------------------------------- in the midst of a run

NOT_A_NUMBER, SLEEP, RAISE, DISCARD = 1, 2, 4, 5


@pytest.mark.parametrize(("behaviour", "kind", "sentence"), INPUTS["wrong"])
def test_a_step_that_goes_wrong_ends_a_run_there(
    spring_mass, isolated, behaviour, kind, sentence, monkeypatch
) -> None:
    """Whatever blocks it is made in; as single steps end there."""
    monkeypatch.setattr(stepped_fmu, "_BLOCK_BYTES", 3 * 6 * 8)
    push = np.linspace(0.0, 1.0, 10)
    with (
        FmiAsset(spring_mass, SPRING_BINDING, isolated=isolated) as asset,
        FmiAsset(spring_mass, SPRING_BINDING, isolated=False) as other,
    ):
        for bad in (0, 1, 9):
            for one in (asset, other):
                one.reset()
                one.step({"push": 0.3}, load={"misbehaviour": 0})
            with pytest.raises(getattr(errors, kind), match=sentence):
                asset.simulate(
                    {"push": push},
                    load={"misbehaviour": np.where(np.arange(10) == bad, behaviour, 0)},
                )
            for value in push[:bad]:
                other.step({"push": value})
            assert asset.step_index == bad + 1 + (
                behaviour == NOT_A_NUMBER
            )  # after which the step was made
            if behaviour == DISCARD:  # it is where it was before
                assert asset.save_state() == other.save_state()
                assert asset.step().values.tobytes() == other.step().values.tobytes()
            elif behaviour == RAISE:
                with pytest.raises(errors.FmuWorkerError, match="reset the asset"):
                    asset.simulate(steps=2)


def test_a_step_that_hangs_in_a_run_ends_the_worker(spring_mass) -> None:
    with FmiAsset(spring_mass, SPRING_BINDING, step_timeout=4.0) as asset:
        # The limit is that of a step: thousands in one message take longer than one may.
        assert asset.simulate({"push": 1.0}, steps=20_000).extra["steps"][-1] == 20_000
        misbehaviour = np.where(np.arange(500) == 300, SLEEP, 0)
        asset.reset()
        words = r"step \d+ from .* took longer than 4 s for a step"
        with pytest.raises(errors.FmuTimeoutError, match=words):
            asset.simulate(load={"misbehaviour": misbehaviour})
        assert asset.step_index <= 300


def test_histories_that_are_refused(foreign_fmu, spring_mass) -> None:
    with FmiAsset(spring_mass, SPRING_BINDING, isolated=False) as asset:
        for inputs, sentence in INPUTS["histories"]:
            with pytest.raises(ValueError, match=sentence):
                asset.simulate(**inputs)
        assert asset.step_index == 0
        assert asset.simulate(steps=1).extra["steps"].tolist() == [1.0]
        for again in (asset.reset, asset.renew):
            with pytest.raises(
                TypeError, match="Inputs are control, health, load, port, and 'loads' came"
            ):
                again(loads={})
    with FmiAsset(foreign_fmu("array3"), BINDINGS["array3_whole"], isolated=False) as asset:
        with pytest.raises(
            errors.FmuInputError, match=r"load\.u must be 3 values, .* the shape \(12, 2\)"
        ):
            asset.simulate(load={"u": np.ones((12, 2))})
        held = asset.simulate(load={"u": [1.0, -2.0, 3.0]}, steps=2)  # one array for all steps
        np.testing.assert_allclose(held.values, [[6e-3, 12e-3], [12e-3, 24e-3]], rtol=1e-12)


# ---------------------------------------------------------------------- inputs in straight lines

LINES = KINDS["lines"].binding
LINE = [0.5, 2.0, -1.0, -1.0, 3.0, 3.5, 0.0]


@pytest.mark.parametrize(("state", "isolated"), [("serialised", True), ("replay", False)])
def test_an_input_may_jump_before_the_state_is_kept(foreign_fmu, state, isolated) -> None:
    """A worker is told the lines with each request."""
    with FmiAsset(
        foreign_fmu("follow2"), changed(LINES, header={"state": state}), isolated=isolated
    ) as asset:
        asset.simulate({"u": LINE[:3]})
        asset.hold({"u": 3.0})
        with pytest.raises(errors.FmuInputError, match="outside the range"):
            asset.hold({"u": 1000.0})
        kept = asset.save_state()
        there = asset.simulate({"u": LINE[3:]})
        assert there.extra["seen"][0] == 3.0
        with asset.sibling() as other:
            other.restore_state(kept)
            assert other.simulate({"u": LINE[3:]}).values.tobytes() == there.values.tobytes()


# ---------------------------------------------------------------------- starts


FLIGHTS = [(False, (3, 7, 7)), (True, (4, 1, 7, 1)), (False, (1,) * 7)]
"""Whether the steps are made in one go, and how many there are in each flight."""
CLOCKS = [("INSTANCE_CLOCK", True), ("INSTANCE_CLOCK", False), ("process_clock", True)]


@pytest.mark.parametrize(("clock", "isolated"), CLOCKS, ids=["instance", "in process", "process"])
@pytest.mark.parametrize(("in_one_go", "lengths"), FLIGHTS, ids=str)
def test_a_hidden_clock_shows_at_no_start(
    foreign_fmu, clock, isolated, in_one_go, lengths, caplog
) -> None:
    """The clock adds 1 from its sixth step on: where the first reset is looked at, nothing is to be seen."""
    case = f"CASE={sum(lengths)}{len(lengths)}{isolated}{in_one_go}"  # what is wrong is said once for a file
    fmu = foreign_fmu("hostile2", f"CLOCK={clock}", "STAYS_LOADED", case)

    def seen_of(asset: FmiAsset, push: float, steps: int) -> list[float]:
        asset.reset()
        if in_one_go:
            return asset.simulate({"u": push}, steps=steps).values[:, 0].tolist()
        return [asset.step({"u": push}).values[0] for _ in range(steps)]

    with caplog.at_level(logging.WARNING), FmiAsset(fmu, HOSTILE, isolated=isolated) as asset:
        assert [seen_of(asset, 0.1, length)[0] for length in lengths] == [0.1] * len(lengths)
        # A start whose first step is another one has those that are known for its proof.
        seen_of(asset, 0.3, 7)
        seen = seen_of(asset, 0.3, 7)
        np.testing.assert_allclose(seen, [0.3, 0.6, 0.9, 1.2, 1.5, 2.8, 4.1], rtol=1e-12)
        assert asset.reset_trial.works is False
    assert "Flights that began by a reset before may be wrong" in caplog.messages[0]
    assert len(caplog.messages) == (2 if clock == "process_clock" else 1)


def test_what_never_starts_alike_is_not_started_in_ever_new_processes(foreign_fmu) -> None:
    fmu = foreign_fmu("hostile2", "NOT_DETERMINISTIC", "STAYS_LOADED", "CLOCK=process_clock")
    with FmiAsset(fmu, HOSTILE) as asset:
        seen = []
        for _ in range(11):
            asset.reset()
            asset.step()
            seen.append(asset.worker_process_id)
        assert len(set(seen[7:])) == 1


def test_a_check_names_a_reset_that_does_nothing(foreign_fmu) -> None:
    (problem,) = check_fmu(foreign_fmu("spring2", "RESET_DOES_NOTHING"), step_size=0.1).problems
    assert problem.startswith("Its reset returns OK and does not bring it back to its start")
    assert check_fmu(foreign_fmu("hostile2", "NEGATIVE_ZERO_AFTER_RESET")).passed


def test_the_tolerance_is_that_of_the_fmu_unless_the_binding_says_otherwise(
    foreign_fmu, isolated
) -> None:
    for header, expected in (({}, 1e-4), ({"tolerance": 1e-7}, 1e-7)):
        chosen = bound(0.1, {"tolerance": ("tolerance", "1")}, header=header)
        with FmiAsset(foreign_fmu("spring2"), chosen, isolated=isolated) as asset:
            assert asset.observe().values[0] == expected


# ---------------------------------------------------------------------- many instances of one FMU


def test_copies_share_the_extracted_fmu_until_the_last_is_closed(
    foreign_fmu, scratch, isolated
) -> None:
    with FmiAsset(foreign_fmu("hostile2"), HOSTILE, isolated=isolated) as asset:
        asset.step({"u": 2.0})
        forks = [asset.fork() for _ in range(3)]
        forks[0].close()
        process = asset.worker_process_id
        for _ in range(20):
            asset.renew()
            assert asset.step({"u": 3.0}).values[0] == 3.0
        assert asset.worker_process_id == process
    assert not isolated or not (Path("/proc") / str(process)).exists()  # gone at once
    assert len([*scratch.rglob("modelDescription.xml")]) == 1
    assert [fork.step({"u": 1.0}).values[0] for fork in forks[1:]] == [3.0, 3.0]
    for fork in forks:
        fork.close()
    assert not list(scratch.iterdir())


def test_siblings_have_parameters_of_their_own(foreign_fmu) -> None:
    with (
        FmiAsset(foreign_fmu("lag1"), BINDINGS["lag1"]) as first,
        first.sibling({"gain": 3.0}) as other,
    ):
        seen = [asset.step({"speed": 1.0}).values for asset in (first, other)]
    np.testing.assert_allclose(seen, (1.0 - np.exp(-0.3)) * np.array([[2.0], [3.0]]), rtol=1e-12)


# ---------------------------------------------------------------------- what others' FMUs do

LAG, FIXED, ARRAY, BALL = (BINDINGS[name] for name in ("lag1", "fixed2", "array3", "ball2"))


def test_an_error_is_the_end_of_an_instance_and_a_state_goes_on(foreign_fmu, isolated) -> None:
    """Of FMI 1, by replay; a refusal between two observations leaves nothing to go on from."""
    with FmiAsset(foreign_fmu("lag1"), LAG, isolated=isolated, parameters={"gain": 3.0}) as asset:
        held = asset.step({"speed": 2.0}).values
        saved = asset.save_state()
        with pytest.raises(
            errors.FmuInputError, match=r"parameter\.gain = 101\.0 lies outside .* 0 to 100"
        ):
            asset.reset({"gain": 101.0})
        with pytest.raises(errors.FmuCallError, match=r"(?s)fmiDoStep returned Error.*saturates"):
            asset.step({"speed": 1500.0})
        asset.restore_state(saved)
        np.testing.assert_array_equal(asset.observe().values, held)
    with FmiAsset(foreign_fmu("fixed2"), FIXED, isolated=isolated) as asset:
        asset.step({"u": 3.0})
        saved = asset.save_state()
        following = asset.step({"u": -1.0}).values
        with pytest.raises(
            errors.FmuCallError, match=r"It was step 5\d of the 100 between two observations"
        ):
            asset.step({"u": 2e6})
        asset.restore_state(saved)
        np.testing.assert_array_equal(asset.step({"u": -1.0}).values, following)


def test_fmi_3_asks_to_end_or_returns_early(foreign_fmu, isolated) -> None:
    with FmiAsset(foreign_fmu("array3"), ARRAY, isolated=isolated) as asset:
        for offset, words in (
            (99, "asked to end the simulation in the step"),
            (98, "returned early"),
        ):
            asset.reset()
            with pytest.raises(errors.FmuCallError, match=words):
                asset.step(load={"offset": offset})


def test_a_nominal_of_zero_counts_as_one_and_an_identifier_may_have_a_hyphen(
    foreign_fmu, tmp_path
) -> None:
    contents = {
        name.replace("ball2", "ball-2"): text.replace(
            b'modelIdentifier="ball2"', b'modelIdentifier="ball-2"'
        )
        for name, text in members(foreign_fmu("ball2", "NOMINAL=0.0")).items()
    }
    with FmiAsset(archive_of(tmp_path / "ball-2.fmu", contents), BALL, isolated=False) as asset:
        history = asset.simulate(steps=8)
    expected = [bounces(0.7, 9.81, time)[:2] for time in history.time]
    np.testing.assert_allclose(history.values * [1e-3, 1.0], expected, rtol=1e-6)


SECOND_BOUNCE = math.sqrt(2.0 / 9.81) * 2.4


ENDS = {  # what is observed, the step, where it ends, and what is seen there
    "hostile2": ("y", "m", 1.0, 2.5, 2.5),
    "ball2": ("h", "m", 0.1, SECOND_BOUNCE, 0.0),
    "decay1": ("x", "K", 0.3, 1.0, math.exp(-1.0)),
    "swing3": ("a", "1", 0.3, 1.0, 1.0),
}


@pytest.mark.parametrize("model", ENDS)
def test_an_fmu_that_ends_its_simulation_leaves_what_was_simulated(
    foreign_fmu, isolated, model
) -> None:
    """Discard and `fmi2Terminated`; events of model exchange in FMI 2, 1 and 3."""
    name, unit, size, end, value = ENDS[model]
    sent = {"control": {"u": ("u", "m/s")}} if model == "hostile2" else {}
    binding = bound(size, {"y": (name, unit)}, **sent)
    with FmiAsset(foreign_fmu(model, "ENDS"), binding, isolated=isolated) as asset:
        history = asset.simulate(steps=50)
        assert f"ended at t = {end:g} s" in history.ended
        whole = int(end / size)
        np.testing.assert_allclose(
            history.time, [*(size * np.arange(1, whole + 1)), end], rtol=1e-6
        )
        assert history.values[-1, 0] == pytest.approx(value, abs=1e-5)
        with pytest.raises(errors.FmuEndedError, match="has ended its simulation at t = "):
            asset.step()
        asset.reset()
        asset.step()
        np.testing.assert_allclose(asset.simulate(steps=50).time, history.time[1:], rtol=1e-12)
        asset.reset()
        assert [asset.step().values[0] for _ in range(whole)] == history.values[:whole, 0].tolist()
        with pytest.raises(
            errors.FmuEndedError, match="asked to end the simulation in the step"
        ) as caught:
            asset.step()
        assert caught.value.time == pytest.approx(end, rel=1e-6)
        assert asset.observe().values[0] == history.values[-1, 0]


def test_ports_are_sent_and_read(foreign_fmu) -> None:
    root, tip = BINDINGS["port_root"], BINDINGS["port_tip"]
    beam = foreign_fmu.changed("room2", "beam", *INPUTS["beam"])
    with FmiAsset(beam, root) as asset:
        shown = asset.step(port={"p.force": 1.0e6})
        steady = 283.15 + 1000.0 / 100.0
        expected = steady + (293.15 - steady) * math.exp(-60.0 * 100.0 / 5e4)
        assert shown.extra["p.displacement"] == pytest.approx(1e3 * expected)
        assert asset.recorded_units == {"p.displacement": "mm", "p.velocity": "m/s"}
    # Elements of an array go in, a whole array comes out.
    fmu = foreign_fmu.changed(
        "array3", "forces", ('min="-10" max="10"', 'min="-10" max="10" unit="N"')
    )
    with FmiAsset(fmu, tip) as asset:
        shown = asset.step(port={"p.force": [0.002, -0.001]})
        found = [shown.extra["p.displacement[1]"], shown.extra["p.displacement[2]"]]
        np.testing.assert_allclose(found, [-1e-3, 2e-3], rtol=1e-12)
        with pytest.raises(
            errors.FmuInputError, match=r"port\.p\.force takes 2 values, but 1 came"
        ):
            asset.step(port={"p.force": 1.0})


def test_a_model_without_states_is_solved_as_well(foreign_fmu) -> None:
    both = foreign_fmu.changed(
        "fixed2",
        "both",
        ("<CoSimulation", '<ModelExchange modelIdentifier="fixed2"/><CoSimulation'),
    )
    header = {"interface": "model-exchange"}
    solved = bound(0.01, {"y": ("y", "1")}, control={"u": ("u", "1")}, header=header)
    with FmiAsset(both, solved) as asset:
        assert asset.step({"u": 3.0}).values[0] == 0.0


def test_events_that_pile_up_are_one_sentence(foreign_fmu) -> None:
    with FmiAsset(foreign_fmu("ball2"), bound(1.0, {"h": ("h", "mm")})) as asset:
        asset.step(), asset.step()
        with pytest.raises(
            errors.FmuCallError, match=r"10000 events in the step from t = 2 s .* pile up"
        ):
            asset.step()
        with pytest.raises(errors.FmuWorkerError, match="reset the asset"):
            asset.step()
