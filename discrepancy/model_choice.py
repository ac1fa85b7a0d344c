"""Which model a campaign is compared with: wing, structure, lumped model, FMU, or a patched one."""

from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path

from calibration.joint.wing_table import SHIPPED_PRIOR
from discrepancy.document import Origin
from discrepancy.errors import ModelError, VerdictFileError
from discrepancy.files.verdict import StoredPatch, read_patch
from discrepancy.fmu_models.model import FmuModel
from discrepancy.sources.from_run import run_model
from discrepancy.system.interface import Model
from discrepancy.system.lumped_file import SHIPPED_MODELS
from discrepancy.system.lumped_model import LumpedModel
from discrepancy.system.structures import StructureModel
from discrepancy.system.wing_model import WingModel
from fe.reduction.model_cache import changeable_model
from fe.runtime.errors import FiniteElementError
from fe.structure.design import is_structure, load_structure, structure_hash
from fe.wing.design import SHIPPED_DESIGN, WingDesign
from fmu_asset.archive.fmu_file import packed_design_hash
from reporting.choices import did_you_mean
from reporting.files import hash_file, hash_record
from reporting.formats.toml_file import read_toml
from reporting.progress import Progress
from reporting.words import comma_list
from scenarios import structure_files


class ModelKind(StrEnum):
    """Where a model comes from."""

    WING = "wing"
    CALIBRATION = "calibrated wing"
    LUMPED = "lumped model"
    FMU = "FMU"
    STRUCTURE = "structure"


@dataclass(frozen=True)
class ModelChoice:
    """A model with where it comes from.

    Attributes
    ----------
    model : Model
        The model, ready for simulation.
    kind : ModelKind
        Where it comes from.
    label : str
        Name of its file or folder, without the path; empty for the shipped wing.
    source_hash : str
        SHA-256 of all that it was read from: its file, with the prior for a wing without
        calibration, with FMU and binding for the description of an FMU, with the patch of a run's
        twin.
    design : WingDesign or None
        Design of a wing; None for another model.
    path : Path or None
        Path of its file; None for a shipped model.
    design_hash : str
        SHA-256 of the design or structure that it was built from; empty if that is not known.
    file : str
        File or name of the model, as in `Origin.model_file`.
    built_in : StoredPatch or None
        Patch that is already applied to the model; None without one.
    base_files : tuple of str
        Files or names of the models that a patched model is based on.
    """

    model: Model
    kind: ModelKind
    label: str
    source_hash: str
    design: WingDesign | None = None
    path: Path | None = None
    design_hash: str = ""
    file: str = ""
    built_in: StoredPatch | None = None
    base_files: tuple[str, ...] = ()


def choose_model(name: str | Path | None, progress: Progress | None = None) -> ModelChoice:
    """Return the model that a command line asks for.

    Parameters
    ----------
    name : str or Path, optional
        A calibration (.nc); a wing design, a structure, a lumped model or the description of an FMU
        (.toml); any of these with a patch (.json); the name of a shipped lumped model or structure;
        the folder of a mission whose twin's model is meant. None for the shipped wing.
    progress : Progress, optional
        Where the modelling of a wing or a structure reports.

    Raises
    ------
    ModelError, VerdictFileError, CampaignFileError
        If there is no such model, or its file cannot be used.
    """
    if name is None:
        return _choose_wing(WingModel.of_design(None, progress), ModelKind.WING, None)
    path = Path(name)
    file = str(path.resolve() if path.exists() else name)
    return replace(_choose(path, progress), file=file)


def _choose(path: Path, progress: Progress | None) -> ModelChoice:
    """Return the model of a file or a folder, or the shipped one of this name.

    The entry `file` of the result is not set yet.
    """
    if path.is_dir():
        return choice_of_run(path)
    if path.suffix == ".fmu":
        raise ModelError(
            f"{path} is an FMU: give a TOML file that says which of its variables are load, "
            'outputs and ports (kind = "fmu", docs/how_to/fmu_models.md), or for the wing its '
            "calibration.nc or design."
        )
    if path.suffix and not path.is_file():
        raise ModelError(
            f"There is no model file {path}; give a calibration (.nc) or a model (.toml)."
        )
    if path.suffix == ".nc":
        return _choose_wing(WingModel.of_calibration(path, progress), ModelKind.CALIBRATION, path)
    if path.suffix == ".json":
        return _choose_patched(path, progress)
    if path.suffix not in ("", ".toml"):
        shipped_names = sorted(file.stem for file in SHIPPED_MODELS.glob("*.toml"))
        raise ModelError(
            f"{path} is not a model: a calibration (.nc), a wing design, a structure or a lumped "
            "model (.toml), a patch (.json), or the name of a shipped lumped model "
            f"({comma_list(shipped_names)}) is expected."
        )
    if path.suffix == ".toml":
        content = read_toml(path, ModelError, what="model")
        if content.get("kind") == "fmu":
            return _choose_fmu(path)
        if is_structure(content):
            return _choose_structure(path, progress)
        if "format" not in content:  # a wing design has none
            return _choose_wing(WingModel.of_design(path, progress), ModelKind.WING, path)
    is_name = not path.exists()
    if is_name and str(path) in structure_files():
        return _choose_structure(structure_files()[str(path)], progress)
    if is_name and not path.suffix:
        _refuse_near_structure(str(path))
    model = LumpedModel.load(path)
    if is_name and not path.suffix:
        source_hash = hash_file(SHIPPED_MODELS / f"{path}.toml")
        return ModelChoice(model, ModelKind.LUMPED, path.name, source_hash)
    return ModelChoice(model, ModelKind.LUMPED, path.name, hash_file(path), path=path)


def _refuse_near_structure(name: str) -> None:
    """Raise an error if a name is no lumped model, but resembles that of a shipped structure."""
    question = did_you_mean(name, structure_files())
    if question and not (SHIPPED_MODELS / f"{name}.toml").exists():
        raise ModelError(f"There is no model {name!r}.{question}")


def load_model(name: str | Path | None = None, progress: Progress | None = None) -> Model:
    """Return a model that a campaign can be compared with.

    Parameters
    ----------
    name : str or Path, optional
        As `choose_model` takes it.
    progress : Progress, optional
        Where the modelling of a wing or a structure reports.

    Raises
    ------
    ModelError, VerdictFileError, CampaignFileError
        If there is no such model, or its file cannot be used.
    """
    return choose_model(name, progress).model


def model_of(origin: Origin, file: Path, progress: Progress | None = None) -> ModelChoice:
    """Return the model from which a verdict or a patch was computed.

    The model must be unchanged since then: its hash is compared with the recorded one.

    Parameters
    ----------
    origin : Origin
        The record, in the verdict or patch, of the model and the data from which it was computed.
    file : Path
        The file of the verdict or patch. If the file of the model is no longer at its recorded
        path, this function looks for it in the folder of `file`.
    progress : Progress, optional
        The display of progress while the model is built.

    Raises
    ------
    ModelError
        If the file of the model is not found, cannot be used, or has changed.
    VerdictFileError
        If `file` does not record where its model is, or if the model is a patch that cannot be
        read.
    CampaignFileError
        If the model belongs to a run folder that cannot be used.
    """
    # None in a file of a version that did not record the model; empty for the shipped wing
    if origin.model_file is None:
        raise VerdictFileError(
            f"{file} was left by an earlier version, which did not record where its model is: run "
            "`uav-twin discrepancy run` again."
        )
    model_file = Path(origin.model_file)
    if model_file.is_absolute() and not model_file.exists():
        model_file = Path(file).parent / model_file.name
        if not model_file.exists():
            raise ModelError(
                f"The model {origin.model_file}, on which {file} is based, does not exist any "
                f"more: put it back there, or into the folder of {Path(file).name}."
            )
    is_shipped_wing = not origin.model_file
    choice = choose_model(None if is_shipped_wing else model_file, progress)
    if choice.source_hash != origin.model_hash:
        model_name = choice.file or "of the shipped wing"
        raise ModelError(
            f"The model {model_name} has changed since {file} was written (SHA-256 "
            f"{choice.source_hash:.12}, not {origin.model_hash:.12}): run `uav-twin discrepancy "
            "run` again."
        )
    return choice


def choice_of_run(folder: Path) -> ModelChoice:
    """Return the model that the twin of a run folder used, with its patch if it had one.

    Raises
    ------
    CampaignFileError, ModelError
        For the causes of `run_model`.
    """
    model, wing_file, patch_file = run_model(folder)
    kind = ModelKind.CALIBRATION if wing_file.suffix == ".nc" else ModelKind.WING
    choice = _choose_wing(model, kind, wing_file)
    if patch_file is None:
        return choice
    source_hash = hash_record({"model": choice.source_hash, "patch": hash_file(patch_file)})
    return replace(choice, source_hash=source_hash)


def _choose_patched(path: Path, progress: Progress | None) -> ModelChoice:
    """Return the model that a patch file was made for, with its effects and parameters.

    That model may itself be a patched one; `built_in` then combines all patches.
    """
    stored = read_patch(path)
    base = model_of(stored.origin, path, progress)
    calibrated = {
        parameter.name: (parameter.mean, parameter.deviation) for parameter in stored.parameters
    }
    return replace(
        base,
        model=base.model.with_patch(stored.patch, calibrated),
        label=path.name,
        source_hash=hash_record({"model": base.source_hash, "patch": hash_file(path)}),
        built_in=stored.combine_with(base.built_in),
        base_files=(*base.base_files, base.file),
    )


def _choose_structure(path: Path, progress: Progress | None) -> ModelChoice:
    """Return the model of a structure's file, reduced with its ports."""
    with ModelError.instead_of(FiniteElementError):
        reduced = changeable_model(path, progress)
        source_hash = structure_hash(load_structure(path), path.parent, with_ports=True)
    return ModelChoice(
        StructureModel(reduced),
        ModelKind.STRUCTURE,
        path.name,
        source_hash,
        path=path,
        design_hash=reduced.design_hash,
    )


def _choose_fmu(path: Path) -> ModelChoice:
    """Return the model of an FMU's description.

    Its `source_hash` covers the description, the FMU and the binding.
    """
    model = FmuModel.load(path)
    fmu_file = path.parent / model.description.fmu
    binding_file = model.description.binding_file(path.parent)
    hashes = {"description": hash_file(path), "fmu": hash_file(fmu_file)}
    if binding_file is not None:
        hashes["binding"] = hash_file(binding_file)
    return ModelChoice(
        model,
        ModelKind.FMU,
        path.name,
        hash_record(hashes),
        path=path,
        design_hash=packed_design_hash(fmu_file),
    )


def _choose_wing(model: WingModel, kind: ModelKind, path: Path | None) -> ModelChoice:
    """Return the choice of a wing model, from its calibration, its design or the shipped design.

    `path` is the file of the calibration or design; None for the shipped design. The hash of a
    design includes the shipped prior of the parameters, since the file has none.
    """
    if path is not None and kind is ModelKind.CALIBRATION:
        source_hash = hash_file(path)
    else:
        prior = {name: list(values) for name, values in SHIPPED_PRIOR.items()}
        design_file = path or SHIPPED_DESIGN
        source_hash = hash_record({"design": hash_file(design_file), "prior": prior})
    return ModelChoice(
        model,
        kind,
        label="" if path is None else path.name,
        source_hash=source_hash,
        design=model.design,
        path=path,
        design_hash="" if model.design is None else model.design.hash,
    )
