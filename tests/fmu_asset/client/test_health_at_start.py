"""A health that is a fixed parameter of the FMU: each state has a start of its own."""

import numpy as np
import pytest

from fmu_asset import errors
from fmu_asset.client.binding import Binding
from fmu_asset.client.session import FmiAsset
from fmu_asset.coupling.asset import CoupledAsset
from fmu_asset.coupling.structure import Component
from tests.fmu_asset.making import bound, changed, system


@pytest.fixture
def binding() -> Binding:
    """A siren whose broken share is its health."""
    return bound(
        1.0,
        {"all": (["y", "steps", "began"], "1")},
        control={"u": ("u", "1")},
        health={"z": ("broken", "1")},
    )


def test_a_health_that_changes_starts_the_fmu_anew_at_that_moment(foreign_fmu, binding) -> None:
    with FmiAsset(foreign_fmu("siren2"), binding) as asset:
        seen = [asset.step({"u": 4.0}, {"z": share}) for share in (0.0, 0.0, 0.25, 0.25)]
    expected = [[4.0, 1.0, 0.0], [4.0, 2.0, 0.0], [3.0, 1.0, 2.0], [3.0, 2.0, 2.0]]
    assert [item.values.tolist() for item in seen] == expected
    assert [item.time for item in seen] == [1.0, 2.0, 3.0, 4.0]


def test_a_history_gives_what_single_steps_give(foreign_fmu, binding, isolated) -> None:
    health, push = [0.0, 0.0, 0.25, 0.5, 0.5], [1.0, 2.0, 3.0, 4.0, 5.0]
    with FmiAsset(foreign_fmu("siren2"), binding, isolated=isolated) as asset:
        history = asset.simulate({"u": push}, {"z": health})
        asset.reset()
        steps = [asset.step({"u": u}, {"z": z}) for u, z in zip(push, health, strict=True)]
    np.testing.assert_array_equal(history.values, [step.values for step in steps])
    assert history.time.tolist() == [step.time for step in steps]


def test_the_health_of_a_reset_holds_from_the_start(foreign_fmu, binding) -> None:
    with FmiAsset(foreign_fmu("siren2"), binding, isolated=False) as asset:
        asset.reset(health={"z": 0.5})
        assert asset.step({"u": 4.0}, {"z": 0.5}).values.tolist() == [2.0, 1.0, 0.0]
        asset.reset()  # at the FMU's own value
        assert asset.step({"u": 4.0}).values[0] == 4.0


def test_a_saved_state_holds_the_health_and_its_start(foreign_fmu, binding) -> None:
    with FmiAsset(foreign_fmu("siren2"), binding) as asset:
        for share in (0.0, 0.25, 0.25):
            asset.step({"u": 4.0}, {"z": share})
        saved = asset.save_state()
        expected = asset.step().values.tolist()
    with FmiAsset(foreign_fmu("siren2"), binding) as other:
        other.restore_state(saved)
        assert other.step().values.tolist() == expected == [3.0, 3.0, 1.0]


def test_a_start_value_can_be_a_health_too(foreign_fmu) -> None:
    """The height of a ball: an output with a start value, in model exchange."""
    free = bound(0.1, {"h": ("h", "m")}, health={"height": ("h", "m")})
    with FmiAsset(foreign_fmu("ball2"), free, isolated=False) as asset:
        first = asset.step(health={"height": 3.0}).values[0]
    assert first == pytest.approx(3.0 - 0.5 * 9.81 * 0.01, abs=1e-4)


def test_a_refused_health_changes_nothing(foreign_fmu, binding) -> None:
    with FmiAsset(foreign_fmu("siren2"), binding, isolated=False) as asset:
        asset.step({"u": 4.0}, {"z": 0.25})
        with pytest.raises(errors.FmuInputError, match=r"health\.z = 1\.2 lies outside the range"):
            asset.step(health={"z": 1.2})
        assert asset.step().values.tolist() == [3.0, 2.0, 0.0]


def test_a_fork_goes_on_in_its_health(foreign_fmu, binding) -> None:
    with FmiAsset(foreign_fmu("siren2"), binding) as asset:
        asset.step({"u": 4.0}, {"z": 0.0})
        asset.step(health={"z": 0.25})
        with asset.fork() as other:
            assert other.step().values.tolist() == asset.step().values.tolist() == [3.0, 2.0, 1.0]


def test_a_system_refuses_such_a_health(foreign_fmu, binding) -> None:
    siren = system([Component("siren", foreign_fmu("siren2"))], [])
    inside = changed(
        binding,
        control={"u": {"variable": "siren.u", "unit": "1"}},
        health={"z": {"variable": "siren.broken", "unit": "1"}},
        observation={"all": {"variables": ["siren.y"], "unit": "1"}},
    )
    words = "has the health z, which the system test takes at its start"
    with pytest.raises(errors.BindingError, match=words):
        CoupledAsset(siren, inside)
