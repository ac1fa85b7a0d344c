"""Shared by all folders of tests: trials, campaigns, responses of models, effects by name, small rigs."""

import shutil
import tomllib
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from discrepancy.campaign.records import Campaign, Quantity, Trial, TrialKind
from discrepancy.catalogue.entry import Effect, Setting
from discrepancy.catalogue.library import effect_by_identifier, library
from discrepancy.document import Origin
from discrepancy.sources.examples import example_campaign, usual_plan, write_example
from discrepancy.system.interface import Model
from discrepancy.system.lumped_file import LumpedDescription
from discrepancy.system.lumped_model import LumpedModel
from discrepancy.system.response import Conditions
from discrepancy.workflow import Investigation, investigate
from fe.runtime.patch import PRIMITIVES, ModelPatch, Primitive
from reporting.provenance import collect_provenance
from tests.costs import once
from tests.refusals import Inputs

FloatArray = NDArray[np.float64]
MODEL = "single_mass_rig"
INPUTS = Inputs(Path(__file__).with_name("system"))
CAMPAIGNS = Inputs(Path(__file__).with_name("data"))


def campaign_folder(path: Path, name: str, *changes: tuple[str, str, str]) -> Path:
    """Write a campaign of the tests of data: of a file a piece is exchanged, the whole where it is empty."""
    shutil.copytree(CAMPAIGNS.folder / name, path, dirs_exist_ok=True)
    for file, old, new in changes:
        text = (path / file).read_text(encoding="utf-8")
        assert old in text
        (path / file).write_text(text.replace(old, new, 1) if old else new, encoding="utf-8")
    return path


ORIGIN = Origin("Rig", MODEL, "ab" * 32, "cd" * 32, "uav-twin discrepancy run rig", collect_provenance(0))


def model_of(text: str) -> LumpedModel:
    """Return the lumped model that a text says."""
    return LumpedModel(LumpedDescription.parse(tomllib.loads(text)))


def fmu_rig(folder: Path, fmu: object, *changes: tuple[str, str]) -> Path:
    """Write the file of the single-mass rig as an FMU, with texts replaced."""
    path = folder / "rig.toml"
    path.write_text(INPUTS.text("rig.toml", ("{fmu}", str(fmu)), *changes), encoding="utf-8")
    return path


USUAL = {"velocity_exponent": 0, "displacement_exponent": 0, "reference_velocity": 1.0} | {
    "reference_displacement": 1.0, "side": 0,
}  # fmt: skip


def laws(port: str, stiffness: float, amplitude: float, speed: float) -> dict[str, tuple[Primitive, ...]]:
    """Return the laws of a port in `laws.toml`, by name, at its stiffness, amplitude and speed [SI]."""
    force = stiffness * amplitude
    units = {
        "coefficient": force, "slip_force": force, "stiffness": stiffness, "half_width": amplitude,
        "yield_displacement": amplitude, "reference_displacement": amplitude, "reference_velocity": speed,
    }  # fmt: skip

    def made(kind: str, **given: Any) -> Primitive:
        known = {item.name for item in fields(PRIMITIVES[kind])}
        values = {name: value for name, value in (USUAL | given).items() if name in known}
        return PRIMITIVES[kind](**{"port": port} | {k: v * units.get(k, 1) for k, v in values.items()})

    rows = INPUTS.table("laws.toml")[port]
    return {name: tuple(made(**law) for law in several) for name, several in rows.items()}


def one_mass(**terms: Any) -> LumpedModel:
    """Return a mass of 2 kg and what holds it; the force on it is `push`, its place `x`, its port `slide`."""
    ends = {"input": "push", "output": "x", "port": "slide"}
    rows = {key: [{"name": name, "vector": 1.0}] for key, name in ends.items()}
    return LumpedModel(
        LumpedDescription.parse({"format": 1, "name": "One mass", "mass": 2.0, **rows, **terms}, "here")
    )


def chosen(*identifiers: str) -> tuple[Effect, ...]:
    """Return these effects of the catalogue."""
    return tuple(effect_by_identifier(identifier, library()) for identifier in identifiers)


def setting_of(campaign: Campaign, model: Model) -> Setting:
    return Setting(campaign, model, model.scales(campaign))


def hiding(
    campaign: Campaign, model: Model, identifier: str, values: dict[str, float], place: str
) -> ModelPatch:
    """Return the patch of an effect in a campaign."""
    return chosen(identifier)[0].patch(setting_of(campaign, model), values, place)


def simulated(model: Model, kind: Any, seed: int, hidden: Any = None, folder: Path | None = None) -> Campaign:
    """Return an example that hides a patch, or an effect by name, values and place; half as long as usual."""
    plan = usual_plan(model)
    plan = replace(plan, duration=0.5 * plan.duration)
    if isinstance(hidden, tuple):
        hidden = hiding(example_campaign(model, kind, seed, plan), model, *hidden)
    if folder is not None:
        return write_example(model, folder, kind, seed, plan, hidden)
    return example_campaign(model, kind, seed, plan, hidden)


def measured(drag: float = 0.0, kind: str = "laboratory") -> tuple[Campaign, LumpedModel]:
    """A simulated campaign of the single-mass rig, which may hide a drag."""
    model, values = LumpedModel.load(MODEL), {"equivalent_damping_ratio": drag}
    return simulated(model, kind, 4, ("quadratic_damping", values, "slide") if drag else None), model


def drag_beside_a_drift(folder: Path | None = None) -> tuple[Campaign, LumpedModel]:
    """The rig with drag and a stiffness that falls: the drift takes some of the error away, not most."""
    model = LumpedModel.load(MODEL)
    campaign = simulated(model, "laboratory", 4)
    hidden = hiding(campaign, model, "quadratic_damping", {"equivalent_damping_ratio": 0.01}, "slide")
    hidden = hidden + hiding(campaign, model, "stiffness_drift", {"stiffness_change": 0.02}, "")
    return simulated(model, "laboratory", 4, hidden, folder), model


FEW = chosen(
    "quadratic_damping", "coulomb_friction", "structural_damping", "gauge_gain", "load_cell", "washout"
)
"""Part of the catalogue, where the whole one would only take time."""


@once
def drag_found() -> Investigation:
    """Quadratic damping, hidden in ring-downs and static trials of the rig, and found; group `verdict`."""
    return investigate(*measured(0.01), FEW, seed=3)


# ---------------------------------------------------------------- what is asked of models

Outputs = dict[str, Quantity] | tuple[tuple[str, Quantity], ...]


def asked(kind: TrialKind, time: Any, **said: Any) -> Trial:
    """Return a trial at times [s], or of so many samples each 10 ms."""
    stamps = 0.01 * np.arange(time) if isinstance(time, int) else np.asarray(time, dtype=np.float64)
    return Trial.plain(said.pop("name", "a trial"), kind, said.pop("channels", ()), stamps, **said)


def seen(model: Model, what: Trial, outputs: Outputs, *items: Primitive, **given: Any) -> FloatArray:
    """Return what a model with a patch shows; further conditions by name, the parameters one by default."""
    conditions = Conditions(**{"parameters": np.ones(len(model.parameters)), **given})
    asked = tuple(outputs.items()) if isinstance(outputs, dict) else outputs
    return model.respond(what, asked, ModelPatch(items), conditions).values


def campaign(*trials: Trial, temperature: float | None = None, **channels: Any) -> Campaign:
    return Campaign("c", channels, trials, temperature, {}, "")


def integrated(rate: Any, time: FloatArray, first: Any, parts: bool = False, **options: Any) -> FloatArray:
    """Return states (N, n) at stamps; with `parts` the rate is also told the number of the interval."""
    limits = {"rtol": 1e-10, "atol": 1e-12} | options
    if not parts:
        return np.asarray(solve_ivp(rate, (time[0], time[-1]), first, t_eval=time, **limits).y.T)
    states = [np.asarray(first, dtype=np.float64)]
    for k in range(len(time) - 1):
        moved = solve_ivp(rate, (time[k], time[k + 1]), states[-1], args=(k,), **limits)
        states.append(moved.y[:, -1])
    return np.array(states)


def same(first: Any, second: Any, rtol: float = 0.0) -> bool:
    """Compare records to the last bit in all they hold, or to rounding but for what files do not keep."""
    if is_dataclass(first):
        compared = fields(first)
        if rtol:
            compared = tuple(item for item in compared if item.compare and item.name != "data_hash")
        return all(same(getattr(first, item.name), getattr(second, item.name), rtol) for item in compared)
    if isinstance(first, dict):
        has_same_keys = list(first) == list(second)
        return has_same_keys and same(tuple(first.values()), tuple(second.values()), rtol)
    if isinstance(first, tuple):
        has_same_length = len(first) == len(second)
        return has_same_length and all(same(*pair, rtol) for pair in zip(first, second, strict=True))
    if isinstance(first, np.ndarray | float):
        return _same_numbers(np.asarray(first), np.asarray(second), rtol)
    return bool(first == second)


def _same_numbers(first: FloatArray, second: FloatArray, rtol: float) -> bool:
    """Compare type, shape and numbers; the tolerance is relative to the largest finite one."""
    largest = np.abs(first).max(initial=0.0, where=np.isfinite(first)) if rtol else 0.0
    if (first.dtype, first.shape) != (second.dtype, second.shape):
        return False
    return np.allclose(first, second, rtol=rtol, atol=rtol * largest, equal_nan=True)
