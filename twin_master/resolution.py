"""What is flown: the scenario with the command line's overrides, and where its asset comes from."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from reporting.provenance import hash_file
from scenarios import binding_files
from twin_master.asset_source import (
    BINDING_COPY,
    DESIGN_COPY,
    FMU_COPY,
    LIBRARY_COPY,
    SHIPPED_DESIGN_NAME,
    SSP_COPY,
    AssetSource,
    StrainLibrarySource,
    component_copies,
)
from twin_master.errors import MissionInputError
from twin_master.scenario import Scenario
from twin_master.scenario_file import LoadedScenario, parse_scenario
from twin_master.strain_library import FILE_NAME, load_strain_library


@dataclass(frozen=True)
class Overrides:
    """What the command line says otherwise than the scenario file.

    Attributes
    ----------
    seed : int or None
        Seed of the run.
    fmu, binding : Path or None
        FMU to fly, and its binding.
    strain_library : Path or None
        Fly the library instead of an FMU.
    in_process : bool
        Fly the FMU in this process instead of a worker.
    ssp : Path or None
        SSP file to fly in the place of the scenario's asset.
    """

    seed: int | None = None
    fmu: Path | None = None
    binding: Path | None = None
    strain_library: Path | None = None
    in_process: bool = False
    ssp: Path | None = None


def resolve_scenario(loaded: LoadedScenario, overrides: Overrides) -> Scenario:
    """Return the scenario with the overrides, its paths absolute.

    Relative paths of a scenario file start at the folder of that file.

    Raises
    ------
    MissionInputError
        The overrides contradict each other.
    ScenarioError
        The scenario does not hold with them.
    """
    table = loaded.scenario.to_dict()
    asset, folder = table["asset"], loaded.path.resolve().parent
    if overrides.strain_library and (overrides.fmu or overrides.binding):
        raise MissionInputError("--strain-library flies no FMU: give either it or --fmu and --binding.")
    if overrides.ssp and (overrides.strain_library or overrides.fmu):
        raise MissionInputError("an SSP file is flown as it is: give neither --fmu nor --strain-library.")
    if overrides.fmu and asset["kind"] == "coupled":
        raise MissionInputError(
            "--fmu flies one FMU, and the scenario couples several: change its components."
        )
    if asset["design"] and asset["design"] != SHIPPED_DESIGN_NAME:
        asset["design"] = str(folder / asset["design"])
    if asset["file"]:
        asset["file"] = str(folder / asset["file"])
    if asset["binding"] and asset["binding"] not in binding_files():
        asset["binding"] = str(folder / asset["binding"])
    for component, section in zip(asset["component"], loaded.scenario.asset.component, strict=True):
        component |= {key: str(folder / component[key]) for key in component_copies(section)}
    if overrides.ssp:
        asset |= {"kind": "coupled", "file": str(overrides.ssp.resolve()), "component": [], "connection": []}
    if overrides.fmu:
        asset |= {"kind": "fmu", "file": str(overrides.fmu.resolve())}
    if overrides.binding:
        asset["binding"] = str(overrides.binding.resolve())
    if overrides.strain_library:
        asset |= {"kind": "strain_library", "file": str(_library_file(overrides.strain_library))}
        asset |= {"design": None, "binding": None, "observation_model": None}
        asset |= {"component": [], "connection": [], "seeds": []}
    if overrides.in_process:
        asset["isolated"] = False
    if overrides.seed is not None:
        table["mission"]["seed"] = overrides.seed
    return parse_scenario(table, str(loaded.path))


def _library_file(path: Path) -> Path:
    return (path / FILE_NAME if path.is_dir() else path).resolve()


def portable_scenario(scenario: Scenario) -> Scenario:
    """Return a resolved scenario that names the copies in the run folder, so that it holds on any machine."""
    file = {"strain_library": LIBRARY_COPY, "coupled": SSP_COPY}.get(scenario.asset.kind, FMU_COPY)
    copies = {"file": file, "design": DESIGN_COPY, "binding": BINDING_COPY}
    return _with_asset(
        scenario,
        {key: copies[key] for key in _given_paths(scenario)}
        | {"component": tuple(c.model_copy(update=component_copies(c)) for c in scenario.asset.component)},
    )


def located_scenario(scenario: Scenario, folder: Path) -> Scenario:
    """Return a portable scenario with the paths of the copies in a run folder."""
    changes: dict[str, Any] = {key: str(folder / path) for key, path in _given_paths(scenario).items()}
    changes["component"] = tuple(
        c.model_copy(update={key: str(folder / path) for key, path in component_copies(c).items()})
        for c in scenario.asset.component
    )
    return _with_asset(scenario, changes)


def _given_paths(scenario: Scenario) -> dict[str, str]:
    """Return the files that the asset names, without what is shipped."""
    asset = scenario.asset
    given = {"file": asset.file, "design": asset.design, "binding": asset.binding}
    shipped = {SHIPPED_DESIGN_NAME, *binding_files()}
    return {key: path for key, path in given.items() if path and (key == "file" or path not in shipped)}


def _with_asset(scenario: Scenario, changes: dict[str, Any]) -> Scenario:
    return scenario.model_copy(update={"asset": scenario.asset.model_copy(update=changes)})


def asset_source(scenario: Scenario) -> AssetSource:
    """Return where the asset of a resolved scenario comes from.

    Raises
    ------
    InvalidStrainLibraryError, MissingObservationModelError
        The strain library is missing, damaged or does not fit the scenario.
    """
    asset = scenario.asset
    if asset.kind == "strain_library":
        path = Path(asset.file or "")
        return StrainLibrarySource(scenario, load_strain_library(path), hash_file(path), path)
    from fe.design import SHIPPED_DESIGN
    from twin_master.fmu_source import FmuSource

    design = SHIPPED_DESIGN if asset.design == SHIPPED_DESIGN_NAME else asset.design
    binding = binding_files().get(asset.binding or "", Path(asset.binding or ""))
    source: type[FmuSource] = FmuSource
    if asset.kind == "coupled":  # who flies one FMU does not pay for the reading of SSP files
        from twin_master.coupled_source import CoupledSource

        source = CoupledSource
    return source(
        scenario, binding, Path(design) if design else None, Path(asset.file) if asset.file else None
    )
