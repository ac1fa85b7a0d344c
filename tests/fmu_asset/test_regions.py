"""Wings with other damage regions than the shipped two, as FMUs of both kinds."""

from pathlib import Path

import numpy as np
import pytest

from fe.runtime.reduced import ReducedModel
from fe.runtime.state import TIP_FORCE, DigitalState
from fe.runtime.transient import ModalIntegrator
from fmu_asset.door.binding import Binding
from fmu_asset.door.session import FmiAsset
from fmu_asset.packing.structure_fmu import FmuKind, build_fmu
from tests.wings import wing_integrator

from .conftest import chain_model

REGIONS = ("z1", "z2", "tip_panel")
TURNS = [
    (1.0, (0.0, 0.0, 0.0)),
    (3.0, (0.0, 0.0, 0.5)),
    (2.0, (0.2, 0.0, 0.5)),
    (2.0, (0.2, 0.4, 0.8)),
    (-1.0, (0.2, 0.4, 0.8)),
]


@pytest.fixture(scope="module")
def three() -> ReducedModel:
    return chain_model(regions=REGIONS)


@pytest.fixture(scope="module", params=["python", "compiled"])
def packed(
    request: pytest.FixtureRequest, three: ReducedModel, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    kind: FmuKind = request.param
    state = DigitalState(stiffness_loss=(0.0, 0.0, 0.3))
    return build_fmu(three, tmp_path_factory.mktemp(kind) / "wing.fmu", kind=kind, state=state).path


@pytest.mark.parametrize("response", [1.0, 2.0])
def test_each_region_softens_its_own_part(
    packed: Path, three: ReducedModel, binding: Binding, response: float
) -> None:
    parameters = {"response": response, "damping_alpha": 1.0, "damping_beta": 1e-3}
    masses = {"servo_mass": 0.17, "pitot_mass": 0.13}
    fitted = binding.with_regions(REGIONS)
    assert list(fitted.health) == ["z1", "z2", "tip_panel"]
    assert fitted.health["z1"] == binding.health["z1"]

    def integrator(loss: tuple[float, ...]) -> ModalIntegrator:
        return wing_integrator(
            three,
            young_modulus_factor=1.0,
            stiffness_loss=loss,
            damping_alpha=1.0,
            damping_beta=1e-3,
            **masses,
        )

    moved, before = None, None
    with FmiAsset(packed, fitted, parameters=parameters | masses) as asset:
        asset.reset(control={"load_factor": 1.0}, health=dict.fromkeys(REGIONS, 0.0))
        for load_factor, loss in TURNS:
            health = dict(zip(REGIONS, loss, strict=True))
            seen = asset.step({"load_factor": load_factor}, health, {"tip_force": 0.0})
            wanted = three.static_response(
                young_modulus_factor=1.0, stiffness_loss=loss, load_factor=load_factor
            )
            if response == 2.0:
                now = integrator(loss)
                if moved is None or before is None:
                    moved = now.released(0.0, (1.0, 0.0), TIP_FORCE)
                else:
                    moved = now.take_over(moved, before)
                moved, before = now.advance(moved, fitted.step_size, (load_factor, 0.0)), now
                wanted_strain = now.outputs(moved)[:-1]
            else:
                wanted_strain = wanted.strain
            np.testing.assert_allclose(seen.values, wanted_strain, rtol=1e-9, atol=1e-15)


def test_an_fmu_starts_at_the_losses_of_its_state(packed: Path, three: ReducedModel) -> None:
    from fmu_asset.archive.fmu_file import read_fmu

    declared = {item.name: item for item in read_fmu(packed).variables}
    assert [name for name in declared if name.startswith("health.")] == [f"health.{name}" for name in REGIONS]
    assert float(declared["health.tip_panel"].start or "") == 0.3
    assert declared["tip_force"].reference == 4
