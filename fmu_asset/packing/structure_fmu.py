"""From a wing design or any reduced model to an FMU of FMI 2.0 or 3.0, reproducible to the byte.

What goes into the compiled kind is in `compiled`. Of the Python kind, slave base class and binaries are
pythonfmu's; the archive is packed here and not by its builder, which stamps times, a random GUID and module
names that two FMUs in one process would share.
"""

import json
import os
import re
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import replace as changed
from typing import Any, Literal, TypedDict, Unpack, get_args

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
from fmu_asset.compiled.package import (
    DATA_FILE,
    PLATFORM,
    FmiVersion,
    Platform,
    binaries_of,
    compiled_members,
    find_compiler,
)
from fmu_asset.description import PLACEHOLDER, Declaration
from fmu_asset.errors import FmuBuildError, PatchFileError, said
from fmu_asset.instances.plan import Interface
from fmu_asset.packing import contents
from fmu_asset.slaves.effects import effect_rows, switch_of
from fmu_asset.slaves.table import is_wing, structure_table
from reporting.choices import require_one_of
from reporting.files import hash_members
from reporting.progress import Progress

from .patch_file import PatchFile

FmuKind = Literal["python", "compiled", "source"]
"""Run by Python, compiled for this machine, or the sources of the compiled one alone."""

_OF_THE_WING = (
    "Structure of a UAV half-wing: strains, tip displacement and modes from a reduced finite element model "
    "under load factor and tip force, with regions that can lose stiffness."
)
_OF_A_STRUCTURE = (
    "Structure {}: strains, displacements, accelerations and modes from a reduced finite element model under "
    "its loads, with regions that can lose stiffness."
)


class FmuOptions(TypedDict, total=False):
    """What may be said of an FMU to be packed, see `build_fmu`."""

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
    platforms: Sequence[Platform]


def build_fmu(
    model: ReducedModel, path: str | os.PathLike[str], *, replace: bool = False, **options: Unpack[FmuOptions]
) -> contents.FmuInfo:
    """Pack a reduced model as an FMU; equal input gives equal bytes.

    Parameters
    ----------
    model : ReducedModel
        The wing or structure.
    path : path-like
        Where to write, with the suffix .fmu.
    state : DigitalState, optional
        Start values of parameters and health of a wing; the nominal ones if absent.
    start : mapping of str to float, optional
        Start values by variable name that take the place of these.
    kind : {"python", "compiled", "source"}
        What evaluates the model: Python in the host, C compiled now, or C to be compiled elsewhere.
    note : str
        Added to the description, such as what the wing was calibrated with; XML text without control
        characters.
    resources : mapping of str to bytes, optional
        Further files of the archive's folder `resources`, by name.
    patch : PatchFile, optional
        Missing effects that the FMU is to carry as tunable parameters.
    activate : bool
        Whether these are switched on from the start.
    arrays : PatchArrays, optional
        The wing in the basis for patches (`fe.reduction.model_cache.patch_arrays`); needed where an effect
        changes structure or loads, or turns a gauge.
    fmi : {2, 3}
        Version of FMI; 3 for the kinds in C.
    interface : {"co-simulation", "model-exchange"}
        How it is run; model exchange (the modes as states) for the kinds in C.
    platforms : sequence of {"linux64", "win64"}
        What the binaries of a compiled one are for; the latter needs a cross compiler.
    replace : bool
        Whether an existing file may be replaced.

    Raises
    ------
    FmuBuildError
        If the file exists, the suffix is wrong, a start value is of no variable or lies outside the model's
        validity box, a name is taken by a variable of the FMU, a resource would take the place of another
        file, the kind is not of that version of FMI, the wrong pythonfmu is installed, or there is no C
        compiler for a compiled one.
    PatchFileError
        If the FMU cannot carry an effect of the patch.
    InvalidChoiceError
        If a kind, a version of FMI, an interface or a platform is none of those.
    """
    target = contents.checked_target(path, replace=replace)
    kind, fmi = options.get("kind", "python"), options.get("fmi", 2)
    interface, platforms = options.get("interface", "co-simulation"), options.get("platforms", (PLATFORM,))
    patch, state = options.get("patch"), options.get("state")
    check_form(kind, fmi, interface, patched=patch is not None, platforms=platforms)
    values = {} if state is None else start_values(model, state)
    values |= {name: float(value) for name, value in (options.get("start") or {}).items()}
    before = f"The FMU of the structure {model.name} cannot be built: "
    with FmuBuildError.instead_of(ValueError, before=before, after="."):
        table, roles = structure_table(model, values)
    name, kept = stem_of(model), {}
    if patch is not None:
        effects = patch.for_gauges(len(model.gauges)).plain
        values |= {switch_of(effect): float(options.get("activate", False)) for effect in effects}
        table += effect_rows(effects, len(table), values)
        kept = _patched_members(model, effects, options.get("arrays"))
    contents.check_start(table)
    description = _OF_THE_WING if is_wing(model) else _OF_A_STRUCTURE.format(model.name)
    declared = Declaration(name, f"{description} {options.get('note', '')}".strip(), table)
    if kind == "python":
        resources = {
            "reduced_model.npz": model.to_bytes(),
            "start.json": (json.dumps(values, sort_keys=True, indent=1) + "\n").encode(),
        }
        imports = "from .slaves.behaviour import load_contents\n"
        template = kept | contents.python_members(
            declared, "Structure_", imports=imports, resources=resources
        )
        template |= contents.room_members("fe.runtime", f"resources/{declared.identifier}_runtime/fe")
    else:
        template = compiled_members(model, declared, roles, fmi=fmi, interface=interface)
    template[f"resources/{DESIGN_RECORD}"] = design_record(model.design_hash)
    for file, content in (options.get("resources") or {}).items():
        if f"resources/{file}" in template or "/" in file or not file:
            raise FmuBuildError(f"A resource of an FMU cannot have the name {file!r}; choose another one.")
        template[f"resources/{file}"] = content

    def binaries(members: dict[str, bytes], tag: str) -> dict[str, bytes]:
        return binaries_of(members, f"{name}_{tag}", fmi, platforms)

    return contents.write_fmu(
        target, contents.sealed(template, binaries if kind == "compiled" else None), model.design_hash
    )


def _patched_members(
    model: ReducedModel, effects: Sequence[dict[str, Any]], arrays: PatchArrays | None
) -> dict[str, bytes]:
    """Return the further files of an FMU that carries effects, by their names in the archive.

    Parameters
    ----------
    model : ReducedModel
        The wing.
    effects : sequence of dict
        As `PatchFile.plain` has them.
    arrays : PatchArrays or None
        The same wing in the basis for patches; needed where an effect is of more than sensors.

    Raises
    ------
    PatchFileError
        If the arrays are missing or are those of another wing, or the wing cannot carry an effect.
    """
    # The order of keys is that of the variables.
    text = json.dumps(effects, indent=1, allow_nan=False)
    members = {"resources/effects.json": f"{text}\n".encode()}
    patch = ModelPatch.from_list([primitive for effect in effects for primitive in effect["primitives"]])
    if not needs_structure(patch):
        return members
    if arrays is None:
        raise PatchFileError(said("packing.no_arrays"))
    if arrays.design_hash != model.design_hash:
        raise PatchFileError(said("packing.other_design", arrays=arrays, model=model))
    with PatchFileError.instead_of(FiniteElementError, before="The wing cannot carry the patch: "):
        _ = PatchedWing(arrays).structure_at(model.nominal, patch).modes
    if not len(patch.of(LocalStiffnessLoss)):  # strips, which only that needs, are most of the bytes
        strips = ("strip_stiffness", "strip_of", "term_of")
        arrays = changed(arrays, **{name: getattr(arrays, name)[:0] for name in strips})
    return {**members, "resources/patch_arrays.npz": arrays.to_bytes()}


def stem_of(model: ReducedModel) -> str:
    """Return the name of a structure as an identifier of C."""
    plain = re.sub(r"[^A-Za-z0-9]+", "_", model.name).strip("_")[:40]
    return plain if plain[:1].isalpha() else f"structure_{plain}".rstrip("_")


def check_form(
    kind: FmuKind,
    fmi: FmiVersion = 2,
    interface: Interface = "co-simulation",
    *,
    patched: bool = False,
    platforms: Sequence[Platform] = (PLATFORM,),
) -> None:
    """Refuse an FMU that cannot be made here; asked before a model is reduced, which can take minutes.

    Parameters
    ----------
    kind, fmi, interface, platforms
        See `build_fmu`.
    patched : bool
        Whether it is to carry missing effects.

    Raises
    ------
    FmuBuildError
        The kind is not of that version of FMI, or a compiler is missing.
    PatchFileError
        The kind cannot carry missing effects.
    InvalidChoiceError
        A kind, a version of FMI, an interface or a platform is none of those.
    """
    require_one_of(kind, get_args(FmuKind), "kind")
    require_one_of(fmi, get_args(FmiVersion), "fmi")
    require_one_of(interface, get_args(Interface), "interface")
    for platform in platforms:
        require_one_of(platform, get_args(Platform), "platforms")
    if kind == "python" and (fmi, interface) != (2, "co-simulation"):
        raise FmuBuildError(said("packing.python_kind", fmi=fmi, interface=interface))
    if patched and kind != "python":
        raise PatchFileError(said("packing.patched_kind", kind=kind))
    for platform in platforms if kind == "compiled" else ():
        find_compiler(platform)


def start_values(model: ReducedModel, state: DigitalState) -> dict[str, float]:
    """Return the start values of a wing's FMU that a digital state gives, by variable name."""
    losses = zip(model.regions, model.losses(state.stiffness_loss), strict=True)
    return {
        "young_modulus_factor": float(state.young_modulus_factor),
        "damping.alpha": float(state.damping_alpha),
        "damping.beta": float(state.damping_beta),
        "mass.servo": float(state.servo_mass),
        "mass.pitot": float(state.pitot_mass),
        **{f"health.{name}": float(loss) for name, loss in losses},
    }


def recorded_content_hash(path: str | os.PathLike[str]) -> tuple[str, str]:
    """Return the GUID that an FMU of ours declares, and the GUID that its content has today.

    The two differ when the file was changed after it was built. A compiled binary is not part of the content,
    since every compiler makes another one of the same sources.

    Returns
    -------
    declared, actual : str
        GUIDs.
    """
    with zipfile.ZipFile(path) as archive:
        # Archives that other tools have packed again list their folders too.
        members = {name: archive.read(name) for name in archive.namelist() if not name.endswith("/")}
    root = members["modelDescription.xml"].decode("utf-8")
    if DATA_FILE in members:
        members = {name: data for name, data in members.items() if not name.startswith("binaries/")}
        tag = root.split('modelIdentifier="', 1)[1].split('"', 1)[0][-len(PLACEHOLDER) :]
    else:
        tag = members["resources/slavemodule.txt"].decode("ascii").strip()[-len(PLACEHOLDER) :]
    found = re.search(r'(?:guid|instantiationToken)="([^"]*)"', root)
    declared = "" if found is None else found[1]
    return declared, contents.guid_of(
        hash_members(contents.exchanged(members, (tag, declared), (PLACEHOLDER, PLACEHOLDER)))
    )


def pack_wing(
    design: WingDesign,
    path: str | os.PathLike[str],
    *,
    replace: bool = False,
    progress: Progress | None = None,
    **options: Unpack[FmuOptions],
) -> contents.FmuInfo:
    """Reduce a wing design and pack it as an FMU; equal input gives equal bytes.

    Parameters
    ----------
    design : WingDesign
        The wing; of a calibrated one its tailored design, with what `calibration.result.file.tailoring`
        gives among the options.
    path : path-like
        Where to write, with the suffix .fmu.
    replace, **options
        See `fmu_asset.packing.structure_fmu.build_fmu`.
    progress : Progress, optional
        Shows what takes long.

    Raises
    ------
    FiniteElementError
        The design cannot be modelled.
    FmuBuildError, PatchFileError
        See `fmu_asset.packing.structure_fmu.build_fmu`.
    """
    model = reduced_model(design, progress=progress)
    options["arrays"] = arrays_for(design, options.get("patch"), progress)
    return build_fmu(model, path, replace=replace, **options)


def arrays_for(
    design: WingDesign, patch: PatchFile | None, progress: Progress | None = None
) -> PatchArrays | None:
    """Return the wing in the basis for patches; None where the patch does not need it.

    Raises
    ------
    FiniteElementError
        The design cannot be modelled.
    """
    if patch is None or not needs_structure(patch.patch):
        return None
    return patch_arrays(design, progress)
