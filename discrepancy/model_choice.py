"""Which model a campaign is compared with: a wing (shipped, calibrated, designed), a lumped model, an FMU."""

from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path

from calibration.errors import CalibrationError
from calibration.wing.result_file import load_calibration
from discrepancy.errors import ModelError
from discrepancy.models.fmu import FmuModel
from discrepancy.models.fmu_runs import binding_file
from discrepancy.models.interface import Model
from discrepancy.models.lumped import LumpedModel
from discrepancy.models.lumped_file import SHIPPED_MODELS
from discrepancy.models.wing import SHIPPED_PRIOR, WingModel
from discrepancy.sources.from_run import (
    CALIBRATION_FILE,
    DESIGN_FILE,
    is_calibrated_wing,
    patch_of_run,
    run_model,
)
from fe.reduction.stages import Progress
from fe.runtime.errors import FiniteElementError
from fe.wing.design import SHIPPED_DESIGN, WingDesign, load_design
from fmu_asset.archive.design_record import packed_design_hash
from reporting.provenance import hash_file, hash_record
from reporting.toml_file import read_toml
from scenarios import structure_files


class ModelKind(StrEnum):
    """Where a model comes from."""

    WING = "wing"
    CALIBRATION = "calibrated wing"
    LUMPED = "lumped model"
    FMU = "FMU"


@dataclass(frozen=True)
class ModelChoice:
    """A model with where it comes from.

    Attributes
    ----------
    model : Model
        Ready to be asked.
    kind : ModelKind
        What it is.
    label : str
        What the command line names it by, without its folder; empty for the shipped wing.
    source_hash : str
        SHA-256 of all that it was read from: its file, with the prior for a wing without calibration, with
        FMU and binding for the description of an FMU, with the patch of a run's twin.
    design : WingDesign or None
        Of a wing.
    path : Path or None
        Of its file; None for what is shipped.
    design_hash : str
        SHA-256 of the design or structure that it was made of; empty where that is not known.
    """

    model: Model
    kind: ModelKind
    label: str
    source_hash: str
    design: WingDesign | None = None
    path: Path | None = None
    design_hash: str = ""


def choose_model(name: str | Path | None, progress: Progress | None = None) -> ModelChoice:
    """Return the model that a command line asks for.

    Parameters
    ----------
    name : str or Path, optional
        A calibration (.nc), a wing design, a lumped model or the description of an FMU (.toml), or the name
        of a shipped lumped model; the shipped wing if left out.
    progress : Progress, optional
        Where the modelling of a wing reports.

    Raises
    ------
    ModelError
        If there is no such model, or its file cannot be used.
    """
    if name is None:
        return _wing(None, progress)
    path = Path(name)
    if path.suffix == ".fmu":
        raise ModelError(
            f"{path} is an FMU: give a TOML file that says which of its variables are load, outputs and "
            "ports "
            '(kind = "fmu", docs/fmu_models.md), or for the wing its calibration.nc or design.'
        )
    if path.suffix and not path.is_file():
        raise ModelError(f"There is no model file {path}; give a calibration (.nc) or a model (.toml).")
    if path.suffix == ".nc":
        return _calibrated(path, progress)
    if path.suffix not in ("", ".toml"):
        raise ModelError(
            f"{path} is no model: a calibration (.nc), a wing design or a lumped model (.toml), or the "
            "name of a "
            f"shipped lumped model ({', '.join(shipped_lumped_models())}) is expected."
        )
    if path.suffix == ".toml":
        content = read_toml(path, ModelError, what="model")
        if content.get("kind") == "fmu":
            return _fmu(path)
        if "mesh" in content:  # neither a wing design nor a lumped model has one
            raise _structure_error(str(path), path.name)
        if "format" not in content:  # a wing design has none
            return _wing(path, progress)
    if not path.exists() and str(path) in structure_files():
        raise _structure_error(str(path), str(path))
    model = LumpedModel.load(path)
    shipped = not path.suffix and not path.exists()
    file = SHIPPED_MODELS / f"{path}.toml" if shipped else path
    return ModelChoice(model, ModelKind.LUMPED, path.name, hash_file(file), path=None if shipped else path)


def load_model(name: str | Path | None = None, progress: Progress | None = None) -> Model:
    """Return a model that a campaign can be compared with.

    Parameters
    ----------
    name : str or Path, optional
        A calibration (.nc), a wing design, a lumped model or the description of an FMU (.toml), the name of a
        shipped lumped model, or the folder of a mission whose twin's model is meant; the shipped wing if left
        out.
    progress : Progress, optional
        Where the modelling of a wing reports.

    Raises
    ------
    ModelError, CampaignFileError
        If there is no such model, or its file cannot be used.
    """
    if name is not None and Path(name).is_dir():
        return run_model(name)
    return choose_model(name, progress).model


def choice_of_run(folder: Path) -> ModelChoice:
    """Return the model that the twin of a run folder believed, with its patch if it had one.

    Raises
    ------
    CampaignFileError, ModelError
        As `run_model`.
    """
    model = run_model(folder)
    calibration = folder / CALIBRATION_FILE
    tailored = is_calibrated_wing(folder)
    choice = _calibrated(calibration, None) if tailored else _wing(folder / DESIGN_FILE, None)
    patch = patch_of_run(folder)
    if patch is None:
        return replace(choice, model=model)
    source = hash_record({"model": choice.source_hash, "patch": hash_file(patch)})
    return replace(choice, model=model, source_hash=source)


def shipped_lumped_models() -> tuple[str, ...]:
    """Return the names of the lumped models that come with the package."""
    return tuple(sorted(file.stem for file in SHIPPED_MODELS.glob("*.toml")))


def _structure_error(name: str, file: str) -> ModelError:
    return ModelError(
        f"{name} is a structure, and a model file is expected: `uav-twin structure fmu {file} --rig "
        "MODEL.toml` writes one of it, beside its FMU."
    )


def _fmu(path: Path) -> ModelChoice:
    model = FmuModel.load(path)
    files = {
        "description": path,
        "fmu": path.parent / model.description.fmu,
        "binding": binding_file(model.description, path.parent),
    }
    source = hash_record({name: hash_file(file) for name, file in files.items() if file is not None})
    packed = packed_design_hash(files["fmu"] or path)
    return ModelChoice(model, ModelKind.FMU, path.name, source, path=path, design_hash=packed)


def _wing(path: Path | None, progress: Progress | None) -> ModelChoice:
    model = WingModel.of_design(path, progress)
    file = SHIPPED_DESIGN if path is None else path
    source = hash_record({"design": hash_file(file), "prior": {k: list(v) for k, v in SHIPPED_PRIOR.items()}})
    try:
        design = load_design(path)
    except FiniteElementError as cause:
        raise ModelError(str(cause)) from cause
    label = "" if path is None else path.name
    return ModelChoice(model, ModelKind.WING, label, source, design, path, design.hash)


def _calibrated(path: Path, progress: Progress | None) -> ModelChoice:
    model = WingModel.of_calibration(path, progress)
    try:
        design = load_calibration(path).design
    except (CalibrationError, OSError) as cause:
        raise ModelError(f"The calibration {path} cannot be used: {cause}") from cause
    return ModelChoice(model, ModelKind.CALIBRATION, path.name, hash_file(path), design, path, design.hash)
