"""A step of three coupled FMUs (damage growth, wing, gauges) beside the same three stepped one by one."""

from __future__ import annotations

import itertools
import tempfile
from pathlib import Path

from benchmarks.measurement import Measurement, median_seconds
from fe.cache import reduced_model
from fmu_asset.binding import Binding, load_binding
from fmu_asset.build import build_fmu
from fmu_asset.companions.build import build_companion
from fmu_asset.coupling.asset import CoupledAsset
from fmu_asset.coupling.layout import Layout
from fmu_asset.coupling.roles import resolve_roles
from fmu_asset.coupling.structure import Component, Connector, Setting, SystemStructure, expand_connection
from fmu_asset.coupling.wiring import Wiring
from fmu_asset.session import FmiAsset
from scenarios import binding_files
from twin_master.scenario_file import load_scenario

REPEATS, INNER = 200, 10


def run() -> list[Measurement]:
    """Measure a macro step, its overhead over the steps of the FMUs, and what a saved state costs."""
    binding = load_binding(binding_files()["three_fmus"])
    with tempfile.TemporaryDirectory() as folder:
        wiring = three_fmus(Path(folder))
        found = []
        for isolated, where in ((False, "in process"), (True, "in three workers")):
            alone = _alone(wiring, binding, isolated=isolated)
            coupled, saved, size = _coupled(wiring, binding, isolated=isolated)
            beside = "the three FMUs stepped one by one"
            found += [
                Measurement(f"step of three FMUs {where}", coupled, "us", None, beside, alone),
                Measurement(f"overhead of the coupling {where}", coupled - alone, "us", 100.0),
                Measurement(f"state of three FMUs saved {where} ({size} bytes)", saved, "us"),
            ]
        joining = 1e3 * median_seconds(lambda: Wiring(wiring.structure), repeats=5)
        return [*found, Measurement("three FMUs read, checked and joined", joining, "ms")]


def three_fmus(folder: Path) -> Wiring:
    """Return the system of the shipped scenario, its noise included."""
    asset = load_scenario("three_fmus").scenario.asset
    fmus = {
        "damage": build_companion("damage_growth", folder / "damage.fmu").path,
        "wing": build_fmu(reduced_model(), folder / "wing.fmu").path,
        "gauges": build_companion("strain_gauges", folder / "gauges.fmu").path,
    }
    connections = tuple(
        connection
        for entry in asset.connection
        for connection in expand_connection(entry.source, entry.target, list(fmus))
    )
    connectors = dict.fromkeys(
        [Connector(c.source.variable, "input") for c in connections if not c.source.component]
        + [Connector(c.target.variable, "output") for c in connections if not c.target.component]
    )
    components = tuple(
        Component(c.name, fmus[c.name], {key: Setting(value) for key, value in c.parameters.items()})
        for c in asset.component
    )
    return Wiring(SystemStructure("three_fmus", components, tuple(connectors), connections))


def _microseconds(function: object) -> float:
    return 1e6 * median_seconds(function, repeats=REPEATS, inner=INNER)  # type: ignore[arg-type]


def _coupled(wiring: Wiring, binding: Binding, *, isolated: bool) -> tuple[float, float, int]:
    loads = itertools.cycle((2.0, 3.0))
    with CoupledAsset(wiring, binding, isolated=isolated) as asset:
        step = _microseconds(lambda: asset.step({"load_factor": next(loads)}))
        saved = _microseconds(asset.save_state)
        return step, saved, len(asset.save_state())


def _alone(wiring: Wiring, binding: Binding, *, isolated: bool) -> float:
    """Time the three FMUs with the same bindings and inputs, nothing passed between them."""
    layout = Layout(wiring, binding, resolve_roles(wiring, binding))
    loads = itertools.cycle((2.0, 3.0))
    assets, inputs = [], []
    try:
        for index, component in enumerate(wiring.structure.components):
            own = layout.component_binding(index)
            asset = FmiAsset(component.fmu, own, isolated=isolated, parameters=layout.settings[index])
            asset.reset()
            assets.append(asset)
            inputs.append(dict.fromkeys(own.load, 0.0))

        def step() -> None:
            load = next(loads)
            for asset, given in zip(assets, inputs, strict=True):
                if "load_factor" in given:
                    given["load_factor"] = load
                asset.step(load=given).values.tolist()

        return _microseconds(step)
    finally:
        for asset in assets:
            asset.close()
