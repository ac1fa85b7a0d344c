"""The slave as a Python object: phases, refusals that change nothing, lazy outputs, serialised state."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fe.runtime.modal_system import rayleigh_damping_ratio
from fe.runtime.reduced import ReducedModel
from fmu_asset.slaves.base import Contents, Slave
from fmu_asset.slaves.behaviour import StructureBehaviour, later_outputs
from fmu_asset.slaves.table import structure_table
from fmu_asset.slaves.variables import (
    STATUS_BAD_CALL,
    STATUS_BAD_STATE,
    STATUS_BAD_STEP,
    STATUS_INTERNAL,
    STATUS_NOT_FINITE,
    STATUS_OK,
    STATUS_OUTSIDE_RANGE,
)

START = {"mass.servo": 0.17, "mass.pitot": 0.13, "damping.alpha": 1.0, "damping.beta": 1e-4}
N, Z1, Z2, FORCE = range(4)


class Bare:
    """Stands in for pythonfmu's base class."""

    def __init__(self, **_: object) -> None:
        pass


@pytest.fixture(scope="session")
def make_slave(model: ReducedModel) -> Callable[..., Any]:
    table, roles = structure_table(model, START)
    reference = {row.name: row.reference for row in table}

    class Wing(Slave, Bare):
        content_tag = "tag"
        load_contents = staticmethod(
            lambda _: Contents(
                table, lambda: StructureBehaviour(model, table, roles), later_outputs(table, roles)
            )
        )

        def of(self, name: str) -> float:
            index = reference[name]
            return float(self.get_integer([index])[0] if name == "status" else self.get_real([index])[0])

        def put(self, name: str, value: float) -> None:
            if name == "response":
                self.set_integer([reference[name]], [int(value)])
            else:
                self.set_real([reference[name]], [value])

        def everything(self) -> list[float]:
            return self.get_real(list(range(len(table))))

    def make(**values: float) -> Wing:
        wing = Wing(resources=str(Path("nowhere")))
        wing.setup_experiment(0.0)
        wing.enter_initialization_mode()
        for name, value in values.items():
            wing.put(name.replace("__", "."), value)
        wing.exit_initialization_mode()
        return wing

    make.kind = Wing  # type: ignore[attr-defined]
    return make


def test_start_is_the_equilibrium_under_the_start_values(make_slave: Any, model: ReducedModel) -> None:
    wing = make_slave(load_factor=2.0, health__z1=0.3)
    expected = model.static_response(young_modulus_factor=1.0, stiffness_loss=(0.3, 0.0), load_factor=2.0)
    np.testing.assert_array_equal(wing.get_real(list(range(11, 35))), expected.strain)
    assert wing.of("tip_displacement") == expected.displacement[0]
    assert wing.of("status") == STATUS_OK


def test_modal_outputs_follow_health_and_damping(make_slave: Any, model: ReducedModel) -> None:
    wing = make_slave(damping__alpha=2.0)
    wing.put("health.z1", 0.6)
    healthy = wing.of("frequency[1]")
    assert wing.do_step(0.0, 1.0)
    expected = model.modes(
        young_modulus_factor=1.0, stiffness_loss=(0.6, 0.0), servo_mass=0.17, pitot_mass=0.13
    ).frequency
    assert wing.of("frequency[1]") == expected[0] < healthy
    assert wing.of("damping_ratio[2]") == rayleigh_damping_ratio(2.0, 1e-4, expected)[1]


@given(
    index=st.integers(0, 3),
    value=st.one_of(
        st.just(math.nan),
        st.just(math.inf),
        st.just(-math.inf),
        st.floats(30.0, 1e300),
        st.floats(-1e300, -30.0),
    ),
    transient=st.booleans(),
)
def test_refused_inputs_change_nothing(make_slave: Any, index: int, value: float, transient: bool) -> None:
    wing = make_slave(response=2.0 if transient else 1.0, initial_tip_displacement=0.01)
    twin = make_slave(response=2.0 if transient else 1.0, initial_tip_displacement=0.01)
    accepted = [2.0, 0.1, 0.2, 1.0]
    for one in (wing, twin):
        one.set_real([0, 1, 2, 3], accepted)
        assert one.do_step(0.0, 0.01)
    wing.set_real([index], [value])
    assert wing.do_step(0.01, 0.01) is False
    assert wing.of("status") == (STATUS_OUTSIDE_RANGE if math.isfinite(value) else STATUS_NOT_FINITE)
    message = wing.log_queue[-1]
    assert ("load_factor", "health.z1", "health.z2", "tip_force")[index] in message.msg
    assert wing.everything()[11:37] == twin.everything()[11:37]
    wing.set_real([index], [accepted[index]])
    for one in (wing, twin):
        assert one.do_step(0.01, 0.01) is True
    assert wing.everything() == twin.everything()


@given(size=st.floats(1e-4, 0.5), parts=st.integers(2, 7))
def test_the_transient_does_not_depend_on_the_step_size(make_slave: Any, size: float, parts: int) -> None:
    whole, split = (make_slave(response=2.0, initial_tip_displacement=0.02) for _ in range(2))
    for wing in (whole, split):
        wing.set_real([N, Z1], [3.0, 0.5])
    assert whole.do_step(0.0, size)
    for part in range(parts):
        assert split.do_step(part * size / parts, size / parts)
    np.testing.assert_allclose(whole.everything()[11:36], split.everything()[11:36], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("size", [0.0, -1.0, math.nan, math.inf])
def test_bad_step_sizes(make_slave: Any, size: float) -> None:
    wing = make_slave()
    before = wing.everything()
    assert wing.do_step(0.0, size) is False
    assert wing.of("status") == STATUS_BAD_STEP
    assert wing.everything()[:37] == before[:37]
    assert wing.do_step(0.0, 1.0) is True


def test_a_step_from_another_time_is_refused(make_slave: Any) -> None:
    wing = make_slave()
    assert wing.do_step(0.0, 1.0)
    for time in (0.0, 2.0, math.nan):
        assert wing.do_step(time, 1.0) is False
        assert wing.of("status") == STATUS_BAD_STEP
    assert "stands at t = 1.0" in wing.log_queue[-2].msg


def test_calls_in_the_wrong_phase(make_slave: Any) -> None:
    wing = make_slave.kind(resources="nowhere")
    assert wing.do_step(0.0, 1.0) is False
    assert "before initialisation" in wing.log_queue[-1].msg
    wing.exit_initialization_mode()
    wing.enter_initialization_mode()
    assert wing.do_step(0.0, 1.0) is False
    wing.exit_initialization_mode()
    wing.enter_initialization_mode()
    assert wing.of("status") == STATUS_BAD_CALL
    wing.put("young_modulus_factor", 1.1)
    assert "fixed parameter" in wing.log_queue[-1].msg
    assert wing.of("young_modulus_factor") == 1.0
    wing.put("strain[1]", 1.0)
    wing.set_real([999], [1.0])
    for unknown in ([999], [49, 50, 51], [-1], [0, 999]):
        given = wing.get_real(unknown)
        assert len(given) == len(unknown)
        assert math.isnan(given[-1])
    assert wing.get_real([]) == []
    assert wing.get_string([0]) == [""]
    assert wing.do_step(0.0, 1.0) is True
    wing.terminate()
    assert wing.do_step(1.0, 1.0) is False
    assert "after termination" in wing.log_queue[-1].msg
    assert wing.of("strain[1]") != 0.0


@pytest.mark.parametrize(
    ("name", "value"), [("mass.servo", 9.0), ("damping.alpha", math.nan), ("response", 3)]
)
def test_refused_parameters_stop_the_start(make_slave: Any, name: str, value: float) -> None:
    wing = make_slave(**{name.replace(".", "__"): value})
    assert wing.of("status") in (STATUS_OUTSIDE_RANGE, STATUS_NOT_FINITE)
    assert name in wing.log_queue[-1].msg
    assert wing.do_step(0.0, 1.0) is False
    wing.enter_initialization_mode()
    wing.put(name, {"mass.servo": 0.17, "damping.alpha": 0.0, "response": 1}[name])
    wing.exit_initialization_mode()
    assert wing.do_step(0.0, 1.0) is True


def test_a_failing_computation_is_a_refusal(make_slave: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    wing = make_slave()
    before = wing.everything()

    def fail(*_: object) -> None:
        raise np.linalg.LinAlgError("singular")

    with monkeypatch.context() as patch:
        patch.setattr(ReducedModel, "static_response", fail)
        assert wing.do_step(0.0, 1.0) is False
    assert wing.of("status") == STATUS_INTERNAL
    assert "singular" in wing.log_queue[-1].msg
    assert wing.everything()[:37] == before[:37]
    assert wing.do_step(0.0, 1.0) is True


@given(
    steps=st.lists(st.tuples(st.floats(-1.0, 4.0), st.floats(0.0, 0.85), st.floats(1e-3, 2.0)), max_size=4),
    later=st.lists(st.tuples(st.floats(-1.0, 4.0), st.floats(0.0, 0.85), st.floats(1e-3, 2.0)), max_size=3),
    transient=st.booleans(),
)
def test_a_restored_state_has_the_same_future(
    make_slave: Any, steps: list[tuple[float, ...]], later: list[tuple[float, ...]], transient: bool
) -> None:
    def fly(wing: Any, time: float, course: list[tuple[float, ...]]) -> float:
        for load_factor, z1, size in course:
            wing.set_real([N, Z1], [load_factor, z1])
            assert wing.do_step(time, size), wing.log_queue
            time += size
        return time

    wing = make_slave(response=2.0 if transient else 1.0, initial_tip_displacement=0.02, mass__pitot=0.11)
    time = fly(wing, 0.0, steps)
    wing.put("tip_force", 3.0)  # set, and not yet stepped with
    content = wing._fmu_state_to_bytes(wing._get_fmu_state())
    other = make_slave()
    other._set_fmu_state(other._fmu_state_from_bytes(content))
    assert other.everything() == wing.everything()
    assert fly(wing, time, later) == fly(other, time, later)
    assert other.everything() == wing.everything()
    assert other._get_fmu_state() == wing._get_fmu_state()


def test_a_state_of_something_else_is_refused(make_slave: Any) -> None:
    wing = make_slave()
    before = wing.everything()
    state = wing._get_fmu_state()
    foreign = state.replace(b"tag\0", b"gat\0")
    for wrong in (b"", b"x" * 500, state[:-8], foreign, None):
        wing._set_fmu_state(wrong)
        assert wing.of("status") == STATUS_BAD_STATE
        assert "was not restored" in wing.log_queue[-1].msg
    assert wing.everything()[:37] == before[:37]
    assert wing.do_step(0.0, 1.0)
