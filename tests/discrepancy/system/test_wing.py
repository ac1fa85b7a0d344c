"""The wing as a model, against matrices and closed forms; it, a structure and their FMUs: the same."""

import json
import os
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from scipy.linalg import eigh

from calibration.result.file import save_calibration
from discrepancy.campaign.protocol import Release
from discrepancy.campaign.records import Quantity, Trial, TrialKind
from discrepancy.errors import ModelError
from discrepancy.fmu_models.model import FmuModel
from discrepancy.system.structures import StructureModel
from discrepancy.system.system_model import SystemModel
from discrepancy.system.system_state import SystemState
from discrepancy.system.wing_model import WingModel
from fe.reduction.built_once import cache_folder
from fe.reduction.model_cache import cache_file
from fe.reduction.reduced_basis import reduce_structure
from fe.runtime.patch import ModelPatch, PointMass, PowerDamping, PowerStiffness, Primitive, SupportCompliance
from fe.runtime.patch_arrays import PatchArrays
from fe.runtime.reduced import ReducedModel
from fe.structure.design import load_structure
from fe.structure.operators import load_and_assemble
from fe.wing.design import load_design
from fmu_asset.errors import FmuBuildError
from fmu_asset.packing.patch_file import parse_patch
from fmu_asset.packing.structure_fmu import build_fmu
from fmu_asset.structures import rig_text
from tests.discrepancy.rigs import INPUTS, FloatArray, asked, campaign, chosen, integrated, seen, setting_of
from tests.fmu_asset.ours import wing_arrays, wing_model

OUTPUTS = {"strain[9]": Quantity.STRAIN} | dict.fromkeys(
    ("tip_displacement", "displacement[1.1, 0.6]"), Quantity.DISPLACEMENT
)
RING = asked(TrialKind.RINGDOWN, np.arange(400) / 200.0, release=Release(displacement=0.03), run="A")
LATE = RING.time > 0.03  # what more than six modes do has died out


@pytest.fixture(scope="module")
def wing(coarse_patch_arrays: PatchArrays) -> WingModel:
    return WingModel(coarse_patch_arrays)


def modes(wing: WingModel, count: int) -> tuple[Any, Any, Any]:
    """Squares, shapes and modal coordinates of the release of `RING`, of the wing as it is believed."""
    system = wing.system_in_state(SystemState(tuple(wing.prior_mean().tolist()), (0.0, 0.0)))
    tip = wing.wing.force_row("tip_load")
    square, shapes = eigh(system.stiffness, system.mass, subset_by_index=[0, count - 1])
    held = np.linalg.solve(system.stiffness, tip)
    return square, shapes, shapes.T @ system.mass @ (0.03 / float(tip @ held) * held)


# ---------------------------------------------------------------- forces over the planform


def test_drag_over_the_planform_is_the_integral_over_the_area(wing: WingModel) -> None:
    """Against the modes with drag at every station of the mesh, by a general integrator."""
    drag, (square, shapes, start) = 4.0, modes(wing, 6)  # N at 1 m/s everywhere
    alpha, beta = wing.prior_mean()[3:]
    rows, weights = wing.wing.arrays.line_rows[2] @ shapes, wing.wing.arrays.station_weights

    def rates(_: float, state: Any) -> Any:
        q, v = state[:6], state[6:]
        speed = rows @ v
        push = -(alpha + beta * square) * v - square * q - drag * (weights * np.abs(speed) * speed) @ rows
        return np.concatenate((v, push))

    moved = integrated(rates, RING.time, np.concatenate((start, np.zeros(6))), rtol=1e-9)
    wanted = moved[:, :6] @ (np.array([wing.wing.output_row(name) for name in OUTPUTS]) @ shapes).T

    def off(size: float) -> float:
        air = PowerDamping("planform", size, 2.0, 0.0, 1.0, 1.0)
        values = seen(wing, RING, OUTPUTS, air, parameters=wing.prior_mean())
        return float(np.abs((values - wanted)[LATE] / np.abs(wanted).max(axis=0)).max())

    assert off(drag) < 2e-3
    assert off(0.0) > 0.1


@pytest.mark.parametrize(("velocity", "displacement"), [(1.4, 0.0), (2.0, 0.6)])
def test_effects_over_the_planform_are_as_large_as_they_say_of_the_first_mode(
    wing: WingModel, velocity: float, displacement: float
) -> None:
    """With every station of the mesh: 2 pi zeta k A^2 in a cycle, and a share of the spring's force."""
    square, shapes, _ = modes(wing, 1)
    share, motion = wing.wing.arrays.station_weights, wing.wing.arrays.line_rows[2] @ shapes[:, 0]
    mean = float(share @ motion)
    stiffness, frequency, motion = float(square[0]) / mean**2, float(np.sqrt(square[0])), motion / mean
    setting = setting_of(campaign(RING), wing)
    drag, spring = chosen("quadratic_damping", "cubic_stiffness")
    assert (drag.places(setting), spring.places(setting)) == (("planform",), ("tip", "planform"))
    shape = {"velocity_exponent": velocity, "displacement_exponent": displacement}
    (force,) = drag.patch(setting, {"equivalent_damping_ratio": 0.01, **shape}, "planform")
    size = setting.scales.ports["planform"].displacement
    moved = np.abs(motion) * size
    at_place = share * force.coefficient * (moved * frequency / force.reference_velocity) ** velocity
    at_place *= (moved / force.reference_displacement) ** displacement
    angle = (np.arange(400_000) + 0.5) * 2.0 * np.pi / 400_000  # of a cycle
    cycle = np.abs(np.cos(angle)) ** (velocity + 1.0) * np.abs(np.sin(angle)) ** displacement
    loss = float(at_place @ moved) * 2.0 * np.pi * np.mean(cycle)
    assert loss == pytest.approx(2.0 * np.pi * 0.01 * stiffness * size**2, rel=1e-2)
    (force,) = spring.patch(setting, {"stiffening": 0.2}, "planform")
    size = setting.scales.ports["planform"].largest_displacement
    at_place = share * force.coefficient * (motion * size / force.reference_displacement) ** 3
    assert float(at_place @ motion) == pytest.approx(0.2 * stiffness * size, rel=1e-2)


def test_the_posterior_of_a_calibration_is_the_prior(
    make_calibration, coarse_patch_arrays, tmp_path: Path, monkeypatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    design = load_design().changed(mesh={"refinement": 0.25})
    cache_folder().mkdir()
    cache_file("patches", design.hash, None).write_bytes(coarse_patch_arrays.to_bytes())
    result = replace(make_calibration(), design=design, design_hash=design.hash)
    save_calibration(result, tmp_path / "wing.nc")
    model = WingModel.of_calibration(tmp_path / "wing.nc")
    assert model.name == result.asset
    assert [item.mean for item in model.parameters] == pytest.approx(result.samples.mean(axis=0)[:5])
    assert [item.deviation for item in model.parameters] == pytest.approx(result.samples.std(axis=0)[:5])


# ---------------------------------------------------------------- FMUs by the files beside them


BEAM = {"tip": Quantity.DISPLACEMENT, "g1": Quantity.STRAIN}
SHAKEN = {"shake": Quantity.ACCELERATION}
WING = {
    "strain[1]": Quantity.STRAIN, "strain[9]": Quantity.STRAIN,
    "tip_displacement": Quantity.DISPLACEMENT, "load_point_displacement": Quantity.DISPLACEMENT,
}  # fmt: skip


class Pair(NamedTuple):
    """A model by its matrices and its FMU, what they show, and at which parameters."""

    own: SystemModel
    fmu: FmuModel
    outputs: dict[str, Quantity]
    parameters: FloatArray

    def both(self, what: Trial, *items: Any, **given: Any) -> list[FloatArray]:
        outputs = given.pop("outputs", self.outputs)
        usual = {"parameters": self.parameters}
        return [seen(model, what, outputs, *items, **usual | given) for model in self[:2]]

    def share(self, what: Trial, *items: Any, **given: Any) -> float:
        """Return the largest difference as a share of each output.

        Of ring-downs of the wing with equal amplitude, when modes beyond the sixth have died: it is held
        where its modes show the release point, the wing model where the whole shape does.
        """
        exact, mine = self.both(what, *items, **given)
        if what.is_dynamic and isinstance(self.own, WingModel):
            mine, exact = mine[20:], exact[20:]
            mine = mine * np.sum(mine * exact) / np.sum(mine * mine)
        return float(np.max(np.abs(mine - exact).max(axis=0) / np.abs(exact).max(axis=0)))


def record(kind: TrialKind, count: int, interval: float, **said: Any) -> Trial:
    return asked(kind, np.arange(count) * interval, run="A", **said)


# ---------------------------------------------------------------- a beam

PUSHED = record(TrialKind.STATIC, 40, 1e-4, force=np.linspace(-100.0, 200.0, 40))
RELEASED = record(TrialKind.RINGDOWN, 40, 1e-4, release=Release(1e-4, mode_count=1))
SPRING = PowerStiffness("tip", 10.0, 3.0, 0, 1e-4)


@pytest.fixture(scope="module")
def beam(pushed_beam, tmp_path_factory) -> Iterator[Pair]:
    folder, (file, reduced) = tmp_path_factory.mktemp("rig"), pushed_beam
    fmu = build_fmu(reduced, folder / "beam.fmu").path
    path = folder / "rig.toml"
    path.write_text(rig_text(load_structure(file), os.path.relpath(fmu, folder)), encoding="utf-8")
    model = FmuModel.load(path)
    yield Pair(StructureModel(reduced), model, BEAM, np.array([1.02, 0.07]))
    model.close()


def test_it_is_the_structure_at_rest(beam: Pair, pushed_beam) -> None:
    """Without a recorded load factor there is no weight; a region is known by its name."""
    named = replace(PUSHED, regions=("other", "z2", "z1"))
    for health in (np.zeros((1, 3)), np.array([[0.0, 0.2, 0.3]])):
        found = (
            pushed_beam[1].static_response(
                {"e": 1.02, "pump": 0.07, "load_factor": 0.0, "push": force},
                {"z1": health[0, 2], "z2": health[0, 1]},
            )
            for force in PUSHED.force.tolist()
        )
        wanted = [[item.displacement[0], item.strain[0]] for item in found]
        for values in beam.both(named, health=health):
            np.testing.assert_allclose(values, wanted, rtol=1e-10, atol=1e-15)
    with pytest.raises(ModelError, match=r"a loss of the damage region 'other', but .*beam.* has z1, z2"):
        beam.both(named, health=health[:, ::-1])


KINDS_OF_TRIALS = pytest.mark.parametrize(
    "kind", [TrialKind.STATIC, TrialKind.FLIGHT, TrialKind.RINGDOWN, TrialKind.FORCED]
)
WITH_AND_WITHOUT_SPRING = pytest.mark.parametrize("laws", [(), (SPRING,)], ids=["plain", "spring at the tip"])


def trial_of_kind(kind: TrialKind, phase: float) -> Trial:
    """Return forty samples of a trial under a load that oscillates, or of the release."""
    load = np.sin(np.arange(40) / 4.0 + phase)
    actions = {TrialKind.FLIGHT: {"load_factor": load}, TrialKind.RINGDOWN: {"release": RELEASED.release}}
    return record(kind, 40, 2e-5, **actions.get(kind, {"force": 50.0 * load}))


def test_it_has_the_parameters_of_its_fmu(beam: Pair) -> None:
    model, fmu = (
        [(p.name, p.mean, pytest.approx(p.deviation), p.low, p.high) for p in model.parameters]
        for model in beam[:2]
    )
    assert model == fmu


@KINDS_OF_TRIALS
@WITH_AND_WITHOUT_SPRING
def test_it_responds_as_its_fmu(kind: TrialKind, laws: tuple[PowerStiffness, ...], beam: Pair) -> None:
    trial = trial_of_kind(kind, phase=0.0 if laws else 0.5)
    assert beam.share(trial, *laws) < (5e-3 if trial.is_dynamic else 1e-8)


@pytest.mark.parametrize("kind", [TrialKind.RINGDOWN, TrialKind.FORCED])
@WITH_AND_WITHOUT_SPRING
def test_it_has_the_accelerations_of_its_fmu(
    kind: TrialKind, laws: tuple[PowerStiffness, ...], beam: Pair
) -> None:
    """From the first step on: the FMU shows no acceleration as it is let go."""
    trial = trial_of_kind(kind, phase=0.0 if laws else 0.5)
    of_model, of_fmu = (values[1:] for values in beam.both(trial, *laws, outputs=SHAKEN))
    assert np.abs(of_model - of_fmu).max() < 5e-3 * np.abs(of_model).max()


@pytest.fixture
def beam_under_gravity(write_beam, tmp_path: Path) -> ReducedModel:
    """The beam whose gravity is an input of its own, not a load factor."""
    changes = {"load_factor": "gee", 'set = "end", force': "point = [100, 10, 5], force"}
    return reduce_structure(load_and_assemble(write_beam(tmp_path, changes, cells=2))).model


UNLOADED = [record(kind, 3, 1e-4, force=np.zeros(3)) for kind in (TrialKind.STATIC, TrialKind.FORCED)]
"""At rest and in motion."""


@pytest.mark.parametrize("trial", UNLOADED, ids=["static", "forced"])
def test_what_no_trial_records_acts_always(trial: Trial, beam_under_gravity: ReducedModel) -> None:
    response = beam_under_gravity.static_response({"push": 0.0})
    expected = np.tile([response.displacement[0], response.strain[0]], (3, 1))
    model = StructureModel(beam_under_gravity)
    assert seen(model, trial, BEAM, parameters=model.prior_mean()) == pytest.approx(expected, rel=1e-6)


def test_what_acts_always_acts_on_a_spring_at_rest_and_in_motion(beam_under_gravity: ReducedModel) -> None:
    """The spring stiffens and holds more than half of the deflection."""
    model = StructureModel(beam_under_gravity)
    stiffening = PowerStiffness("tip", 100.0, 3.0, 0, 1e-6)
    free = seen(model, UNLOADED[0], BEAM, parameters=model.prior_mean())
    at_rest, in_motion = (
        seen(model, trial, BEAM, stiffening, parameters=model.prior_mean()) for trial in UNLOADED
    )
    assert in_motion == pytest.approx(at_rest, rel=1e-2)
    assert abs(at_rest[0, 0]) < 0.5 * abs(free[0, 0])


def test_a_force_down_beside_a_displacement_up_makes_the_port_of_that_displacement(
    write_beam, tmp_path: Path
) -> None:
    """A spring at the port stands against both forces alike."""
    tips = []
    for direction in ("1", "-1"):
        folder = tmp_path / direction
        folder.mkdir()
        push_at_tip = f"point = [100, 10, 5], force = [0, 0, {direction}]"
        beam = write_beam(folder, {'set = "end", force = [0, 0, 1]': push_at_tip}, cells=2)
        model = StructureModel(reduce_structure(load_and_assemble(beam)).model)
        assert model.ports == ("tip",)
        push = record(TrialKind.STATIC, 2, 1.0, force=np.array([0.0, 5.0]))
        stiff = PowerStiffness("tip", 1000.0, 1.0, 0, 1e-3)
        tips.append(seen(model, push, BEAM, stiff, parameters=model.prior_mean())[1, 0])
    assert tips[0] > 0.0
    assert tips[1] == pytest.approx(-tips[0], rel=1e-6)


def test_a_structure_without_a_force_is_refused(write_beam, tmp_path: Path) -> None:
    design = load_structure(write_beam(tmp_path, {'unit = "N", ': "", "load_factor": "gee"}, cells=1))
    with pytest.raises(FmuBuildError, match="no control in N and no load_factor"):
        rig_text(design, "beam.fmu")


# ---------------------------------------------------------------- the wing


CARRIED = {"mass": PointMass(0.02, 1.2), "root": SupportCompliance("root", "rx", 1e-5)}
"""Effects that the FMU is packed with."""

ADDED = [PointMass(0.3, 0.9), SupportCompliance("root", "rx", 3e-4)]
"""Effects that a hypothesis adds to them."""

LOADS = record(TrialKind.STATIC, 5, 0.002, force=np.linspace(-10.0, 10.0, 5))
LET_GO = record(TrialKind.RINGDOWN, 400, 0.002, release=Release(0.01))


@pytest.fixture(scope="module")
def carrying(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Pair]:
    """The wing on a coarse mesh, and its FMU with two effects that it carries."""
    folder = tmp_path_factory.mktemp("carrying")
    effects = [
        {"id": name, "primitives": ModelPatch((primitive,)).to_list()} for name, primitive in CARRIED.items()
    ]
    content = {"schema": "uav-twin patch 1", "effects": effects, "channels": {}}
    patch = parse_patch(json.dumps(content).encode())
    build_fmu(wing_model(), folder / "wing.fmu", patch=patch, arrays=wing_arrays())
    (folder / "wing.toml").write_text(INPUTS.text("wing.toml"), encoding="utf-8")
    prior = {row["name"]: (row["mean"], row["deviation"]) for row in INPUTS.table("wing.toml")["parameter"]}
    parameters = np.array([1.02, 0.17, 0.13, 1.1, 5e-4])
    with closing(FmuModel.load(folder / "wing.toml")) as fmu:
        yield Pair(WingModel(wing_arrays(), prior=prior), fmu, WING, parameters)


EACH_ADDED = pytest.mark.parametrize("primitive", ADDED, ids=lambda primitive: primitive.kind)


@EACH_ADDED
def test_effects_that_the_fmu_carries_are_supported(carrying: Pair, primitive: Primitive) -> None:
    assert all(model.supports(type(primitive)) for model in carrying[:2])


@EACH_ADDED
def test_effects_that_the_fmu_carries_are_used(carrying: Pair, primitive: Primitive) -> None:
    """In a release they change what the FMU shows, as they change what the model shows."""
    _, plain = carrying.both(LET_GO)
    _, changed = carrying.both(LET_GO, primitive)
    assert np.max(np.abs(changed - plain)) > 0.01 * np.max(np.abs(plain))
    assert carrying.share(LET_GO, primitive) < 1e-4
    assert carrying.share(LOADS, primitive) < 1e-8


@EACH_ADDED
def test_an_effect_that_the_fmu_carries_once_is_not_added_twice(carrying: Pair, primitive: Primitive) -> None:
    with pytest.raises(ModelError, match=f"two primitives '{primitive.kind}'"):
        carrying.both(LOADS, primitive, primitive)
