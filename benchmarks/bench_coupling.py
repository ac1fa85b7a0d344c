"""A step of three coupled FMUs (damage, wing, gauges) beside the three stepped one by one."""

import itertools
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmarks.measurement import Measurement, least_seconds_of
from fe.reduction.model_cache import reduced_model
from fmu_asset.client.binding import Binding, load_binding
from fmu_asset.client.blocks import Blocks
from fmu_asset.client.session import FmiAsset
from fmu_asset.companions.build import companion_bytes
from fmu_asset.coupling.asset import CoupledAsset
from fmu_asset.coupling.structure import (
    Component,
    ComponentSetting,
    Connector,
    SystemStructure,
    expand_connection,
)
from fmu_asset.coupling.system import stepped_components, system_description
from fmu_asset.coupling.wiring import Wiring
from fmu_asset.packing.structure_fmu import build_fmu
from reporting.files import atomic_write_bytes
from scenarios import binding_files
from twin_master.assets.coupled_source import CoupledSection
from twin_master.scenario.reading import load_scenario

REPEATS, INNER = 300, 5


def run() -> Iterator[Measurement]:
    """Measure a macro step, its overhead over the steps of the FMUs, and the saving of a state."""
    binding = load_binding(binding_files()["three_fmus"])
    with tempfile.TemporaryDirectory() as folder:
        wiring = three_fmus(Path(folder))
        coupled, alone, saved, size = _in_process(wiring, binding)
        reference = "the three stepped one by one"
        yield Measurement("step of three FMUs in process", coupled, "us", None, reference, alone)
        yield Measurement("overhead of the coupling", coupled - alone, "us", 50.0)
        yield Measurement("state of three FMUs saved", saved, "us")
        yield Measurement("size of a state of three FMUs", size, "bytes")
        with CoupledAsset(wiring, binding) as asset:
            loads = itertools.cycle((2.0, 3.0))
            isolated = 1e6 * least_seconds_of(
                lambda: asset.step({"load_factor": next(loads)}), repeats=REPEATS, inner=INNER
            )
        yield Measurement("step of three FMUs in three workers", isolated, "us")
        joining = 1e3 * least_seconds_of(lambda: Wiring(wiring.structure), repeats=5)
        yield Measurement("three FMUs read, checked and joined", joining, "ms")


def three_fmus(folder: Path) -> Wiring:
    """Return the system of the shipped scenario, its noise included."""
    asset = load_scenario("three_fmus").scenario.asset
    assert isinstance(asset, CoupledSection)
    fmus = {
        "damage": atomic_write_bytes(folder / "damage.fmu", companion_bytes("damage_growth")),
        "wing": build_fmu(reduced_model(), folder / "wing.fmu").path,
        "gauges": atomic_write_bytes(folder / "gauges.fmu", companion_bytes("strain_gauges")),
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
        Component(
            c.name,
            fmus[c.name],
            {key: ComponentSetting(value) for key, value in c.parameters.items()},
        )
        for c in asset.component
    )
    return Wiring(SystemStructure("three_fmus", components, tuple(connectors), connections))


def _in_process(wiring: Wiring, binding: Binding) -> tuple[float, float, float, int]:
    """Time the coupled step and the three FMUs alone in turn, so that other work meets both alike.

    The FMUs alone have the bindings and inputs that they have in the system, and nothing passes
    between them.
    """
    parts = stepped_components(wiring, Blocks(system_description(wiring), binding))
    loads = itertools.cycle((2.0, 3.0))
    assets, inputs = [], []
    with CoupledAsset(wiring, binding, isolated=False) as coupled:
        try:
            for component in wiring.structure.components:
                part = parts[component.name]
                asset = FmiAsset(
                    component.fmu, part.binding, isolated=False, parameters=part.settings
                )
                asset.reset()
                assets.append(asset)
                inputs.append(dict.fromkeys(part.binding.load, 0.0))

            def one_by_one() -> None:
                load = next(loads)
                for asset, load_inputs in zip(assets, inputs, strict=True):
                    if "load_factor" in load_inputs:
                        load_inputs["load_factor"] = load
                    asset.step(load=load_inputs).values.tolist()

            def together() -> None:
                coupled.step({"load_factor": next(loads)})

            times: tuple[list[float], list[float]] = ([], [])
            for _ in range(REPEATS):
                for function, seconds in zip((together, one_by_one), times, strict=True):
                    begin = time.perf_counter()
                    for _ in range(INNER):
                        function()
                    seconds.append((time.perf_counter() - begin) / INNER)
            saved = least_seconds_of(coupled.save_state, repeats=REPEATS)
            medians = [1e6 * float(np.median(seconds)) for seconds in times]
            return medians[0], medians[1], 1e6 * saved, len(coupled.save_state())
        finally:
            for asset in assets:
                asset.close()
