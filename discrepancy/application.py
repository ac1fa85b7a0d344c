"""The way back: what a verdict found, written as a model that has it."""

import json
import shlex
from dataclasses import dataclass
from dataclasses import replace as changed
from pathlib import Path
from typing import Any

from calibration.result.file import load_calibration, tailoring
from discrepancy.errors import SENTENCES, DiscrepancyError, ModelError, said
from discrepancy.files import verdict as files
from discrepancy.files.residuals import RESIDUALS_NAME, read_residuals
from discrepancy.model_choice import ModelChoice, ModelKind, model_of
from discrepancy.proof_record import Proof
from discrepancy.system.lumped_file import SHIPPED_MODELS, LumpedDescription
from discrepancy.verdict import Hypothesis, Verdict, VerdictKind
from fe.runtime.laws.interface import PortForce
from fe.runtime.state import DigitalState
from fmu_asset.errors import PatchFileError
from fmu_asset.packing.patch_file import SCHEMA, parse_patch
from fmu_asset.packing.structure_fmu import pack_wing
from reporting.errors import FileNotWrittenError
from reporting.files import atomic_write_text, refuse_existing
from reporting.folders import restore_folder
from reporting.progress import Progress
from reporting.toml_file import read_toml, toml_text
from reporting.words import capital

ENDINGS = (".toml", ".json", ".fmu")


@dataclass(frozen=True)
class Applied:
    """A patched model.

    Attributes
    ----------
    path : Path
        Its file.
    sentence : str
        What was applied, and how sure it is.
    command : str
        Which compares the same data with it; empty for an FMU, which wants a description first.
    """

    path: Path
    sentence: str
    command: str


def apply_verdict(
    verdict: Path | str,
    out: Path | str | None = None,
    *,
    member: str | None = None,
    replace: bool = False,
    progress: Progress | None = None,
) -> Applied:
    """Write the model of a verdict with the effects that were found and the parameters beside them.

    Parameters
    ----------
    verdict : path
        Folder of a verdict, or its `verdict.json`.
    out : path, optional
        The file: .json, a patch beside the model's file, which is a model itself wherever one is asked for;
        .toml, a lumped model whose file says it by `[[law]]`; .fmu, a wing with the effects switched on.
        By default MODEL_patched in the working folder, .toml where that can say it.
    member : str, optional
        Of a group: which of `Verdict.group`; the first if left out.
    replace : bool
        Whether an existing file may be replaced.
    progress : Progress, optional
        Where the modelling of a wing reports.

    Returns
    -------
    Applied
        The file, and what to say of it.

    Raises
    ------
    DiscrepancyError
        If the verdict gives nothing to apply, its model has changed or is gone, or the file cannot say it.
    fmu_asset.errors.PatchFileError
        If an FMU cannot carry an effect.
    FileNotWrittenError
        If the file exists, or cannot be written.
    """
    file = Path(verdict)
    if file.suffix != ".json":
        restore_folder(file)
        file = file / files.VERDICT_NAME
    stored = files.read_verdict_file(file)
    found = _found(stored, file, member)
    choice = model_of(stored.origin, file, progress)
    patch = changed(found, origin=stored.origin).upon(choice.built_in)
    plain = choice.kind is ModelKind.LUMPED and all(
        isinstance(item, PortForce) and not item.windows for item in patch.patch
    )
    stem = Path(choice.file or "wing").stem
    path = Path(f"{stem}_patched{'.toml' if plain else '.json'}" if out is None else out)
    if path.suffix not in ENDINGS:
        raise FileNotWrittenError(f"{path} must end in one of {', '.join(ENDINGS)}: choose another --out.")
    made_of = (choice.file, *choice.beneath, choice.path or "", file, file.parent / files.PATCH_NAME)
    if path.exists() and path.resolve() in (Path(item).resolve() for item in made_of):
        raise FileNotWrittenError(f"{path} is what the patched model is made of: choose another --out.")
    refuse_existing(path, replace=replace)
    what = " and ".join(f"{item.name}{item.place and f' at {item.place}'}" for item in found.effects)
    sure = said(f"applied.{found.verdict.name.lower()}", group=", ".join(stored.verdict.group))
    sentence = f"{capital(what)}, {sure}."
    patch = changed(patch, sentence=f"{sentence} {stored.verdict.sentence}")
    if path.suffix == ".toml":
        if not plain:
            raise ModelError(said("applied.no_laws", path=path))
        atomic_write_text(path, _lumped_text(choice, patch))
    elif path.suffix == ".fmu":
        pack_patched(choice, patch, path, activate=True, replace=replace, progress=progress)
        return Applied(path, sentence, "")
    else:
        files.write_patch(path, patch)
    return Applied(path, sentence, _again(stored.origin.command, path))


def gives(verdict: Verdict, proof: Proof | None) -> bool:
    """Return whether a verdict gives something to apply: never that with which the error grows."""
    if proof is not None and proof.grew:
        return False
    open_gap = verdict.kind is VerdictKind.UNEXPLAINED
    return verdict.kind in files.PATCHED or (open_gap and _proved_hypothesis(verdict, proof) is not None)


def _found(stored: files.StoredVerdict, file: Path, member: str | None) -> files.StoredPatch:
    """Return the effects that are applied."""
    verdict = stored.verdict
    if member is not None and (verdict.kind is not VerdictKind.GROUP or member not in verdict.group):
        known = ", ".join(map(repr, verdict.group)) if verdict.kind is VerdictKind.GROUP else "no group"
        raise DiscrepancyError(f"--member {member!r} is none of {file}, which has {known}: leave it out.")
    if stored.proof is not None and stored.proof.grew:
        raise DiscrepancyError(
            f"{file} gives nothing to apply: its proof says that the error grows with what was found."
        )
    beside = file.parent / files.PATCH_NAME
    if member is None and verdict.kind in files.PATCHED and beside.is_file():
        return files.read_patch(beside)
    best = None
    if verdict.kind is VerdictKind.UNEXPLAINED:
        best = _proved_hypothesis(verdict, stored.proof)
    elif verdict.kind in files.APPLIED:
        best = _hypothesis(verdict, member)
    if best is None:
        key = f"nothing_as_{verdict.kind.name.lower()}"
        why = said(f"applied.{key}" if key in SENTENCES.tables["applied"] else "applied.nothing_there")
        raise DiscrepancyError(f"{file} gives nothing to apply: {why}.")
    residuals = file.parent / RESIDUALS_NAME
    channels = files.fmu_outputs(read_residuals(residuals).channels) if residuals.is_file() else {}
    effects = files.patch_effects(best.effects)
    return files.StoredPatch(verdict.kind, "", effects, channels, best.parameters, stored.origin)


def _hypothesis(verdict: Verdict, member: str | None) -> Hypothesis | None:
    """Return what the verdict, or a member of its group, stands for; None where there is nothing."""
    wanted = tuple(effect.identifier for effect in verdict.effects)
    if verdict.kind is VerdictKind.GROUP:
        wanted = tuple((member or verdict.group[0]).split(" + "))
    return next((item for item in verdict.hypotheses if set(item.identifiers) == set(wanted)), None)


def _proved_hypothesis(verdict: Verdict, proof: Proof | None) -> Hypothesis | None:
    """Return the best hypothesis for an unexplained gap: that of the proof, if the error is less with it."""
    if proof is None or not proof.effects or proof.closed is None or proof.closed.value <= 0.0:
        return None
    return next((item for item in verdict.hypotheses if item.labels == proof.effects), None)


def _lumped_text(choice: ModelChoice, patch: files.StoredPatch) -> str:
    """Return the file of a lumped model with laws at its ports and calibrated parameters."""
    file = choice.path or SHIPPED_MODELS / f"{patch.origin.model_file}.toml"
    content: dict[str, Any] = read_toml(file, ModelError, what="lumped model")
    calibrated = {item.name: item for item in patch.parameters}
    for row in content.get("parameter", ()):
        if found := calibrated.get(row["name"]):
            row |= {"mean": found.mean, "deviation": found.deviation}
    laws = list(content.get("law", ()))
    for effect in patch.effects:
        for item in effect.patch:
            name, count = effect.identifier, sum(law["name"].startswith(effect.identifier) for law in laws)
            laws.append({"name": f"{name}_{count + 1}" if count else name, **item.to_mapping()})
    content |= {"law": laws, "name": f"{content['name']} with {', '.join(e.name for e in patch.effects)}"}
    LumpedDescription.parse(content, f"{file} with {patch.sentence}")
    return f"# {patch.sentence}\n# Laws and parameters: {patch.origin.short_command}\n\n{toml_text(content)}"


def pack_patched(
    choice: ModelChoice,
    patch: files.StoredPatch,
    path: Path,
    *,
    activate: bool = False,
    replace: bool = False,
    progress: Progress | None = None,
) -> list[str]:
    """Pack the FMU of a wing with a patch and the parameters beside it; return the switches of its effects.

    Raises
    ------
    ModelError
        If the model is no wing.
    fmu_asset.errors.PatchFileError
        If an FMU cannot carry an effect.
    """
    if choice.design is None:
        raise ModelError(said("applied.no_wing", path=path, model=choice.label))
    rows = [{"id": item.identifier, "primitives": item.patch.to_list()} for item in patch.effects]
    content = {"schema": SCHEMA, "effects": rows, "channels": dict(patch.channels)}
    options: dict[str, Any] = {"state": DigitalState()}
    if choice.kind is ModelKind.CALIBRATION and choice.path is not None:
        options = tailoring(load_calibration(choice.path))
    options["state"] = changed(options["state"], **{item.name: item.mean for item in patch.parameters})
    effects = parse_patch(json.dumps(content).encode(), "The patch")
    options |= {"activate": activate, "replace": replace, "progress": progress}
    pack_wing(choice.design, path, patch=effects, **options)
    return [f"effect.{effect.id}.active" for effect in effects.effects]


def packed_beside(choice: ModelChoice, patch_file: Path, path: Path) -> str:
    """Pack the FMU of a wing with the patch of a verdict, its effects off; return what to say of it."""
    try:
        switches = pack_patched(choice, files.read_patch(patch_file).upon(choice.built_in), path)
    except PatchFileError as cause:
        return f"There is no patched FMU: {cause}"
    return f"{path.name} carries it, off until {', '.join(switches)} is set to 1."


def _again(command: str, model: Path) -> str:
    """Return the command of a verdict with another model, and a folder of its own for what it leaves."""
    words = shlex.split(command)
    source = Path(words[4 if words[3] == "--from-run" else 3]).name
    if "--model" in words:
        at = words.index("--model")
        del words[at : at + 2]
    return shlex.join([*words, "--model", str(model), "--out", f"verdicts/{source}_{model.stem}"])
