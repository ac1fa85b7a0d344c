"""Which model a campaign is compared with: a wing, a structure, a lumped model, an FMU, or one patched."""

from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path

from calibration.joint.wing_table import SHIPPED_PRIOR
from discrepancy.document import Origin
from discrepancy.errors import ModelError, VerdictFileError, said
from discrepancy.files.verdict import StoredPatch, read_patch
from discrepancy.fmu_models.model import FmuModel
from discrepancy.sources.from_run import run_model
from discrepancy.system.interface import Model
from discrepancy.system.lumped_file import SHIPPED_MODELS
from discrepancy.system.lumped_model import LumpedModel
from discrepancy.system.structures import StructureModel, WingModel
from fe.reduction.model_cache import reduced_model
from fe.runtime.errors import FiniteElementError
from fe.structure.design import is_structure, load_structure, structure_hash
from fe.wing.design import SHIPPED_DESIGN, WingDesign
from fmu_asset.archive.fmu_file import packed_design_hash
from reporting.files import hash_file, hash_record
from reporting.progress import Progress
from reporting.toml_file import read_toml
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
    file : str
        As `Origin.model_file`.
    built_in : StoredPatch or None
        The patch that was built into the model of `kind`.
    beneath : tuple of str
        As `file`, of what a patched model rests on.
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
    beneath: tuple[str, ...] = ()


def choose_model(name: str | Path | None, progress: Progress | None = None) -> ModelChoice:
    """Return the model that a command line asks for.

    Parameters
    ----------
    name : str or Path, optional
        A calibration (.nc); a wing design, a structure, a lumped model or the description of an FMU (.toml);
        any of these with a patch (.json); the name of a shipped lumped model or structure; the folder of a
        mission whose twin's model is meant. The shipped wing if left out.
    progress : Progress, optional
        Where the modelling of a wing or a structure reports.

    Raises
    ------
    ModelError, VerdictFileError, CampaignFileError
        If there is no such model, or its file cannot be used.
    """
    if name is None:
        return _wing(WingModel.of_design(None, progress), ModelKind.WING, None)
    path = Path(name)
    file = str(path.resolve() if path.exists() else name)
    return replace(_chosen(path, progress), file=file)


def _chosen(path: Path, progress: Progress | None) -> ModelChoice:
    if path.is_dir():
        return choice_of_run(path)
    if path.suffix == ".fmu":
        raise ModelError(said("models.bare_fmu", path=path))
    if path.suffix and not path.is_file():
        raise ModelError(f"There is no model file {path}; give a calibration (.nc) or a model (.toml).")
    if path.suffix == ".nc":
        return _wing(WingModel.of_calibration(path, progress), ModelKind.CALIBRATION, path)
    if path.suffix == ".json":
        return _patched(path, progress)
    if path.suffix not in ("", ".toml"):
        names = sorted(file.stem for file in SHIPPED_MODELS.glob("*.toml"))
        raise ModelError(said("models.no_model", path=path, names=names))
    if path.suffix == ".toml":
        content = read_toml(path, ModelError, what="model")
        if content.get("kind") == "fmu":
            return _fmu(path)
        if is_structure(content):
            return _structure(path, progress)
        if "format" not in content:  # a wing design has none
            return _wing(WingModel.of_design(path, progress), ModelKind.WING, path)
    if not path.exists() and str(path) in structure_files():
        return _structure(structure_files()[str(path)], progress)
    model = LumpedModel.load(path)
    shipped = not path.suffix and not path.exists()
    file = SHIPPED_MODELS / f"{path}.toml" if shipped else path
    return ModelChoice(model, ModelKind.LUMPED, path.name, hash_file(file), path=None if shipped else path)


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
    """Return the model that a verdict or a patch rests on.

    Parameters
    ----------
    origin : Origin
        What it was reached from.
    file : Path
        It; a model's file that is not where it was is looked for beside it.
    progress : Progress, optional
        Where the modelling reports.

    Raises
    ------
    ModelError, VerdictFileError, CampaignFileError
        If the model is gone, has changed since, or is not known.
    """
    if origin.model_file is None:
        raise VerdictFileError(said("models.earlier", file=file))
    place = Path(origin.model_file)
    if place.is_absolute() and not place.exists():
        place = Path(file).parent / place.name
        if not place.exists():
            raise ModelError(said("models.gone", origin=origin, file=file, name=Path(file).name))
    choice = choose_model(place if origin.model_file else None, progress)
    if choice.source_hash != origin.model_hash:
        which = choice.file or "of the shipped wing"
        raise ModelError(said("models.changed", which=which, file=file, choice=choice, origin=origin))
    return choice


def choice_of_run(folder: Path) -> ModelChoice:
    """Return the model that the twin of a run folder believed, with its patch if it had one.

    Raises
    ------
    CampaignFileError, ModelError
        As `run_model`.
    """
    model, wing, patch = run_model(folder)
    choice = _wing(model, ModelKind.CALIBRATION if wing.suffix == ".nc" else ModelKind.WING, wing)
    if patch is None:
        return choice
    return replace(choice, source_hash=hash_record({"model": choice.source_hash, "patch": hash_file(patch)}))


def _patched(path: Path, progress: Progress | None) -> ModelChoice:
    stored = read_patch(path)
    base = model_of(stored.origin, path, progress)
    calibrated = {item.name: (item.mean, item.deviation) for item in stored.parameters}
    return replace(
        base,
        model=base.model.patched(stored.patch, calibrated),
        label=path.name,
        source_hash=hash_record({"model": base.source_hash, "patch": hash_file(path)}),
        built_in=stored.upon(base.built_in),
        beneath=(*base.beneath, base.file),
    )


def _structure(path: Path, progress: Progress | None) -> ModelChoice:
    with ModelError.instead_of(FiniteElementError):
        reduced = reduced_model(path, progress=progress, with_ports=True)
        source_hash = structure_hash(load_structure(path), path.parent, with_ports=True)
    model = StructureModel(reduced)
    design_hash = reduced.design_hash
    return ModelChoice(model, ModelKind.STRUCTURE, path.name, source_hash, path=path, design_hash=design_hash)


def _fmu(path: Path) -> ModelChoice:
    model = FmuModel.load(path)
    files = {
        "description": path,
        "fmu": path.parent / model.description.fmu,
        "binding": model.description.binding_file(path.parent),
    }
    source = hash_record({name: hash_file(file) for name, file in files.items() if file is not None})
    packed = packed_design_hash(files["fmu"] or path)
    return ModelChoice(model, ModelKind.FMU, path.name, source, path=path, design_hash=packed)


def _wing(model: WingModel, kind: ModelKind, path: Path | None) -> ModelChoice:
    if path is not None and kind is ModelKind.CALIBRATION:
        source = hash_file(path)
    else:
        prior = {name: list(values) for name, values in SHIPPED_PRIOR.items()}
        source = hash_record({"design": hash_file(path or SHIPPED_DESIGN), "prior": prior})
    label, made_of = "" if path is None else path.name, "" if model.design is None else model.design.hash
    return ModelChoice(model, kind, label, source, model.design, path, made_of)
