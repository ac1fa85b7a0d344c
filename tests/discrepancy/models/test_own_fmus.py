"""Structures and the wing as models, and their FMUs by the files that are written beside them: the same."""

import json
import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from discrepancy.campaign.protocol import Release
from discrepancy.campaign.records import Quantity, Trial, TrialKind
from discrepancy.errors import ModelError
from discrepancy.models.fmu import FmuModel
from discrepancy.models.structures import StructureModel, WingModel
from discrepancy.models.system_model import SystemModel
from fe.reduction.reduced_basis import reduce_structure
from fe.runtime.patch import ModelPatch, PointMass, PowerDamping, PowerStiffness, RootCompliance
from fe.runtime.transient import ModalIntegrator
from fe.structure.design import load_structure
from fe.structure.operators import load_and_assemble
from fmu_asset.errors import FmuBuildError
from fmu_asset.packing.patch_file import parse_patch
from fmu_asset.packing.structure_fmu import build_fmu
from fmu_asset.structures import rig_text
from tests.discrepancy.asking import FloatArray, campaign, seen, trial
from tests.discrepancy.rigs import INPUTS
from tests.fmu_asset.ours import wing_arrays, wing_model

BEAM = {"tip": Quantity.DISPLACEMENT, "g1": Quantity.STRAIN}
MOVING = BEAM | {"shake": Quantity.ACCELERATION}
WING = {
    "strain[1]": Quantity.STRAIN, "strain[9]": Quantity.STRAIN,
    "tip_displacement": Quantity.DISPLACEMENT, "load_point_displacement": Quantity.DISPLACEMENT,
}  # fmt: skip
EFFECTS = {"mass": PointMass(0.02, 1.2), "root": RootCompliance(1e-5)}


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

        Of ring-downs of the wing with equal amplitude, when modes beyond the sixth have died: the FMU without
        effects has eight, and it is held where its modes show the release point, the wing model where the
        whole shape does.
        """
        exact, mine = self.both(what, *items, **given)
        if what.is_dynamic and isinstance(self.own, WingModel):
            mine, exact = mine[20:], exact[20:]
            mine = mine * np.sum(mine * exact) / np.sum(mine * mine)
        return float(np.max(np.abs(mine - exact).max(axis=0) / np.abs(exact).max(axis=0)))


def record(kind: TrialKind, count: int, interval: float, **said: Any) -> Trial:
    return trial(kind, np.arange(count) * interval, run="A", **said)


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


def test_it_is_the_structure_in_motion(beam: Pair, pushed_beam) -> None:
    """A tip that is held aside and let go, with its acceleration."""
    reduced = pushed_beam[1]
    unit = reduced.static_response({"load_factor": 0.0, "push": 1.0}).displacement[0]
    held, free = (reduced.vector({"load_factor": 0.0, "push": force}) for force in (1e-4 / unit, 0.0))
    motion, load = ModalIntegrator(reduced, held, *reduced.damping), reduced.load_coefficients(free)
    start, shown = motion.at_rest(reduced.load_coefficients(held)), [len(reduced.gauges), 0, -1]
    times = RELEASED.time[1:].tolist()
    wanted = np.array([motion.outputs(motion.advance(start, time, load))[shown] for time in times])
    released = replace(RELEASED, release=Release(1e-4))
    for values in beam.both(released, outputs=MOVING, parameters=np.array([1.0, 0.05])):
        assert np.abs((values[1:] - wanted) / np.abs(wanted).max(axis=0)).max() < 1e-3


@pytest.mark.parametrize("kind", [TrialKind.STATIC, TrialKind.FLIGHT, TrialKind.RINGDOWN, TrialKind.FORCED])
@pytest.mark.parametrize("laws", [(), (SPRING,)])
def test_it_is_its_fmu(kind: TrialKind, laws: tuple[PowerStiffness, ...], beam: Pair) -> None:
    """All kinds of trials, with and without a spring at the tip."""
    one, other = (
        [(p.name, p.mean, pytest.approx(p.deviation), p.low, p.high) for p in model.parameters]
        for model in beam[:2]
    )
    assert one == other
    load = np.sin(np.arange(40) / 4.0 + 0.5 * (not laws))
    acts = {TrialKind.FLIGHT: {"load_factor": load}, TrialKind.RINGDOWN: {"release": RELEASED.release}}
    what = record(kind, 40, 2e-5, **acts.get(kind, {"force": 50.0 * load}))
    assert beam.share(what, *laws) < (5e-3 if what.is_dynamic else 1e-8)


def test_the_fmu_is_not_asked_again_for_another_law(beam: Pair, monkeypatch) -> None:
    """Nor are springs of next to no stiffness, which change nothing, whatever steps they take."""
    model, asked = beam.fmu, []
    begun = model.fmu.begun
    monkeypatch.setattr(model.fmu, "begun", lambda run: (asked.append(run), begun(run))[1])
    for e in (1.0, 1.03):
        given = {"parameters": np.array([e, 0.05])}
        wanted = seen(model, RELEASED, MOVING, **given)
        for number, force in enumerate((1e-9, 1e-6, 100.0)):
            before = len(asked)
            values = seen(model, RELEASED, MOVING, PowerStiffness("tip", force, 3.0, 0, 1e-4), **given)
            if force < 1.0:
                np.testing.assert_array_less(
                    np.abs(values - wanted).max(axis=0), 1e-6 * np.abs(wanted).max(axis=0)
                )
            assert (len(asked) == before) == (number > 0)


def test_what_no_trial_records_acts_always(write_beam, tmp_path: Path) -> None:
    """Gravity, where it is no load factor: at rest, and as a shift of what moves."""
    changes = {"load_factor": "gee", 'set = "end", force': "point = [100, 10, 5], force"}
    reduced = reduce_structure(load_and_assemble(write_beam(tmp_path, changes, cells=2))).model
    model, wanted = StructureModel(reduced), reduced.static_response({"push": 0.0})
    still = {"force": np.zeros(3)}
    for what in (record(TrialKind.STATIC, 3, 1e-4, **still), record(TrialKind.FORCED, 3, 1e-4, **still)):
        found = seen(model, what, BEAM, parameters=model.prior_mean())
        assert found == pytest.approx(np.tile([wanted.displacement[0], wanted.strain[0]], (3, 1)), rel=1e-9)


def test_a_structure_without_a_force_is_refused(write_beam, tmp_path: Path) -> None:
    design = load_structure(write_beam(tmp_path, {'unit = "N", ': "", "load_factor": "gee"}, cells=1))
    with pytest.raises(FmuBuildError, match="no control in N and no load_factor"):
        rig_text(design, "beam.fmu")


# ---------------------------------------------------------------- the wing

LOADS = record(TrialKind.STATIC, 5, 0.002, force=np.linspace(-10.0, 10.0, 5))
FLIGHT = record(TrialKind.FLIGHT, 3, 0.002, load_factor=np.array([1.0, 2.0, 3.0]))
RINGDOWN = record(TrialKind.RINGDOWN, 400, 0.002, release=Release(0.01))


@pytest.fixture(scope="module")
def wing(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Pair]:
    """On a coarse mesh, with two effects in the FMU."""
    chain, arrays, folder = wing_model(), wing_arrays(), tmp_path_factory.mktemp("wing")
    rows = [{"id": name, "primitives": ModelPatch((item,)).to_list()} for name, item in EFFECTS.items()]
    content = {"schema": "uav-twin patch 1", "effects": rows, "channels": {}}
    build_fmu(chain, folder / "wing.fmu", patch=parse_patch(json.dumps(content).encode()), arrays=arrays)
    (folder / "wing.toml").write_text(INPUTS.text("wing.toml"), encoding="utf-8")
    model = FmuModel.load(folder / "wing.toml")
    prior = {row["name"]: (row["mean"], row["deviation"]) for row in INPUTS.table("wing.toml")["parameter"]}
    yield Pair(WingModel(arrays, prior=prior), model, WING, np.array([1.02, 0.17, 0.13, 1.1, 5e-4]))
    model.close()


@pytest.mark.parametrize(("what", "tolerance"), [(LOADS, 3e-3), (FLIGHT, 3e-3), (RINGDOWN, 1e-4)])
@pytest.mark.parametrize("state", [{}, {"health": np.array([[0.2, 0.3]])}])
def test_it_is_the_wing(wing: Pair, what: Trial, tolerance: float, state: dict[str, Any]) -> None:
    assert wing.share(what, **state) < tolerance
    # With an effect of no size both are the same wing, where it rests in the same basis.
    assert wing.share(what, PointMass(1e-9, 0.9), **state) < (1e-4 if what.is_dynamic else 1e-8)


@pytest.mark.parametrize("item", [PointMass(0.3, 0.9), RootCompliance(3e-4)])
def test_effects_that_the_fmu_carries_are_used(wing: Pair, item: Any) -> None:
    assert all(model.supports(type(item)) for model in wing[:2])
    (_, plain), (_, changed) = wing.both(RINGDOWN), wing.both(RINGDOWN, item)
    assert np.max(np.abs(changed - plain)) > 0.01 * np.max(np.abs(plain))
    assert wing.share(RINGDOWN, item) < 1e-4
    assert wing.share(LOADS, item) < 1e-8
    with pytest.raises(ModelError, match=f"two primitives '{item.kind}'"):
        wing.both(LOADS, item, item)


@pytest.mark.long
def test_scales_and_a_law_at_the_tip(wing: Pair) -> None:
    exact, mine = (model.scales(campaign(RINGDOWN)) for model in wing[:2])
    for name in ("tip_stiffness", "modal_mass", "angular_frequency"):
        assert getattr(mine, name) == pytest.approx(getattr(exact, name), rel=1e-3), name
    stiffness = exact.ports["tip"].stiffness
    assert mine.ports["tip"].stiffness == pytest.approx(stiffness, rel=1e-3)
    # without a velocity output: that of the FMU's ports as a linear system is taken
    law = PowerDamping("tip", 0.05 * stiffness * 0.01, 2.0, 0.0, exact.angular_frequency * 0.01, 1.0)
    assert wing.share(RINGDOWN, law) < 3e-3
