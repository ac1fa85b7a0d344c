"""Application of a verdict: writing the model with the effects that were found."""

import json
import shlex
from dataclasses import dataclass
from dataclasses import replace as replace_fields
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import norm

from calibration.result.file import Tailoring, load_calibration, tailoring
from discrepancy.errors import DiscrepancyError, ModelError
from discrepancy.files import verdict as files
from discrepancy.files.residuals import RESIDUALS_NAME, read_residuals
from discrepancy.judgement.curve_words import curve_of
from discrepancy.model_choice import ModelChoice, ModelKind, model_of
from discrepancy.proof_record import Proof
from discrepancy.system.lumped_file import SHIPPED_MODELS, LumpedDescription
from discrepancy.verdict import Hypothesis, Verdict, VerdictKind
from fe.runtime.errors import FiniteElementError
from fe.runtime.laws.interface import PortForce
from fe.runtime.patch import ModelPatch
from fe.runtime.state import DigitalState
from fe.structure.changed_file import WRITTEN, changed_tables
from fe.structure.design import MeshDesign, load_structure
from fmu_asset.errors import PatchFileError
from fmu_asset.packing.patch_file import SCHEMA, parse_patch
from fmu_asset.packing.structure_fmu import pack_wing
from reporting.errors import FileNotWrittenError
from reporting.files import atomic_write_text, refuse_existing
from reporting.folders import restore_folder
from reporting.formats.toml_file import read_toml, toml_text
from reporting.progress import Progress
from reporting.words import capital

ENDINGS = (".toml", ".json", ".fmu")
RANGE_OF_FORCE_FACTOR = (0.1, 10.0)
"""Range of the parameter that scales the force of an applied law [1]."""


@dataclass(frozen=True)
class AppliedVerdict:
    """A patched model.

    Attributes
    ----------
    path : Path
        Its file.
    sentence : str
        What was applied, and how certain it is.
    command : str
        Command that compares the same data with the patched model; empty for an FMU, which needs a
        description first.
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
) -> AppliedVerdict:
    """Write the model of a verdict with the effects that were found, and its fitted parameters.

    For an unexplained gap, the effects are those of the best hypothesis if its proof shows that the
    error becomes smaller. Effects of an earlier patch in the model stay in it.

    Parameters
    ----------
    verdict : path
        Folder of a verdict, or its `verdict.json`.
    out : path, optional
        The file to write. Its ending chooses the format: .json for a patch that refers to the
        model's file and can be used wherever a model is expected; .toml for a lumped model with the
        effects as tables `[[law]]`, or a structure from a mesh with supports, masses and loads as
        they were found; .fmu for a wing with the effects switched on. The default is
        MODEL_patched in the working folder, as .toml if the model's own file can state the effects,
        else as .json.
    member : str, optional
        Member of a group, one of `Verdict.group`; the first by default.
    replace : bool
        True if an existing file may be replaced.
    progress : Progress, optional
        Where the modelling of a wing reports.

    Returns
    -------
    AppliedVerdict
        The file, a sentence on what was applied, and the command to use it.

    Raises
    ------
    DiscrepancyError
        If the verdict gives nothing to apply, its model has changed or is gone, or the format of
        the file cannot hold the effects.
    fmu_asset.errors.PatchFileError
        If an FMU cannot carry an effect.
    FileNotWrittenError
        If the file exists, or cannot be written.
    """
    verdict_file = Path(verdict)
    if verdict_file.suffix != ".json":
        restore_folder(verdict_file)
        verdict_file = verdict_file / files.VERDICT_NAME
    stored = files.read_verdict_file(verdict_file)
    applied_patch = _patch_to_apply(stored, verdict_file, member)
    choice = model_of(stored.origin, verdict_file, progress)
    patch = replace_fields(applied_patch, origin=stored.origin).combine_with(choice.built_in)
    is_stated_by_file = _is_stated_by_file(choice, patch.patch)
    if out is None:
        stem = Path(choice.file or "wing").stem
        out = f"{stem}_patched{'.toml' if is_stated_by_file else '.json'}"
    path = Path(out)
    _check_destination(path, choice, verdict_file, replace=replace)
    sentence = f"{_applied_effects(applied_patch)}, {_certainty_clause(applied_patch, stored)}."
    patch = replace_fields(patch, sentence=f"{sentence} {stored.verdict.sentence}")
    if path.suffix == ".fmu":
        pack_patched(choice, patch, path, activate=True, replace=replace, progress=progress)
        return AppliedVerdict(path, sentence, "")
    if path.suffix == ".toml":
        if not is_stated_by_file:
            raise ModelError(
                f"{path}: only laws at the ports of a lumped model can be written into its own "
                "file, and only supports, masses and loads into that of a structure from a mesh; "
                "give --out with the ending .json, which can be given wherever a model is expected."
            )
        is_structure = choice.kind is ModelKind.STRUCTURE
        text = _structure_text(choice, patch, path) if is_structure else _lumped_text(choice, patch)
        atomic_write_text(path, text)
    else:
        files.write_patch(path, patch)
    return AppliedVerdict(path, sentence, _command_with_model(stored.origin.command, path))


def _is_stated_by_file(choice: ModelChoice, patch: ModelPatch) -> bool:
    """Return whether the own file of a model has tables for all primitives of a patch."""
    if choice.kind is ModelKind.STRUCTURE and choice.path is not None:
        is_of_mesh = isinstance(load_structure(choice.path), MeshDesign)
        return is_of_mesh and all(isinstance(primitive, WRITTEN) for primitive in patch)
    return choice.kind is ModelKind.LUMPED and all(
        isinstance(primitive, PortForce) and not primitive.windows for primitive in patch
    )


def _structure_text(choice: ModelChoice, patch: files.StoredPatch, output: Path) -> str:
    """Return the text of a structure's file, changed as a patch says.

    The name of the structure gets the ending `_patched`. A calibrated parameter replaces the key
    `nominal` of its `[[parameter]]` by its posterior mean, or the key `mass` of a `[[mass]]` of the
    same name.

    Parameters
    ----------
    choice : ModelChoice
        The model, whose file is read.
    patch : StoredPatch
        The changes of the structure and the calibrated parameters.
    output : Path
        The file that will be written; relative names in the text begin at its folder.

    Raises
    ------
    ModelError
        If the file cannot state a change.
    """
    structure_file = choice.path
    assert structure_file is not None
    with ModelError.instead_of(FiniteElementError, before=f"{output}: "):
        tables = changed_tables(structure_file, patch.patch, output.parent)
    calibrated_means = {parameter.name: float(parameter.mean) for parameter in patch.parameters}
    for row in tables.get("parameter", ()):
        if row["name"] in calibrated_means:
            row["nominal"] = calibrated_means[row["name"]]
    for row in tables.get("mass", ()):
        if row["name"] in calibrated_means:
            row["mass"] = calibrated_means[row["name"]]
    tables["name"] = f"{tables['name']}_patched"
    return (
        f"# {patch.sentence}\n# Changes and parameters: {patch.origin.short_command}\n\n"
        f"{toml_text(tables)}"
    )


def _check_destination(
    path: Path, choice: ModelChoice, verdict_file: Path, *, replace: bool
) -> None:
    """Raise an error if a destination has an unknown ending, exists, or is a source of the model.

    With `replace` it may exist, but never be a file from which the patched model is made.
    """
    if path.suffix not in ENDINGS:
        raise FileNotWrittenError(
            f"{path} must end in one of {', '.join(ENDINGS)}: choose another --out."
        )
    patch_file = verdict_file.parent / files.PATCH_NAME
    sources = (choice.file, *choice.base_files, choice.path or "", verdict_file, patch_file)
    if path.exists() and path.resolve() in {Path(source).resolve() for source in sources}:
        raise FileNotWrittenError(
            f"{path} is a file from which the patched model is made: choose another --out."
        )
    refuse_existing(path, replace=replace)


def _applied_effects(patch: files.StoredPatch) -> str:
    """Return the effects of a patch with their places, as the beginning of a sentence."""
    phrases = []
    for effect in patch.effects:
        phrases.append(f"{effect.name} at {effect.place}" if effect.place else effect.name)
    return capital(" and ".join(phrases))


def _certainty_clause(patch: files.StoredPatch, stored: files.StoredVerdict) -> str:
    """Return how certain the effects of a patch are, as the end of a sentence."""
    certainty = {
        VerdictKind.NAMED: "named",
        VerdictKind.NAMED_IN_PART: "named in part: the remainder has no name",
        VerdictKind.FAMILY: "with a named family, but no named law",
        VerdictKind.GROUP: (
            "one of a group that the data cannot tell apart, and not a name (group: "
            f"{', '.join(stored.verdict.group)})"
        ),
        VerdictKind.UNEXPLAINED: "the best hypothesis for a gap that stays unexplained: not a name",
    }
    return certainty[patch.verdict]


def has_applicable_effects(verdict: Verdict, proof: Proof | None) -> bool:
    """Return whether a verdict has effects that can be applied to the model.

    Effects that increase the error are never applied.
    """
    if proof is not None and proof.has_grown:
        return False
    if verdict.kind is VerdictKind.UNEXPLAINED:
        return _proved_hypothesis(verdict, proof) is not None
    return verdict.kind in files.PATCHED


def _patch_to_apply(
    stored: files.StoredVerdict, file: Path, member: str | None
) -> files.StoredPatch:
    """Return the patch of the effects that are applied.

    The patch is read from the `patch.json` beside the verdict, or made from a recorded hypothesis:
    that of a `member` of a group, or the proved one of an unexplained gap. Raises
    `DiscrepancyError` if the verdict has no such member, or gives nothing to apply.
    """
    verdict = stored.verdict
    is_group = verdict.kind is VerdictKind.GROUP
    if member is not None and (not is_group or member not in verdict.group):
        members = ", ".join(map(repr, verdict.group)) if is_group else "no group"
        raise DiscrepancyError(
            f"--member {member!r} is not in the group of {file}, which has {members}: leave it out."
        )
    if stored.proof is not None and stored.proof.has_grown:
        raise DiscrepancyError(
            f"{file} gives nothing to apply: its proof says that the error grows with what was "
            "found."
        )
    patch_file = file.parent / files.PATCH_NAME
    if member is None and verdict.kind in files.PATCHED and patch_file.is_file():
        return files.read_patch(patch_file)
    hypothesis = None
    if verdict.kind is VerdictKind.UNEXPLAINED:
        hypothesis = _proved_hypothesis(verdict, stored.proof)
    elif verdict.kind in files.APPLIED:
        hypothesis = _recorded_hypothesis(verdict, member)
    if hypothesis is None:
        reason = _NOTHING_TO_APPLY.get(
            verdict.kind, "the effects that the verdict names are missing from the file"
        )
        raise DiscrepancyError(f"{file} gives nothing to apply: {reason}.")
    residuals_file = file.parent / RESIDUALS_NAME
    channels: dict[str, str] = {}
    if residuals_file.is_file():
        channels = files.fmu_outputs(read_residuals(residuals_file).channels)
    return files.StoredPatch(
        verdict=verdict.kind,
        sentence="",
        effects=files.patch_effects(hypothesis.effects),
        channels=channels,
        parameters=hypothesis.parameters,
        origin=stored.origin,
    )


_NOTHING_TO_APPLY = {
    VerdictKind.NOTHING_MISSING: "nothing is missing, and the model needs no change",
    VerdictKind.BELOW_LIMIT: "an effect may be missing, but it cannot be distinguished from noise",
    VerdictKind.DATA_ERROR: "the data contain a fault; correct them first",
    VerdictKind.UNEXPLAINED: ("none of its hypotheses makes the error of the model smaller"),
}
"""Why a verdict gives nothing to apply."""


def _recorded_hypothesis(verdict: Verdict, member: str | None) -> Hypothesis | None:
    """Return the recorded hypothesis with the effects of a verdict, or of a member of its group.

    Without a member, it is that of the first member of a group. The result is None if the verdict
    does not record the hypothesis.
    """
    if verdict.kind is VerdictKind.GROUP:
        identifiers = {*(member or verdict.group[0]).split(" + ")}
    else:
        identifiers = {effect.identifier for effect in verdict.effects}
    for hypothesis in verdict.hypotheses:
        if {*hypothesis.identifiers} == identifiers:
            return hypothesis
    return None


def _proved_hypothesis(verdict: Verdict, proof: Proof | None) -> Hypothesis | None:
    """Return the hypothesis that the proof of an unexplained gap tested, if it lowers the error.

    The result is None if it does not, if there is no proof, or if the verdict does not record it.
    """
    if proof is None or not proof.effects or proof.closed is None or proof.closed.value <= 0.0:
        return None
    for hypothesis in verdict.hypotheses:
        if hypothesis.labels == proof.effects:
            return hypothesis
    return None


def _lumped_text(choice: ModelChoice, patch: files.StoredPatch) -> str:
    """Return the text of a lumped model's file with the laws and parameters of a patch added.

    The priors of calibrated parameters become their posteriors. The laws of an effect get a common
    parameter that scales their force, with the mean 1 and the relative deviation of the patch. The
    model is read from its own file or shipped with the package. Raises `ModelError` if the file
    cannot be read, or if the result is not a valid lumped model.
    """
    file = choice.path or SHIPPED_MODELS / f"{patch.origin.model_file}.toml"
    model_tables = read_toml(file, ModelError, what="lumped model")
    calibrated = {parameter.name: parameter for parameter in patch.parameters}
    for table in model_tables.get("parameter", ()):
        parameter = calibrated.get(table["name"])
        if parameter is not None:
            table["mean"] = parameter.mean
            table["deviation"] = parameter.deviation
    laws = list(model_tables.get("law", ()))
    parameters = list(model_tables.get("parameter", ()))
    for effect in patch.effects:
        names: list[str] = []
        for primitive in effect.patch:
            name = effect.identifier
            # laws of the same effect are numbered from the second on, so that names stay unique
            number_of_same_name = sum(law["name"].startswith(name) for law in laws)
            if number_of_same_name:
                name = f"{name}_{number_of_same_name + 1}"
            laws.append({"name": name, **primitive.to_mapping()})
            names.append(name)
        deviation = _relative_deviation_of_force(effect)
        if deviation > 0.0:
            low, high = RANGE_OF_FORCE_FACTOR
            factor = {"mean": 1.0, "deviation": deviation, "low": low, "high": high}
            parameters.append({"name": f"{names[0]}_factor", "terms": names, **factor})
    model_tables["parameter"] = parameters
    model_tables["law"] = laws
    effects = ", ".join(effect.name for effect in patch.effects)
    model_tables["name"] = f"{model_tables['name']} with {effects}"
    # parsed only as a check, which raises if the result is not a valid model
    LumpedDescription.parse(model_tables, f"{file} with {patch.sentence}")
    comments = f"# {patch.sentence}\n# Laws and parameters: {patch.origin.short_command}\n"
    return f"{comments}\n{toml_text(model_tables)}"


def _relative_deviation_of_force(effect: files.PatchEffect) -> float:
    """Return the standard deviation of the force of an effect's laws over the force.

    The result is half the 90 % interval over 1.645 times the value: of the number that scales the
    force of the first law or, in a patch without intervals, of the first parameter of the effect.
    Of a table of forces, the largest force is taken. Without a finite interval the result is 0.
    """
    law = effect.patch.primitives[0]
    assert isinstance(law, PortForce)  # only laws at ports are written into a model's file
    ranges = [
        (interval.value, interval.low, interval.high)
        for interval in effect.intervals
        if interval.primitive == 0 and interval.parameter == law.proportional[0]
    ]
    ranges += [(estimate.value, estimate.low, estimate.high) for estimate in effect.parameters]
    if curve_of((effect,)) is not None:  # a table of forces: the largest first
        ranges.sort(key=lambda value_low_high: -abs(value_low_high[0]))
    for value, low, high in ranges:
        if value != 0.0 and np.isfinite(high - low):
            return float((high - low) / (2.0 * norm.ppf(0.95) * abs(value)))
    return 0.0


def pack_patched(
    choice: ModelChoice,
    patch: files.StoredPatch,
    path: Path,
    *,
    activate: bool = False,
    replace: bool = False,
    progress: Progress | None = None,
) -> list[str]:
    """Pack the FMU of a wing with the effects and the calibrated parameters of a patch.

    Parameters
    ----------
    choice : ModelChoice
        The wing.
    patch : StoredPatch
        The patch.
    path : Path
        The FMU.
    activate : bool
        True to switch the effects on.
    replace : bool
        True if an existing file may be replaced.
    progress : Progress, optional
        Where the modelling of the wing reports.

    Returns
    -------
    list of str
        Names of the FMU's parameters that switch its effects.

    Raises
    ------
    ModelError
        If the model is not a wing.
    fmu_asset.errors.PatchFileError
        If an FMU cannot carry an effect.
    """
    if choice.design is None:
        raise ModelError(
            f"{path}: only a wing is packed with its effects as an FMU; for {choice.label} give an "
            "--out that ends in .json. Such a file can be given wherever a model is expected."
        )
    effect_tables = []
    for stored_effect in patch.effects:
        primitives = stored_effect.patch.to_list()
        effect_tables.append({"id": stored_effect.identifier, "primitives": primitives})
    content = {"schema": SCHEMA, "effects": effect_tables, "channels": dict(patch.channels)}
    effects = parse_patch(json.dumps(content).encode(), "The patch")
    options: Tailoring = {"state": DigitalState()}
    if choice.kind is ModelKind.CALIBRATION and choice.path is not None:
        options = tailoring(load_calibration(choice.path))
    # The names are those of fields of the state.
    parameters: dict[str, Any] = {parameter.name: parameter.mean for parameter in patch.parameters}
    options["state"] = replace_fields(options["state"], **parameters)
    pack_wing(
        choice.design,
        path,
        patch=effects,
        activate=activate,
        replace=replace,
        progress=progress,
        **options,
    )
    return [f"effect.{effect.id}.active" for effect in effects.effects]


def pack_beside_verdict(choice: ModelChoice, patch_file: Path, path: Path) -> str:
    """Pack the FMU of a wing with the patch of a verdict, and return a sentence about it.

    The effects are switched off in the FMU. If an FMU cannot carry one of them, no FMU is written,
    and the sentence says so.
    """
    try:
        switches = pack_patched(
            choice, files.read_patch(patch_file).combine_with(choice.built_in), path
        )
    except PatchFileError as cause:
        return f"There is no patched FMU: {cause}"
    return f"{path.name} carries it, off until {', '.join(switches)} is set to 1."


def _command_with_model(command: str, model: Path) -> str:
    """Return the command that repeats a verdict's investigation with another model.

    Its results go to a folder named after campaign and model. Paths below the working folder are
    written relative to it, and the default seed is left out.
    """
    words = shlex.split(command)
    campaign_index = 4 if words[3] == "--from-run" else 3
    campaign = Path(words[campaign_index]).name
    replaced_options = ["--model"]
    if "--seed" in words and words[words.index("--seed") + 1] == "0":
        replaced_options.append("--seed")
    for option in replaced_options:
        if option in words:
            index = words.index(option)
            del words[index : index + 2]
    words += ["--model", str(model), "--out", f"verdicts/{campaign}_{model.stem}"]
    return shlex.join(_relative_to_working_folder(word) for word in words)


def _relative_to_working_folder(word: str) -> str:
    """Return a word of a command, relative if it is a path below the working folder."""
    path = Path(word)
    if path.is_absolute() and path.is_relative_to(Path.cwd()):
        return str(path.relative_to(Path.cwd()))
    return word
