"""Our own wing FMU as a model, against the wing model of the same chain of springs; its effects used."""

import importlib.util
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from discrepancy.campaign.records import Campaign, Quantity, Release, Trial, TrialKind
from discrepancy.errors import ModelError
from discrepancy.models.fmu import FmuModel
from discrepancy.models.interface import Conditions
from discrepancy.models.wing import WingModel
from fe.runtime.patch import ModelPatch, PointMass, PowerDamping, Primitive, RootCompliance
from fmu_asset.packing.patch_file import parse_patch
from fmu_asset.packing.structure_fmu import build_fmu

OUTPUTS = (
    ("strain[1]", Quantity.STRAIN), ("strain[9]", Quantity.STRAIN),
    ("tip_displacement", Quantity.DISPLACEMENT),
    ("load_point_displacement", Quantity.DISPLACEMENT),
)  # fmt: skip
CARRIED: dict[str, Primitive] = {"mass": PointMass(0.02, 1.2), "root": RootCompliance(1e-5)}
CONDITIONS = Conditions(np.array([1.02, 0.17, 0.13, 1.1, 5e-4]))

WING = """
format = 1
kind = "fmu"
name = "Chain as a wing FMU"
fmu = "wing.fmu"
binding = "uav_wing_laboratory"
inputs = { force = "tip_force", load_factor = "load_factor", z1 = "z1", z2 = "z2" }
static = { parameters = { response = 1.0 } }
motion = { parameters = { response = 2.0 } }
release = { displacement = "initial_tip_displacement", output = "load_point_displacement" }
output = [
  { name = "strain[{1..24}]", quantity = "strain" },
  { name = "tip_displacement" },
  { name = "load_point_displacement" },
]
port = [{ name = "tip", force = "tip_force", displacement = "load_point_displacement" }]
effects = { point_mass = "mass", root_compliance = "root" }
scales = { length = 1.6 }
"""
PARAMETERS = (
    ("young_modulus_factor", 1.0, 0.01, 0.85, 1.15, "1"),
    ("servo_mass", 0.17, 0.004, 0.1, 0.25, "kg"),
    ("pitot_mass", 0.13, 0.008, 0.1, 0.2, "kg"),
    ("damping_alpha", 1.0, 0.3, 0.0, 20.0, "1/s"),
    ("damping_beta", 5e-4, 1e-5, 0.0, 1e-2, "s"),
)


def chains() -> ModuleType:
    path = Path(__file__).parents[2] / "fmu_asset" / "conftest.py"
    specification = importlib.util.spec_from_file_location("fmu_chain", path)
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[FmuModel, WingModel]]:
    """One chain of springs as an FMU with two effects, and as a wing model."""
    module = chains()
    chain = module.chain_model()
    arrays = module.chain_arrays(chain)
    folder = tmp_path_factory.mktemp("wing")
    rows = [{"id": name, "primitives": ModelPatch((item,)).to_list()} for name, item in CARRIED.items()]
    effects = parse_patch(
        json.dumps({"schema": "uav-twin patch 1", "effects": rows, "channels": {}}).encode()
    )
    build_fmu(chain, folder / "wing.fmu", patch=effects, arrays=arrays)
    text = WING + "".join(
        f'\n[[parameter]]\nname = "{name}"\nmean = {mean}\ndeviation = {deviation}\nlow = {low}\n'
        f'high = {high}\nunit = "{unit}"\n'
        for name, mean, deviation, low, high, unit in PARAMETERS
    )
    (folder / "wing.toml").write_text(text, encoding="utf-8")
    model = FmuModel.load(folder / "wing.toml")
    yield model, WingModel(arrays, prior={name: (mean, spread) for name, mean, spread, *_ in PARAMETERS})
    model.close()


def trial(kind: TrialKind, count: int, **changes: object) -> Trial:
    return Trial.plain("a trial", kind, (), np.arange(count) * 0.002, run="A", **changes)


LOADS = trial(TrialKind.STATIC, 5, force=np.linspace(-10.0, 10.0, 5))
FLIGHT = trial(TrialKind.FLIGHT, 3, load_factor=np.array([1.0, 2.0, 3.0]))
RINGDOWN = trial(TrialKind.RINGDOWN, 400, release=Release(0.01))


def share(pair: tuple[FmuModel, WingModel], case: Trial, patch: ModelPatch, conditions: Conditions) -> float:
    """Return the largest difference as a share of each output.

    Of ring-downs with equal amplitude, when modes beyond the sixth have died: the FMU without effects has
    eight, and it is held where its modes show the release point, the wing model where the whole shape does.
    """
    mine = pair[0].respond(case, OUTPUTS, patch, conditions).values
    exact = pair[1].respond(case, OUTPUTS, patch, conditions).values
    if case.is_dynamic:
        mine, exact = mine[20:], exact[20:]
        mine = mine * np.sum(mine * exact) / np.sum(mine * mine)
    return float(np.max(np.max(np.abs(mine - exact), axis=0) / np.max(np.abs(exact), axis=0)))


@pytest.mark.parametrize(("case", "tolerance"), [(LOADS, 1e-9), (FLIGHT, 1e-9), (RINGDOWN, 1e-4)])
def test_it_is_the_wing(pair: tuple[FmuModel, WingModel], case: Trial, tolerance: float) -> None:
    for conditions in (CONDITIONS, replace(CONDITIONS, health=np.array([[0.2, 0.3]]))):
        assert share(pair, case, ModelPatch(), conditions) < tolerance


def test_effects_that_the_fmu_carries_are_used(pair: tuple[FmuModel, WingModel]) -> None:
    fmu, wing = pair
    assert fmu.supports(PointMass)
    assert fmu.supports(RootCompliance)
    for patch in (ModelPatch((PointMass(0.3, 0.9),)), ModelPatch((RootCompliance(3e-4),))):
        plain = fmu.respond(RINGDOWN, OUTPUTS, ModelPatch(), CONDITIONS).values
        changed = fmu.respond(RINGDOWN, OUTPUTS, patch, CONDITIONS).values
        assert np.max(np.abs(changed - plain)) > 0.01 * np.max(np.abs(plain))
        assert share(pair, RINGDOWN, patch, CONDITIONS) < 1e-4
        assert share(pair, LOADS, patch, CONDITIONS) < 1e-8
    with pytest.raises(ModelError, match="two primitives 'point_mass'"):
        fmu.respond(LOADS, OUTPUTS, ModelPatch((PointMass(0.1, 0.5), PointMass(0.1, 0.6))), CONDITIONS)
    assert wing.supports(PointMass)


@pytest.mark.long
def test_scales_and_a_law_at_the_tip(pair: tuple[FmuModel, WingModel]) -> None:
    fmu, wing = pair
    campaign = Campaign("", {}, (RINGDOWN,), None, {}, "")
    mine, exact = fmu.scales(campaign), wing.scales(campaign)
    for name in ("tip_stiffness", "modal_mass", "angular_frequency"):
        assert getattr(mine, name) == pytest.approx(getattr(exact, name), rel=1e-3), name
    stiffness = exact.ports["tip"].stiffness
    assert mine.ports["tip"].stiffness == pytest.approx(stiffness, rel=1e-3)
    # without a velocity output: that of the FMU's ports as a linear system is taken
    law = PowerDamping("tip", 0.05 * stiffness * 0.01, 2.0, 0.0, exact.angular_frequency * 0.01, 1.0)
    assert share(pair, RINGDOWN, ModelPatch((law,)), CONDITIONS) < 3e-3
