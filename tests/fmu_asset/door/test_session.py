"""What is particular in a session: refusals in one sentence, units, what happens in the midst of a run."""

import re
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fmu_asset import errors
from fmu_asset.archive.fmu_file import read_fmu
from fmu_asset.door import session
from fmu_asset.door.exchange import Exchange
from fmu_asset.door.session import FmiAsset
from tests.fmu_asset.door.kinds import INPUTS
from tests.fmu_asset.making import bound, changed

# ---------------------------------------------------------------------- the wing


def test_a_state_that_the_fmu_refuses_breaks_the_asset(fmu, binding) -> None:
    with FmiAsset(fmu, binding) as asset:
        asset.step({"load_factor": 2.0})
        saved = asset.save_state()
        with pytest.raises(errors.FmuStateError, match=r"refused the state"):
            asset.restore_state(saved[:-40] + b"\0" * 8)
        with pytest.raises(errors.FmuStateError, match="reset the asset"):
            asset.step()
        asset.reset()
        assert asset.step({"load_factor": 2.0}).time == 1.0


WRONG_PARAMETERS: list[tuple[dict[str, float], type[Exception], str]] = [
    ({"young_modulus_factor": 3.0}, errors.FmuInputError, r"parameter\.young_modulus_factor = 3\.0 lies"),
    ({"response": 1.5}, errors.FmuInputError, "whole number"),
    ({"e": 1.0}, errors.BindingError, "no parameter 'e'"),
]


def test_what_does_not_fit_the_fmu_is_one_sentence(fmu, binding) -> None:
    for table, sentence in INPUTS["unfit"]:
        with pytest.raises(errors.BindingError, match=sentence):
            FmiAsset(fmu, changed(binding, **table))
    for parameters, kind, sentence in WRONG_PARAMETERS:
        with pytest.raises(kind, match=sentence):
            FmiAsset(fmu, binding, parameters=parameters)
    with pytest.raises(errors.BindingError, match="no control 'n'"):
        FmiAsset(fmu, binding).step({"n": 1.0})


def test_units_are_converted_and_parameters_reach_the_fmu_at_the_next_start(
    model, fmu, binding, isolated
) -> None:
    units = bound(
        1.0, {"strain": ("strain[{1..24}]", "microstrain")}, control={"load_factor": ("load_factor", "1")},
        health={"z1": ("health.z1", "percent"), "z2": ("health.z2", "%")}, load={"push": ("tip_force", "kN")},
        monitor={"tip": ("tip_displacement", "mm"), "load_point": ("load_point_displacement", "mm")},
    )  # fmt: skip
    inputs = {"load_factor": 3.0}, {"z1": 85.0, "z2": 20.0}, {"push": 0.005}
    with FmiAsset(fmu, units, isolated=isolated, parameters={"young_modulus_factor": 1.05}) as asset:
        for factor in (1.05, 0.95):
            seen = asset.step(*inputs)
            with pytest.raises(errors.FmuInputError, match=r"0 to 0\.85"):
                asset.step({}, {"z1": 85.1})
            chosen = {"young_modulus_factor": factor, "z1": 0.85, "z2": 0.2}
            expected = model.static_response({**chosen, "load_factor": 3.0, "tip_force": 5.0})
            np.testing.assert_allclose(seen.values, 1e6 * expected.strain, rtol=1e-12)
            assert seen.extra["tip"] == pytest.approx(1e3 * expected.displacement[0], rel=1e-12)
            asset.reset({"young_modulus_factor": 0.95})
    slow = changed(units, header={"step_size": 60.0}, parameter={"r": {"variable": "response", "unit": "1"}})
    for response in (1.0, 2.0):  # the load point moves by its compliance
        with FmiAsset(fmu, slow, isolated=False, parameters={"r": response}) as asset:
            asset.step({"load_factor": 0.0}, {"z1": 20.0}, {"push": 0.01})
            point = asset.step().extra["load_point"]
        assert point == pytest.approx(1e3 * 10.0 / model.tip_stiffness(1.0, (0.2, 0.0)), rel=1e-9)


def test_the_fmu_itself_refuses_and_says_why(fmu, binding, monkeypatch) -> None:
    """With the door's own check out of the way, the FMU's is seen: Discard, a sentence, nothing changed."""
    monkeypatch.setattr("fmu_asset.door.layout.Slot.numbers", lambda slot, value: np.array([value]))
    with FmiAsset(fmu, binding) as asset:
        before = asset.step({"load_factor": 3.0})
        for value, sentence in ((99, "lies outside its range"), (float("nan"), "not finite")):
            said = rf"(?s)step 1 from t = 1 s.*Discard.*load_factor.*{sentence}"
            with pytest.raises(errors.FmuCallError, match=said):
                asset.step({"load_factor": value})
        after = asset.step()
        np.testing.assert_array_equal(before.values, after.values)
        assert after.time == 2.0


# ---------------------------------------------------------------------- in the midst of a run

NOT_A_NUMBER, SLEEP, DIE, RAISE, DISCARD = 1, 2, 3, 4, 5
GOES_WRONG: dict[int, tuple[type[Exception], str]] = {
    NOT_A_NUMBER: (errors.FmuOutputError, r"not finite at t = .* s: position"),
    RAISE: (errors.FmuCallError, r"(?s)returned Fatal.*the spring broke"),
    DISCARD: (errors.FmuCallError, r"step \d+ from t = .* returned Discard"),
}


@pytest.mark.parametrize("bad", [0, 1, 9])
@pytest.mark.parametrize("behaviour", GOES_WRONG)
def test_a_step_that_goes_wrong_ends_a_run_there(
    spring_mass, spring_binding, isolated, behaviour, bad, monkeypatch
) -> None:
    """Whatever blocks it is made in; as single steps end there."""
    monkeypatch.setattr(session, "_BLOCK_BYTES", 3 * 6 * 8)
    kind, sentence = GOES_WRONG[behaviour]
    push, load = np.linspace(0.0, 1.0, 10), {"misbehaviour": np.where(np.arange(10) == bad, behaviour, 0)}
    with (
        FmiAsset(spring_mass, spring_binding, isolated=isolated) as asset,
        FmiAsset(spring_mass, spring_binding, isolated=False) as other,
    ):
        for one in (asset, other):
            one.step({"push": 0.3})
        with pytest.raises(kind, match=sentence):
            asset.simulate({"push": push}, load=load)
        for value in push[:bad]:
            other.step({"push": value}, load={"misbehaviour": 0})
        assert asset.step_index == bad + 1 + (behaviour == NOT_A_NUMBER)  # after which the step was made
        if behaviour == DISCARD:  # it is where it was before
            assert asset.save_state() == other.save_state()
            with pytest.raises(kind, match=sentence):
                asset.step({"push": 7.0}, load={"misbehaviour": DISCARD})
            assert asset.step().values.tobytes() == other.step().values.tobytes()
        elif behaviour == RAISE:
            for going_on in (asset.step, lambda: asset.simulate(steps=2)):
                with pytest.raises(errors.FmuWorkerError, match="reset the asset"):
                    going_on()
        for one in (asset, other):
            one.reset()
        history = asset.simulate({"push": push}, load={"misbehaviour": 0})
        assert history.values.tobytes() == np.array([other.step({"push": p}).values for p in push]).tobytes()


def test_a_step_that_hangs_or_dies_ends_the_worker(spring_mass, spring_binding) -> None:
    with FmiAsset(spring_mass, spring_binding, step_timeout=0.4) as asset:
        # The limit is that of a step: thousands in one message take longer than one may.
        assert asset.simulate({"push": 1.0}, steps=20_000).extra["steps"][-1] == 20_000
        misbehaviour = np.where(np.arange(500) == 300, SLEEP, 0)
        asset.reset()
        words = r"step \d+ from .* took longer than 0\.4 s for a step"
        with pytest.raises(errors.FmuTimeoutError, match=words):
            asset.simulate(load={"misbehaviour": misbehaviour})
        assert asset.step_index <= 300
        asset.reset()
        with pytest.raises(errors.FmuWorkerError, match="SIGABRT"):
            asset.simulate(load={"misbehaviour": [0, 0, 0, DIE, 0]})
        asset.reset()
        assert asset.simulate(steps=3).extra["steps"].tolist() == [1.0, 2.0, 3.0]


WRONG: list[tuple[dict[str, Any], str]] = [
    ({"control": {"push": 1.0}}, "Nothing says how many steps"),
    ({"control": {"push": []}}, "Nothing says how many steps"),
    ({"control": {"push": np.ones((3, 2))}}, r"control\.push must be a number, or one for"),
    ({"control": {"push": ["a", "b"]}}, r"control\.push must be numbers"),
    ({"control": {"push": [1.0, np.nan]}}, r"finite.*value of step 1 of the 2"),
    ({"control": {"push": [1.0, np.inf]}}, r"finite.*value of step 1 of the 2"),
    ({"control": {"push": [1.0, 1.0]}, "health": {"spring": [1.0]}},
     r"health\.spring has 1 steps, but control\.push says 2"),
    ({"load": {"misbehaviour": [0.0, 0.5, 0.0]}}, r"whole number.*value of step 1 of the 3"),
    ({"load": {"lock": [True, 2]}}, r"outside the range.*value of step 1 of the 2"),
    ({"steps": 0}, "steps must be at least 1"),
    ({"control": {"push": [1.0, 2.0]}, "steps": 3}, r"control\.push has 2 steps, but `steps` says 3"),
]  # fmt: skip


def test_histories_that_are_refused(foreign_fmu, spring_mass, spring_binding) -> None:
    with FmiAsset(spring_mass, spring_binding, isolated=False) as asset:
        for inputs, sentence in WRONG:
            with pytest.raises(errors.FmuInputError, match=sentence):
                asset.simulate(**inputs)
        with pytest.raises(errors.BindingError, match=r"has no control 'pull'; it has push"):
            asset.simulate({"pull": 1.0})
        assert asset.step_index == 0
        assert asset.simulate(steps=1).extra["steps"].tolist() == [1.0]
        for again in (asset.reset, asset.renew):
            with pytest.raises(TypeError, match="Inputs are control, health, load, port, and 'loads' came"):
                again(loads={})
    array = bound(1.0, {"y": (["y[2]", "y[1]"], "mm")}, load={"u": ("u", "1")})
    with pytest.raises(errors.FmuInputError, match=r"load\.u must be 3 values, .* the shape \(12, 2\)"):
        FmiAsset(foreign_fmu("array3"), array).simulate(load={"u": np.ones((12, 2))})


@given(
    power=st.lists(st.floats(-1e3, 1e3) | st.sampled_from([-0.0, 0, 1e-320, True]), min_size=1, max_size=6),
    outside=st.floats(-40.0, 50.0) | st.sampled_from([-40.0, 50.0]),
)
def test_what_is_sent_is_what_a_step_sends(foreign_fmu, power, outside) -> None:
    ends = {"power": ("heater.u[1].P", "kW")}, {"outside": ("ambient.T", "degC", -40.0, 50.0)}
    binding = bound(60.0, {"room": ("room.T", "degC")}, control=ends[0], load=ends[1])
    exchange = Exchange(read_fmu(foreign_fmu("room2")), binding)
    target, sent, refused = exchange.start_values({}), [], ""
    held, roles = np.array(target), {"control": {"power": power}, "load": {"outside": outside}}
    try:
        for value in power:
            exchange.place(target, {"control": {"power": value}, "load": {"outside": outside}})
            sent.append(list(target))
    except errors.FmuInputError as error:
        refused = error.sentence
    if refused:
        with pytest.raises(errors.FmuInputError, match=re.escape(refused)):
            exchange.rows(held, roles, None)
    else:
        assert exchange.rows(held, roles, None).tobytes() == np.array(sent).tobytes()
