"""What is flown: the scenario with the command line's overrides, and where its asset comes from."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from reporting.provenance import hash_file
from scenarios import asset_scripts, binding_files
from twin_master.asset_source import (
    BINDING_COPY,
    CALIBRATED_DESIGN_NAME,
    CALIBRATION_COPY,
    DESIGN_COPY,
    FMU_COPY,
    LIBRARY_COPY,
    MODEL_PATCH_COPY,
    OBSERVATIONS_COPY,
    PATCH_COPY,
    SHIPPED_DESIGN_NAME,
    SSP_COPY,
    AssetSource,
    StrainLibrarySource,
    component_copies,
)
from twin_master.errors import MissionInputError
from twin_master.mismatch import MismatchedSource, check_load_factors
from twin_master.scenario import Scenario
from twin_master.scenario_file import LoadedScenario, parse_scenario
from twin_master.strain_library import FILE_NAME, load_strain_library

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
    calibration : Path or None
        The calibration file of the wing, instead of what the scenario says of its calibration.
    ssp : Path or None
        SSP file to fly in the place of the scenario's asset.
    """

    seed: int | None = None
    fmu: Path | None = None
    binding: Path | None = None
    strain_library: Path | None = None
    in_process: bool = False
    calibration: Path | None = None
    ssp: Path | None = None
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
    calibration = table["calibration"]
    if overrides.strain_library and (overrides.fmu or overrides.binding):
        raise MissionInputError("--strain-library flies no FMU: give either it or --fmu and --binding.")
    if overrides.strain_library and overrides.library:
        raise MissionInputError("--strain-library is asset and model itself: give either it or --library.")
    if overrides.calibration:
        calibration |= {"source": "file", "file": str(overrides.calibration.resolve())}
    elif calibration["file"]:
        calibration["file"] = str(folder / calibration["file"])
    flies_library = overrides.strain_library or asset["kind"] == "strain_library"
    believes_design = asset["kind"] == "strain_library" and asset["design"]
    if calibration["file"] and flies_library and not believes_design:
        raise MissionInputError(
            "a strain library brings its own samples of its parameter: fly it without a calibration file."
        )
    if overrides.ssp and (overrides.strain_library or overrides.fmu):
        raise MissionInputError("an SSP file is flown as it is: give neither --fmu nor --strain-library.")
    if overrides.fmu and asset["kind"] == "coupled":
        raise MissionInputError(
            "--fmu flies one FMU, and the scenario couples several: change its components."
        )
    if calibration["file"] and asset["design"]:
        for component in asset["component"]:
            if component["design"] == asset["design"]:  # the wing that the file describes
                component["design"] = CALIBRATED_DESIGN_NAME
        asset["design"] = CALIBRATED_DESIGN_NAME
    elif asset["design"] == CALIBRATED_DESIGN_NAME:
        raise MissionInputError(
            "`asset.design` asks for the design of a calibration, and there is no calibration file: give "
            '--calibration, or `source = "file"` in the table `calibration`.'
        )
    elif asset["design"] and asset["design"] != SHIPPED_DESIGN_NAME:
        asset["design"] = str(folder / asset["design"])
    if asset["file"]:
        asset["file"] = str(folder / asset["file"])
    if asset["script"] and asset["script"] not in asset_scripts():
        asset["script"] = str(folder / asset["script"])
    for key in ("library", "patch", "model_patch"):
        if asset[key]:
            asset[key] = str(folder / asset[key])
    if asset["binding"] and asset["binding"] not in binding_files():
        asset["binding"] = str(folder / asset["binding"])
    for component, section in zip(asset["component"], loaded.scenario.asset.component, strict=True):
        named = component_copies(section)
        component |= {k: str(folder / component[k]) for k in named if component[k] == getattr(section, k)}
    if asset["design"] != CALIBRATED_DESIGN_NAME and any(
        component["design"] == CALIBRATED_DESIGN_NAME for component in asset["component"]
    ):
        raise MissionInputError(
            "a component asks for the design of a calibration, and the twin's model is not that of one: give "
            "a calibration file, and name the same `design` in the table `asset`."
        )
    if overrides.ssp:
        asset |= {"kind": "coupled", "file": str(overrides.ssp.resolve()), "script": None}
        asset |= {"component": [], "connection": []}
    if overrides.fmu:
        asset |= {"kind": "fmu", "file": str(overrides.fmu.resolve()), "script": None}
    if overrides.binding:
        asset["binding"] = str(overrides.binding.resolve())
    if overrides.strain_library:
        if asset["kind"] != "strain_library":
            asset |= {"kind": "strain_library", "design": None, "binding": None, "observation_model": None}
            asset |= {"parameters": {}, "component": [], "connection": [], "seeds": []}  # those of FMUs
            asset |= {"script": None, "library": None, "patch": None, "model_patch": None}
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
    file = {"strain_library": LIBRARY_COPY, "coupled": SSP_COPY}.get(scenario.asset.kind, FMU_COPY)
    copies = {"file": file, "design": DESIGN_COPY, "binding": BINDING_COPY, "library": OBSERVATIONS_COPY}
    copies |= {"patch": PATCH_COPY, "model_patch": MODEL_PATCH_COPY}
    portable = _with_asset(
        scenario,
        {key: copies[key] for key in _given_paths(scenario)}
        # A script is packed once; from then on the FMU is what is flown.
        | {"script": None}
        | {"component": tuple(c.model_copy(update=component_copies(c)) for c in scenario.asset.component)},
    )
    return _with_calibration_file(portable, CALIBRATION_COPY)


def located_scenario(scenario: Scenario, folder: Path) -> Scenario:
    """Return a portable scenario with the paths of the copies in a run folder."""
    paths = _given_paths(scenario)
    changes: dict[str, Any] = {key: str(folder / PurePosixPath(path)) for key, path in paths.items()}
    changes["component"] = tuple(
        c.model_copy(update={key: str(folder / path) for key, path in component_copies(c).items()})
        for c in scenario.asset.component
    )
    located = _with_asset(scenario, changes)
    return _with_calibration_file(located, str(folder / PurePosixPath(CALIBRATION_COPY)))


def _given_paths(scenario: Scenario) -> dict[str, str]:
    """Return the files that the asset names, without what is shipped."""
    asset = scenario.asset
    given = {"file": asset.file or asset.script, "library": asset.library}
    given |= {"patch": asset.patch, "model_patch": asset.model_patch}
    shipped = {SHIPPED_DESIGN_NAME, CALIBRATED_DESIGN_NAME, *binding_files()}
    for key, path in (("design", asset.design), ("binding", asset.binding)):
        given[key] = None if path in shipped else path
    return {key: path for key, path in given.items() if path}


def _with_asset(scenario: Scenario, changes: dict[str, Any]) -> Scenario:
    return scenario.model_copy(update={"asset": scenario.asset.model_copy(update=changes)})


def _with_calibration_file(scenario: Scenario, path: str) -> Scenario:
    """Return the scenario with its calibration file, if it has one, at another place."""
    if scenario.calibration.file is None:
        return scenario
    calibration = scenario.calibration.model_copy(update={"file": path})
    return scenario.model_copy(update={"calibration": calibration})


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

    calibration = scenario.calibration.file
    tailored = asset.design == CALIBRATED_DESIGN_NAME
    design = SHIPPED_DESIGN if asset.design == SHIPPED_DESIGN_NAME else asset.design
    if asset.kind == "strain_library":
        check_load_factors(scenario)
        believed = DesignSource(
            scenario,
            Path(design) if design and not tailored else None,
            Path(calibration) if calibration else None,
        )
        return MismatchedSource(library, believed)
    binding = binding_files().get(asset.binding or "", Path(asset.binding or ""))
    script = asset_scripts().get(asset.script or "", Path(asset.script)) if asset.script else None
    believed_design = Path(design) if design and not tailored else None
    file, calibrated = Path(asset.file) if asset.file else None, Path(calibration) if calibration else None
    source: FmuSource
    if asset.kind == "coupled":  # who flies one FMU does not pay for the reading of SSP files
        from twin_master.coupled_source import CoupledSource

        source = CoupledSource(
            scenario, binding, believed_design, file, calibration=calibrated, tailored=tailored
        )
    else:
        source = FmuSource(
            scenario,
            binding,
            believed_design,
            file,
            calibration=calibrated,
            tailored=tailored,
            script=script,
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
