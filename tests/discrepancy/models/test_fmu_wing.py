"""Our own wing FMU as a model, against the wing model of the same design; its effects used."""

import json
import tomllib
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import pytest

from discrepancy.campaign.records import Quantity, Release, Trial, TrialKind
from discrepancy.errors import ModelError
from discrepancy.models.fmu import FmuModel
from discrepancy.models.structures import WingModel
from fe.runtime.patch import ModelPatch, PointMass, PowerDamping, RootCompliance
from fmu_asset.packing.patch_file import parse_patch
from fmu_asset.packing.structure_fmu import build_fmu
from tests.discrepancy.asking import FloatArray, campaign, seen, trial
from tests.fmu_asset.ours import wing_arrays, wing_model
from tests.refusals import Inputs

TEXT = Inputs(__file__).text("wing.toml")
OUTPUTS = (
    ("strain[1]", Quantity.STRAIN), ("strain[9]", Quantity.STRAIN),
    ("tip_displacement", Quantity.DISPLACEMENT), ("load_point_displacement", Quantity.DISPLACEMENT),
)  # fmt: skip
CARRIED = {"mass": PointMass(0.02, 1.2), "root": RootCompliance(1e-5)}
STATE = {"parameters": np.array([1.02, 0.17, 0.13, 1.1, 5e-4])}


def record(kind: TrialKind, count: int, **said: Any) -> Trial:
    return trial(kind, np.arange(count) * 0.002, run="A", **said)


LOADS = record(TrialKind.STATIC, 5, force=np.linspace(-10.0, 10.0, 5))
FLIGHT = record(TrialKind.FLIGHT, 3, load_factor=np.array([1.0, 2.0, 3.0]))
RINGDOWN = record(TrialKind.RINGDOWN, 400, release=Release(0.01))


class Pair(NamedTuple):
    """A wing on a coarse mesh as an FMU with two effects, and as a wing model."""

    fmu: FmuModel
    wing: WingModel

    def both(self, case: Trial, *items: Any, **given: Any) -> list[FloatArray]:
        return [seen(model, case, OUTPUTS, *items, **STATE | given) for model in self]

    def share(self, case: Trial, *items: Any, **given: Any) -> float:
        """Return the largest difference as a share of each output.

        Of ring-downs with equal amplitude, when modes beyond the sixth have died: the FMU without effects
        has eight, and it is held where its modes show the release point, the wing model where the whole
        shape does.
        """
        mine, exact = self.both(case, *items, **given)
        if case.is_dynamic:
            mine, exact = mine[20:], exact[20:]
            mine = mine * np.sum(mine * exact) / np.sum(mine * mine)
        return float(np.max(np.max(np.abs(mine - exact), axis=0) / np.max(np.abs(exact), axis=0)))


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Pair]:
    chain, arrays, folder = wing_model(), wing_arrays(), tmp_path_factory.mktemp("wing")
    rows = [{"id": name, "primitives": ModelPatch((item,)).to_list()} for name, item in CARRIED.items()]
    content = {"schema": "uav-twin patch 1", "effects": rows, "channels": {}}
    build_fmu(chain, folder / "wing.fmu", patch=parse_patch(json.dumps(content).encode()), arrays=arrays)
    (folder / "wing.toml").write_text(TEXT, encoding="utf-8")
    model = FmuModel.load(folder / "wing.toml")
    prior = {row["name"]: (row["mean"], row["deviation"]) for row in tomllib.loads(TEXT)["parameter"]}
    yield Pair(model, WingModel(arrays, prior=prior))
    model.close()


@pytest.mark.parametrize(("case", "tolerance"), [(LOADS, 3e-3), (FLIGHT, 3e-3), (RINGDOWN, 1e-4)])
@pytest.mark.parametrize("state", [{}, {"health": np.array([[0.2, 0.3]])}])
def test_it_is_the_wing(pair: Pair, case: Trial, tolerance: float, state: dict[str, Any]) -> None:
    assert pair.share(case, **state) < tolerance
    # With an effect of no size both are the same wing, where it rests in the same basis.
    assert pair.share(case, PointMass(1e-9, 0.9), **state) < (1e-4 if case.is_dynamic else 1e-8)


@pytest.mark.parametrize("item", [PointMass(0.3, 0.9), RootCompliance(3e-4)])
def test_effects_that_the_fmu_carries_are_used(pair: Pair, item: Any) -> None:
    assert all(model.supports(type(item)) for model in pair)
    (plain, _), (changed, _) = pair.both(RINGDOWN), pair.both(RINGDOWN, item)
    assert np.max(np.abs(changed - plain)) > 0.01 * np.max(np.abs(plain))
    assert pair.share(RINGDOWN, item) < 1e-4
    assert pair.share(LOADS, item) < 1e-8
    with pytest.raises(ModelError, match=f"two primitives '{item.kind}'"):
        pair.both(LOADS, item, item)


@pytest.mark.long
def test_scales_and_a_law_at_the_tip(pair: Pair) -> None:
    mine, exact = (model.scales(campaign(RINGDOWN)) for model in pair)
    for name in ("tip_stiffness", "modal_mass", "angular_frequency"):
        assert getattr(mine, name) == pytest.approx(getattr(exact, name), rel=1e-3), name
    stiffness = exact.ports["tip"].stiffness
    assert mine.ports["tip"].stiffness == pytest.approx(stiffness, rel=1e-3)
    # without a velocity output: that of the FMU's ports as a linear system is taken
    law = PowerDamping("tip", 0.05 * stiffness * 0.01, 2.0, 0.0, exact.angular_frequency * 0.01, 1.0)
    assert pair.share(RINGDOWN, law) < 3e-3
