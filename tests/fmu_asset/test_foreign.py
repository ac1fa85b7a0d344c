"""FMUs of FMI 1, 2 and 3 as others export them: what they end and refuse, and what is refused of them."""

import math

import numpy as np
import pytest

from fmu_asset import errors
from fmu_asset.door.session import FmiAsset
from tests.fmu_asset.door.kinds import BINDINGS, INPUTS, bounces
from tests.fmu_asset.making import archive_of, bound, changed, members

LAG, FIXED, ARRAY, BALL = (BINDINGS[name] for name in ("lag1", "fixed2", "array3", "ball2"))


def test_an_error_is_the_end_of_an_instance_and_a_state_goes_on(foreign_fmu, isolated) -> None:
    """Of FMI 1, by replay; a refusal between two observations leaves nothing to go on from."""
    with FmiAsset(foreign_fmu("lag1"), LAG, isolated=isolated, parameters={"gain": 3.0}) as asset:
        held = asset.step({"speed": 2.0}).values
        saved = asset.save_state()
        with pytest.raises(errors.FmuInputError, match=r"parameter\.gain = 101\.0 lies outside .* 0 to 100"):
            asset.reset({"gain": 101.0})
        with pytest.raises(errors.FmuCallError, match=r"(?s)fmiDoStep returned Error.*saturates"):
            asset.step({"speed": 1500.0})
        asset.restore_state(saved)
        np.testing.assert_array_equal(asset.observe().values, held)
    with FmiAsset(foreign_fmu("fixed2"), FIXED, isolated=isolated) as asset:
        asset.step({"u": 3.0})
        saved = asset.save_state()
        following = asset.step({"u": -1.0}).values
        with pytest.raises(errors.FmuCallError, match=r"It was step 5\d of the 100 between two observations"):
            asset.step({"u": 2e6})
        asset.restore_state(saved)
        np.testing.assert_array_equal(asset.step({"u": -1.0}).values, following)


def test_fmi_3_asks_to_end_or_returns_early(foreign_fmu, isolated) -> None:
    with FmiAsset(foreign_fmu("array3"), ARRAY, isolated=isolated) as asset:
        for offset, words in ((99, "asked to end the simulation in the step"), (98, "returned early")):
            asset.reset()
            with pytest.raises(errors.FmuCallError, match=words):
                asset.step(load={"offset": offset})


def test_a_nominal_of_zero_counts_as_one_and_an_identifier_may_have_a_hyphen(foreign_fmu, tmp_path) -> None:
    contents = {
        name.replace("ball2", "ball-2"): text.replace(b'modelIdentifier="ball2"', b'modelIdentifier="ball-2"')
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
def test_an_fmu_that_ends_its_simulation_leaves_what_was_simulated(foreign_fmu, isolated, model) -> None:
    """Discard and `fmi2Terminated`; events of model exchange in FMI 2, 1 and 3."""
    name, unit, size, end, value = ENDS[model]
    sent = {"control": {"u": ("u", "m/s")}} if model == "hostile2" else {}
    binding = bound(size, {"y": (name, unit)}, **sent)
    with FmiAsset(foreign_fmu(model, "ENDS"), binding, isolated=isolated) as asset:
        history = asset.simulate(steps=50)
        assert f"ended at t = {end:g} s" in history.ended
        whole = int(end / size)
        np.testing.assert_allclose(history.time, [*(size * np.arange(1, whole + 1)), end], rtol=1e-6)
        assert history.values[-1, 0] == pytest.approx(value, abs=1e-5)
        with pytest.raises(errors.FmuEndedError, match="has ended its simulation at t = "):
            asset.step()
        asset.reset()
        assert [asset.step().values[0] for _ in range(whole)] == history.values[:whole, 0].tolist()
        with pytest.raises(errors.FmuEndedError, match="asked to end the simulation in the step") as caught:
            asset.step()
        assert caught.value.time == pytest.approx(end, rel=1e-6)
        assert asset.observe().values[0] == history.values[-1, 0]


@pytest.mark.parametrize(("roles", "sentence"), INPUTS["unbound"])
def test_what_cannot_be_bound_is_named(foreign_fmu, roles, sentence) -> None:
    with pytest.raises(errors.BindingError, match=sentence):
        FmiAsset(foreign_fmu("array3"), bound(1.0, {"y": ("y", "mm")}, **roles))


@pytest.mark.parametrize(("model", "changes", "header", "kind", "sentence"), INPUTS["other"])
def test_other_kinds_are_refused_with_their_reason(
    foreign_fmu, model, changes, header, kind, sentence
) -> None:
    fmu = foreign_fmu.changed(model, "other", *changes)
    with pytest.raises(getattr(errors, kind), match=sentence):
        FmiAsset(fmu, changed(BINDINGS[model], header=header))


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
    fmu = foreign_fmu.changed("array3", "forces", ('min="-10" max="10"', 'min="-10" max="10" unit="N"'))
    with FmiAsset(fmu, tip) as asset:
        shown = asset.step(port={"p.force": [0.002, -0.001]})
        found = [shown.extra["p.displacement[1]"], shown.extra["p.displacement[2]"]]
        np.testing.assert_allclose(found, [-1e-3, 2e-3], rtol=1e-12)
        with pytest.raises(errors.FmuInputError, match=r"port\.p\.force takes 2 values, but 1 came"):
            asset.step(port={"p.force": 1.0})


def test_a_model_without_states_is_solved_as_well(foreign_fmu) -> None:
    both = foreign_fmu.changed(
        "fixed2", "both", ("<CoSimulation", '<ModelExchange modelIdentifier="fixed2"/><CoSimulation')
    )
    header = {"interface": "model-exchange"}
    solved = bound(0.01, {"y": ("y", "1")}, control={"u": ("u", "1")}, header=header)
    with FmiAsset(both, solved) as asset:
        assert asset.step({"u": 3.0}).values[0] == 0.0


def test_events_that_pile_up_are_one_sentence(foreign_fmu) -> None:
    with FmiAsset(foreign_fmu("ball2"), bound(1.0, {"h": ("h", "mm")})) as asset:
        asset.step(), asset.step()
        with pytest.raises(errors.FmuCallError, match=r"10000 events in the step from t = 2 s .* pile up"):
            asset.step()
        with pytest.raises(errors.FmuWorkerError, match="reset the asset"):
            asset.step()
