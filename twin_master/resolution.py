"""What is flown: the scenario with the command line's overrides, and where its asset comes from."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from reporting.provenance import hash_file
from scenarios import asset_scripts, binding_files
from twin_master.asset_source import (
    BINDING_COPY,
    DESIGN_COPY,
    FMU_COPY,
    LIBRARY_COPY,
    OBSERVATIONS_COPY,
    AssetSource,
    StrainLibrarySource,
)
from twin_master.errors import MissionInputError
from twin_master.mismatch import MismatchedSource, check_load_factors
from twin_master.scenario import Scenario
from twin_master.scenario_file import LoadedScenario, parse_scenario
from twin_master.strain_library import FILE_NAME, load_strain_library

SHIPPED_DESIGN_NAME = "uav_wing"
REPOSITORY = "https://github.com/michaelkapteyn/UAV-Digital-Twin"
"""Where the authors of Kapteyn et al. 2021 published their strain library."""


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
        Fly the library instead of an FMU, as asset and model; where the scenario flies a library anyway, the
        file of that library.
    library : Path or None
        Believe this observation library.
    in_process : bool
        Fly the FMU in this process instead of a worker.
    """

    seed: int | None = None
    fmu: Path | None = None
    binding: Path | None = None
    strain_library: Path | None = None
    in_process: bool = False
    library: Path | None = None


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
    if overrides.strain_library and overrides.library:
        raise MissionInputError("--strain-library is asset and model itself: give either it or --library.")
    if asset["design"] and asset["design"] != SHIPPED_DESIGN_NAME:
        asset["design"] = str(folder / asset["design"])
    if asset["file"]:
        asset["file"] = str(folder / asset["file"])
    if asset["script"] and asset["script"] not in asset_scripts():
        asset["script"] = str(folder / asset["script"])
    if asset["library"]:
        asset["library"] = str(folder / asset["library"])
    if asset["binding"] and asset["binding"] not in binding_files():
        asset["binding"] = str(folder / asset["binding"])
    if overrides.fmu:
        asset |= {"kind": "fmu", "file": str(overrides.fmu.resolve()), "script": None}
    if overrides.binding:
        asset["binding"] = str(overrides.binding.resolve())
    if overrides.strain_library:
        if asset["kind"] != "strain_library":
            asset |= {"kind": "strain_library", "design": None, "binding": None, "observation_model": None}
            asset |= {"script": None, "library": None, "parameters": {}}  # those of the FMU
        asset["file"] = str(_library_file(overrides.strain_library))
    if overrides.library:
        asset |= {"observation_model": "library", "library": str(overrides.library.resolve())}
    if overrides.in_process:
        asset["isolated"] = False
    if overrides.seed is not None:
        table["mission"]["seed"] = overrides.seed
    return parse_scenario(table, str(loaded.path))


def _library_file(path: Path) -> Path:
    return (path / FILE_NAME if path.is_dir() else path).resolve()


def portable_scenario(scenario: Scenario) -> Scenario:
    """Return a resolved scenario that names the copies in the run folder, so that it holds on any machine."""
    library = scenario.asset.kind == "strain_library"
    copies = {"file": LIBRARY_COPY if library else FMU_COPY, "design": DESIGN_COPY, "binding": BINDING_COPY}
    copies["library"] = OBSERVATIONS_COPY
    # A script is packed once; from then on the FMU is what is flown.
    return _with_asset(scenario, {key: copies[key] for key in _given_paths(scenario)} | {"script": None})


def located_scenario(scenario: Scenario, folder: Path) -> Scenario:
    """Return a portable scenario with the paths of the copies in a run folder."""
    paths = _given_paths(scenario)
    return _with_asset(scenario, {key: str(folder / PurePosixPath(path)) for key, path in paths.items()})


def _given_paths(scenario: Scenario) -> dict[str, str]:
    """Return the files that the asset names, without what is shipped."""
    asset = scenario.asset
    given = {"file": asset.file or asset.script, "library": asset.library}
    shipped = {SHIPPED_DESIGN_NAME, *binding_files()}
    for key, path in (("design", asset.design), ("binding", asset.binding)):
        given[key] = None if path in shipped else path
    return {key: path for key, path in given.items() if path}


def _with_asset(scenario: Scenario, changes: dict[str, Any]) -> Scenario:
    return scenario.model_copy(update={"asset": scenario.asset.model_copy(update=changes)})


def asset_source(scenario: Scenario) -> AssetSource:
    """Return where the asset of a resolved scenario comes from.

    Raises
    ------
    MissionInputError
        The scenario flies a strain library and names none.
    InvalidStrainLibraryError, MissingObservationModelError
        The strain library is missing, damaged or does not fit the scenario.
    """
    asset = scenario.asset
    if asset.kind == "strain_library":
        library = _library_source(scenario)
        if not asset.model_of_the_design:
            return library
    from fe.design import SHIPPED_DESIGN
    from twin_master.design_source import DesignSource
    from twin_master.fmu_source import FmuSource

    design = SHIPPED_DESIGN if asset.design == SHIPPED_DESIGN_NAME else asset.design
    if asset.kind == "strain_library":
        check_load_factors(scenario)
        return MismatchedSource(library, DesignSource(scenario, Path(design or "")))
    binding = binding_files().get(asset.binding or "", Path(asset.binding or ""))
    script = asset_scripts().get(asset.script or "", Path(asset.script)) if asset.script else None
    source = FmuSource(
        scenario,
        binding,
        Path(design) if design else None,
        Path(asset.file) if asset.file else None,
        script,
    )
    if asset.library is None:
        return source
    from twin_master.library_source import LibrarySource

    return LibrarySource(scenario, source, binding, Path(asset.library))


def _library_source(scenario: Scenario) -> StrainLibrarySource:
    if scenario.asset.file is None:
        raise MissionInputError(
            f"the scenario {scenario.mission.name} flies the strain library of the paper's authors, which "
            f"does not come with this program: clone their public repository UAV-Digital-Twin "
            f"({REPOSITORY}) and name its file {FILE_NAME} by `--strain-library FILE`, or as `asset.file` in "
            f"a copy of the scenario."
        )
    path = Path(scenario.asset.file)
    return StrainLibrarySource(scenario, load_strain_library(path), hash_file(path), path)
