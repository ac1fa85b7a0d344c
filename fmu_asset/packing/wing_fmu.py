"""Packing a reduced model as the wing FMU: FMI 2.0 or 3.0 co-simulation, reproducible to the byte.

What goes into the compiled kind is in `compiled`. Of the Python kind, slave base class and binaries are
pythonfmu's; the archive is packed here and not by its builder, which stamps times, a random GUID and module
names that two FMUs in one process would share.
"""

import json
import os
import re
import zipfile
from collections.abc import Mapping, Sequence
from typing import Literal

from fe.runtime.patch_arrays import PatchArrays
from fe.runtime.reduced import ReducedModel
from fe.runtime.state import DigitalState
from fmu_asset.compiled.compiler import PLATFORM, Platform
from fmu_asset.compiled.package import DATA_FILE, FmiVersion, binaries_of, compiled_members
from fmu_asset.compiled.variable_header import Roles
from fmu_asset.errors import FmuBuildError, PatchFileError
from fmu_asset.instances.plan import Interface
from fmu_asset.slaves.effect_variables import effect_rows, switch_of, units_of
from fmu_asset.slaves.variables import UNITS, FmuVariable, variable_table

from .contents import (
    PLACEHOLDER,
    FmuInfo,
    archive_bytes,
    check_start,
    checked_target,
    content_hash_of,
    emptied,
    filled,
    guid_of,
    room_members,
    tag_of,
    write_fmu,
)
from .patch_file import PatchFile
from .patched_runtime import MODE_COUNT, output_channels, patched_members, plain_effects
from .python_fmu import python_members

FmuKind = Literal["python", "compiled", "source"]
"""Run by Python, compiled for this machine, or the sources of the compiled one alone."""

DESCRIPTION = (
    "Structure of a UAV half-wing: strains, tip displacement and modes from a reduced finite element model "
    "under load factor and tip force, with regions that can lose stiffness."
)

_IMPORTS = """from .slaves.wing_contents import load_contents
from .slaves.wing_slave import WingSlave as _Slave
"""


def build_fmu(
    model: ReducedModel,
    path: str | os.PathLike[str],
    *,
    state: DigitalState | None = None,
    kind: FmuKind = "python",
    note: str = "",
    resources: Mapping[str, bytes] | None = None,
    patch: PatchFile | None = None,
    activate: bool = False,
    arrays: PatchArrays | None = None,
    fmi: FmiVersion = 2,
    interface: Interface = "co-simulation",
    platforms: Sequence[Platform] = (PLATFORM,),
    replace: bool = False,
) -> FmuInfo:
    """Pack a reduced model as an FMU; equal input gives equal bytes.

    Parameters
    ----------
    model : ReducedModel
        The wing.
    path : path-like
        Where to write, with the suffix .fmu.
    state : DigitalState, optional
        Start values of parameters and health; the digital state's defaults if absent.
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
        If the file exists, the suffix is wrong, a start value lies outside the model's validity box, a
        resource would take the place of another file, the kind is not of that version of FMI, the wrong
        pythonfmu is installed, or there is no C compiler for a compiled one.
    PatchFileError
        If the FMU cannot carry an effect of the patch.
    """
    target = checked_target(path, replace=replace)
    content, content_hash = fmu_bytes(
        model,
        state,
        kind,
        note=note,
        resources=resources,
        patch=patch,
        activate=activate,
        arrays=arrays,
        fmi=fmi,
        interface=interface,
        platforms=platforms,
    )
    return write_fmu(target, content, content_hash, "uav_wing", model.design_hash)


def fmu_bytes(
    model: ReducedModel,
    state: DigitalState | None = None,
    kind: FmuKind = "python",
    *,
    note: str = "",
    resources: Mapping[str, bytes] | None = None,
    patch: PatchFile | None = None,
    activate: bool = False,
    arrays: PatchArrays | None = None,
    fmi: FmiVersion = 2,
    interface: Interface = "co-simulation",
    platforms: Sequence[Platform] = (PLATFORM,),
) -> tuple[bytes, str]:
    """Return the archive and its content hash; see `build_fmu`."""
    check_version(kind, fmi, interface)
    start = start_values(model, state or DigitalState())
    mode_count = min(MODE_COUNT, model.mode_count)
    table = _table_of(model, mode_count, start)
    effects = []
    if patch is not None:
        check_kind(kind)
        effects = plain_effects(patch.for_outputs(output_channels(model.gauge_count)))
        start |= {switch_of(effect): float(activate) for effect in effects}
        table += effect_rows(effects, len(table), start)
        check_start(table)
    description = f"{DESCRIPTION} {note}".strip()
    if kind == "python":
        setting = {"mode_count": mode_count, "start": start}
        template = python_members(
            "uav_wing",
            "UavWing_",
            imports=_IMPORTS,
            table=table,
            description=description,
            resources={
                "reduced_model.npz": model.to_bytes(),
                "start.json": (json.dumps(setting, sort_keys=True, indent=1) + "\n").encode(),
            },
            units=UNITS + units_of(table),
        ) | room_members("fe.runtime", f"resources/uav_wing_{PLACEHOLDER}_runtime/fe")
        if effects:
            template |= patched_members(model, effects, arrays)
    else:
        template = compiled_members(
            model,
            table,
            _roles_of(model),
            model_name="uav_wing",
            identifier=f"uav_wing_{PLACEHOLDER}",
            guid=PLACEHOLDER,
            content_tag=PLACEHOLDER,
            description=description,
            fmi=fmi,
            interface=interface,
        )
    for name, content in (resources or {}).items():
        if f"resources/{name}" in template or "/" in name or not name:
            raise FmuBuildError(f"A resource of an FMU cannot have the name {name!r}; choose another one.")
        template[f"resources/{name}"] = content
    return packed(template, "uav_wing", kind, fmi, platforms)


def packed(
    template: Mapping[str, bytes],
    stem: str,
    kind: FmuKind,
    fmi: FmiVersion,
    platforms: Sequence[Platform] = (PLATFORM,),
) -> tuple[bytes, str]:
    """Return the archive of the files with their placeholders, compiled where the kind is, and their hash."""
    content_hash = content_hash_of(template)
    members = filled(template, content_hash)
    if kind == "compiled":
        members |= binaries_of(members, f"{stem}_{tag_of(content_hash)}", fmi, platforms)
    return archive_bytes(members), content_hash


def _table_of(model: ReducedModel, mode_count: int, start: Mapping[str, float]) -> tuple[FmuVariable, ...]:
    """Return the checked table of a wing without missing effects."""
    table = variable_table(
        gauge_count=model.gauge_count,
        mode_count=mode_count,
        regions=model.regions,
        validity=model.validity,
        start=start,
    )
    check_start(table)
    return table


def _roles_of(model: ReducedModel) -> Roles:
    """Return which variables of the wing are what; its second load, the tip force, holds the tip aside."""
    losses = (f"health.{name}" for name in model.regions)
    return Roles(
        chosen=("young_modulus_factor", *losses, "mass.servo", "mass.pitot", "load_factor", "tip_force"),
        outputs=model.gauge_count + 1,
        point_load=1,
        release="initial_tip_displacement",
        load_point="load_point_displacement",
    )


def check_kind(kind: FmuKind) -> None:
    """Refuse a kind of FMU that cannot carry missing effects; raises `PatchFileError`."""
    if kind != "python":
        raise PatchFileError(
            f"The FMU of the kind {kind!r} cannot carry missing effects: build the kind 'python' with this "
            "patch."
        )


def check_version(kind: FmuKind, fmi: FmiVersion, interface: Interface = "co-simulation") -> None:
    """Refuse what a kind of FMU cannot be; raises `FmuBuildError`."""
    if kind == "python" and (fmi, interface) != (2, "co-simulation"):
        raise FmuBuildError(
            f"The FMU of the kind 'python' is of FMI 2.0 for co-simulation, but FMI {fmi}.0 for {interface} "
            "was asked for: build the kind 'compiled' or 'source'."
        )


def start_values(model: ReducedModel, state: DigitalState) -> dict[str, float]:
    """Return the start values of the FMU's variables that a digital state gives, by variable name."""
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
    return declared, guid_of(content_hash_of(emptied(members, tag, declared)))
