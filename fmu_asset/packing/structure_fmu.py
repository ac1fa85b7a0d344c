"""Packs a wing or any reduced structure as an FMU of FMI 2.0 or 3.0, reproducible to the byte.

The files of the compiled kind are made in `fmu_asset.compiled`. The Python kind uses the slave base
class and the binaries of pythonfmu, but not its builder, which writes times, a random GUID, and
module names that two FMUs in one process would share.
"""

import json
import os
import re
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import replace as dataclass_copy
from typing import Literal, TypedDict, Unpack, get_args

from fe.reduction.model_cache import patch_arrays, reduced_model
from fe.runtime.errors import FiniteElementError
from fe.runtime.patch import LocalStiffnessLoss, ModelPatch
from fe.runtime.patch_arrays import PatchArrays
from fe.runtime.patched_wing import PatchedWing
from fe.runtime.reduced import ReducedModel
from fe.runtime.sensors import needs_structure
from fe.runtime.state import DigitalState
from fe.wing.design import WingDesign
from fmu_asset.archive.fmu_file import DESIGN_RECORD, design_record
from fmu_asset.compiled.compiler import find_compiler
from fmu_asset.compiled.cross_compiler import find_cross_compiler
from fmu_asset.compiled.package import DATA_FILE, compiled_binaries, compiled_members
from fmu_asset.compiled.platforms import FmiVersion, Platform, targets_by_folder
from fmu_asset.description import PLACEHOLDER, Declaration
from fmu_asset.errors import FmuBuildError, PatchFileError
from fmu_asset.instances.plan import Interface
from fmu_asset.packing.contents import (
    UNKNOWN_IDENTITY,
    ContentIdentity,
    FmuInfo,
    check_start_values,
    checked_target,
    guid_of_hash,
    package_members,
    python_members,
    seal_fmu,
    with_identity,
    write_fmu,
)
from fmu_asset.slaves.effects import EffectRecord, effect_rows, switch_name
from fmu_asset.slaves.table import is_wing, structure_table
from reporting.choices import require_one_of
from reporting.files import hash_members
from reporting.progress import Progress

from .patch_file import PatchFile

FmuKind = Literal["python", "compiled", "source"]
"""The evaluation of the model: by Python, by compiled C, or by C sources that are yet to be
compiled."""

_WING_DESCRIPTION = (
    "Structure of a UAV half-wing: strains, tip displacement and modes from a reduced finite "
    "element model under load factor and tip force, with regions that can lose stiffness."
)
_STRUCTURE_DESCRIPTION = (
    "Structure {}: strains, displacements, accelerations and modes from a reduced finite element "
    "model under its loads, with regions that can lose stiffness."
)
_LONGEST_STEM = 40


class FmuOptions(TypedDict, total=False):
    """Options of an FMU to be packed; see `build_fmu`."""

    state: DigitalState | None
    start: Mapping[str, float] | None
    kind: FmuKind
    note: str
    resources: Mapping[str, bytes] | None
    patch: PatchFile | None
    activate: bool
    arrays: PatchArrays | None
    fmi: FmiVersion
    interface: Interface
    platforms: Sequence[Platform] | None


def build_fmu(
    model: ReducedModel,
    path: str | os.PathLike[str],
    *,
    replace: bool = False,
    **options: Unpack[FmuOptions],
) -> FmuInfo:
    """Pack a reduced model as an FMU; equal input gives equal bytes.

    Parameters
    ----------
    path : path-like
        The file to write, with the suffix .fmu.
    state : DigitalState, optional
        The start values of parameters and health of a wing; by default the nominal ones.
    start : mapping of str to float, optional
        Start values by the names of variables; they take precedence over those of `state`.
    kind : {"python", "compiled", "source"}
        How the model is evaluated: by Python in the host, by C that is compiled now, or by C
        sources that are compiled elsewhere.
    note : str
        A text that is added to the description, such as the calibration of the wing, without
        control characters.
    resources : mapping of str to bytes, optional
        Further files of the archive's folder `resources`, by name.
    patch : PatchFile, optional
        Missing effects that the FMU contains, with tunable parameters.
    activate : bool
        Whether these effects are switched on from the start.
    arrays : PatchArrays, optional
        The wing in the basis for patches (`fe.reduction.model_cache.patch_arrays`); needed if an
        effect changes structure or loads, or turns a gauge.
    fmi : {2, 3}
        Version of FMI; 3 for the kinds in C.
    interface : {"co-simulation", "model-exchange"}
        The interface of the FMU; model exchange (the modes are states) for the kinds in C.
    platforms : sequence of str, optional
        The platforms of a compiled FMU's binaries: "linux64", "win64", "darwin64", which are names
        of FMI 2; "x86_64-linux", "x86_64-windows", "x86_64-darwin", "aarch64-darwin" and
        "aarch64-linux", which are names of FMI 3; or "all". The extra `cross` must be installed. By
        default, the C compiler of this host compiles for this host.

    Returns
    -------
    FmuInfo
        Path, GUID, design hash and size of the FMU.

    Raises
    ------
    FmuBuildError
        If the file exists or has the wrong suffix; if a start value names no variable or lies
        outside the valid range of the model; if two variables have the same name; if a resource has
        the name of another file; if the kind is not possible with that version of FMI; or if the
        right pythonfmu, or a C compiler for the kind `compiled`, is not installed.
    PatchFileError
        If the FMU cannot carry an effect of the patch.
    InvalidChoiceError
        If a kind, a version of FMI, an interface or a platform is not one of those above.
    """
    # the form of the FMU
    target = checked_target(path, replace=replace)
    kind = options.get("kind", "python")
    fmi = options.get("fmi", 2)
    interface = options.get("interface", "co-simulation")
    platforms = options.get("platforms")
    patch = options.get("patch")
    check_form(kind, fmi, interface, patched=patch is not None, platforms=platforms)
    # variables and start values
    start = _requested_start_values(model, options)
    build_failure = f"The FMU of the structure {model.name} cannot be built: "
    with FmuBuildError.instead_of(ValueError, before=build_failure, after="."):
        table, roles = structure_table(model, start)
    patch_members: dict[str, bytes] = {}
    if patch is not None:
        effects = patch.for_gauges(len(model.gauges)).plain
        for effect in effects:
            start[switch_name(effect)] = float(options.get("activate", False))
        table += effect_rows(effects, len(table), start)
        patch_members = _patched_members(model, effects, options.get("arrays"))
    check_start_values(table)
    description = _STRUCTURE_DESCRIPTION.format(model.name)
    if is_wing(model):
        description = _WING_DESCRIPTION
    description = f"{description} {options.get('note', '')}".strip()
    declaration = Declaration(stem_of(model), description, table)
    # files of the archive
    if kind == "python":
        template = patch_members | _python_structure_members(model, declaration, start)
    else:
        template = compiled_members(model, declaration, roles, fmi=fmi, interface=interface)
    template[f"resources/{DESIGN_RECORD}"] = design_record(model.design_hash)
    _add_resources(template, options.get("resources") or {})

    def make_binaries(members: dict[str, bytes], tag: str) -> dict[str, bytes]:
        return compiled_binaries(members, f"{declaration.name}_{tag}", fmi, platforms)

    fmu = seal_fmu(template, make_binaries if kind == "compiled" else None)
    return write_fmu(target, fmu, model.design_hash)


def _requested_start_values(model: ReducedModel, options: FmuOptions) -> dict[str, float]:
    """Return the start values from the options `state` and `start`, by variable name."""
    state = options.get("state")
    values = {} if state is None else start_values(model, state)
    for name, value in (options.get("start") or {}).items():
        values[name] = float(value)
    return values


def _python_structure_members(
    model: ReducedModel, declaration: Declaration, start: Mapping[str, float]
) -> dict[str, bytes]:
    """Return the files of an FMU whose model is evaluated by Python.

    `start` has the start values that differ from the defaults, by variable name.
    """
    start_text = json.dumps(start, sort_keys=True, indent=1) + "\n"
    members = python_members(
        declaration,
        "Structure_",
        imports="from .slaves.structure_contents import load_contents\n",
        resources={"reduced_model.npz": model.to_bytes(), "start.json": start_text.encode()},
    )
    runtime_folder = f"resources/{declaration.identifier}_runtime/fe"
    return members | package_members("fe.runtime", runtime_folder)


def _add_resources(template: dict[str, bytes], resources: Mapping[str, bytes]) -> None:
    """Add a user's files to the folder `resources`; raise an error for names in use."""
    for file, content in resources.items():
        name = f"resources/{file}"
        if name in template or "/" in file or not file:
            raise FmuBuildError(
                f"A resource of an FMU cannot have the name {file!r}; choose another one."
            )
        template[name] = content


def _patched_members(
    model: ReducedModel, effects: Sequence[EffectRecord], arrays: PatchArrays | None
) -> dict[str, bytes]:
    """Return the further files of an FMU with effects, by their names in the archive.

    The arrays are the wing in the basis for patches; they are needed if an effect changes more than
    sensors. A `PatchFileError` is raised if they are missing or belong to another wing, or if the
    wing cannot have an effect.
    """
    # Keys are not sorted: their order in the file sets the order of the FMU's variables.
    text = json.dumps(effects, indent=1, allow_nan=False)
    members = {"resources/effects.json": f"{text}\n".encode()}
    primitives: list[dict[str, object]] = []
    for effect in effects:
        primitives += effect["primitives"]
    patch = ModelPatch.from_list(primitives)
    if not needs_structure(patch):
        return members
    if arrays is None:
        raise PatchFileError(
            "The patch changes structure or loads, for which the FMU needs the arrays of the "
            "patched wing: give them as `arrays`, as `fe.reduction.model_cache.patch_arrays` "
            "returns them."
        )
    if arrays.design_hash != model.design_hash:
        raise PatchFileError(
            f"The wing for patches is of the design {arrays.design_hash:.12}, and the reduced "
            f"model of {model.design_hash:.12}; make both of one design."
        )
    # Compute the modes of the patched wing, only to raise an error if the wing cannot carry the
    # patch.
    with PatchFileError.instead_of(FiniteElementError, before="The wing cannot carry the patch: "):
        _ = PatchedWing(arrays).structure_at(model.nominal, patch).modes
    # The stiffness of strips along the span takes most of the bytes. Only local losses of stiffness
    # use it; without them it is left out.
    if not len(patch.of(LocalStiffnessLoss)):
        arrays = dataclass_copy(
            arrays,
            strip_stiffness=arrays.strip_stiffness[:0],
            strip_of=arrays.strip_of[:0],
            term_of=arrays.term_of[:0],
        )
    return {**members, "resources/patch_arrays.npz": arrays.to_bytes()}


def stem_of(model: ReducedModel) -> str:
    """Return a C identifier made from the first 40 characters of a structure's name."""
    plain_name = re.sub(r"[^A-Za-z0-9]+", "_", model.name).strip("_")[:_LONGEST_STEM]
    if plain_name[:1].isalpha():
        return plain_name
    return f"structure_{plain_name}".rstrip("_")


def check_form(
    kind: FmuKind,
    fmi: FmiVersion = 2,
    interface: Interface = "co-simulation",
    *,
    patched: bool = False,
    platforms: Sequence[Platform] | None = None,
) -> None:
    """Check that an FMU of this kind, FMI version, interface and platform can be built here.

    Commands call this function before they reduce a model, which can take minutes.

    Parameters
    ----------
    kind, fmi, interface, platforms
        The form of the FMU; see `build_fmu`.
    patched : bool
        Whether the FMU contains missing effects.

    Raises
    ------
    FmuBuildError
        If the kind does not exist for that version of FMI, or has no platforms; if that version of
        FMI has no folder for a platform; or if a compiler is missing.
    PatchFileError
        If the kind cannot contain missing effects.
    InvalidChoiceError
        If a kind, a version of FMI, an interface or a platform is not one of those of `build_fmu`.
    """
    require_one_of(kind, get_args(FmuKind), "kind")
    require_one_of(fmi, get_args(FmiVersion), "fmi")
    require_one_of(interface, get_args(Interface), "interface")
    if platforms is not None:
        targets_by_folder(platforms, fmi)
        if kind != "compiled":
            raise FmuBuildError(
                f"Platforms are for the kind 'compiled', but the kind {kind!r} was asked for with "
                f"{', '.join(platforms)}: build the kind 'compiled', or choose no platforms."
            )
    if kind == "python" and (fmi != 2 or interface != "co-simulation"):
        raise FmuBuildError(
            f"The FMU of the kind 'python' is of FMI 2.0 for co-simulation, but FMI {fmi}.0 for "
            f"{interface} was asked for: build the kind 'compiled' or 'source'."
        )
    if patched and kind != "python":
        raise PatchFileError(
            f"The FMU of the kind {kind!r} cannot carry missing effects: build the kind 'python' "
            "with this patch."
        )
    if kind == "compiled":
        if platforms is None:
            find_compiler()
        else:
            find_cross_compiler()


def start_values(model: ReducedModel, state: DigitalState) -> dict[str, float]:
    """Return a wing's state as start values of its FMU, by variable name."""
    values = {
        "young_modulus_factor": float(state.young_modulus_factor),
        "damping.alpha": float(state.damping_alpha),
        "damping.beta": float(state.damping_beta),
        "mass.servo": float(state.servo_mass),
        "mass.pitot": float(state.pitot_mass),
    }
    for region, loss in zip(model.regions, model.losses(state.stiffness_loss), strict=True):
        values[f"health.{region}"] = float(loss)
    return values


def recorded_content_hash(path: str | os.PathLike[str]) -> tuple[str, str]:
    """Return the GUID that an FMU of this package declares, and the one computed from its content.

    The two differ if the file was changed after it was built. Compiled binaries are left out of the
    hash, since different compilers make different binaries from the same sources.
    """
    with zipfile.ZipFile(path) as archive:
        # If another tool has packed the archive again, it lists folders too; they are not files.
        names = [name for name in archive.namelist() if not name.endswith("/")]
        members = {name: archive.read(name) for name in names}
    description = members["modelDescription.xml"].decode("utf-8")
    if DATA_FILE in members:
        for name in names:
            if name.startswith("binaries/"):
                members.pop(name, None)
        identifier = description.split('modelIdentifier="', 1)[1].split('"', 1)[0]
    else:
        identifier = members["resources/slavemodule.txt"].decode("ascii").strip()
    # Put the placeholder back in the place of tag and GUID, and take the hash as in `seal_fmu`.
    tag = identifier[-len(PLACEHOLDER) :]
    match = re.search(r'(?:guid|instantiationToken)="([^"]*)"', description)
    declared_guid = "" if match is None else match[1]
    identity = ContentIdentity(tag=tag, guid=declared_guid)
    template = with_identity(members, identity, UNKNOWN_IDENTITY)
    return declared_guid, guid_of_hash(hash_members(template))


def pack_wing(
    design: WingDesign,
    path: str | os.PathLike[str],
    *,
    replace: bool = False,
    progress: Progress | None = None,
    **options: Unpack[FmuOptions],
) -> FmuInfo:
    """Reduce a wing design and pack it as an FMU; equal input gives equal bytes.

    Parameters
    ----------
    design : WingDesign
        A calibrated wing has the design of its calibration, and the options that
        `calibration.result.file.tailoring` returns.
    path : path-like
        The file to write, with the suffix .fmu.
    replace, **options
        See `build_fmu`.

    Raises
    ------
    FiniteElementError
        If the design cannot be modelled.
    FmuBuildError, PatchFileError
        See `build_fmu`.
    """
    model = reduced_model(design, progress=progress)
    options["arrays"] = needed_patch_arrays(design, options.get("patch"), progress)
    return build_fmu(model, path, replace=replace, **options)


def needed_patch_arrays(
    design: WingDesign, patch: PatchFile | None, progress: Progress | None = None
) -> PatchArrays | None:
    """Return the wing in the basis for patches; None if no effect needs it.

    Raises
    ------
    FiniteElementError
        If the design cannot be modelled.
    """
    if patch is None or not needs_structure(patch.patch):
        return None
    return patch_arrays(design, progress)
