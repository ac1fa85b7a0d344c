"""`uav-twin fmu build`, `info`, `bind` and `check`."""

import gc
import re
from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal

import typer

from reporting import terminal
from reporting.files import atomic_write_text, refuse_existing
from reporting.words import counted
from scenarios import asset_scripts
from uav_twin import parts
from uav_twin.options import answer, refused, show
from uav_twin.sentences import said
from uav_twin.structure import fmu as build_structure
from uav_twin.structure import names_structure

_SWITCH = re.compile(r"effect\.[A-Za-z0-9_]+\.active")
"""The switch of a missing effect among the variables of an FMU."""


def bind(
    file: Path, *, out: Path | None = None, step_size: float | None = None, replace: bool = False
) -> None:
    """Draft a binding for an FMU: which variable is which role, in which unit."""
    refuse_existing(out, replace=replace)
    gc.disable()  # of 100,000 variables nothing is garbage, and looking for it takes a third of the time
    try:
        text = parts.draft_binding(parts.read_fmu(file), step_size=step_size)
    finally:
        gc.enable()
    if out is None:
        typer.echo(text, nl=False)
        return
    atomic_write_text(out, text)
    terminal.say(f"{out}: drafted; correct the roles, then run `uav-twin fmu check {file} --binding {out}`.")


def check(
    file: Path,
    *,
    binding: Path | None = None,
    cycles: int = 2000,
    step_size: float | None = None,
    step_timeout: float | None = None,
    memory_limit: float | None = None,
    json: bool = False,
) -> None:
    """Check an FMU in every way we know; exit code 1 if anything is wrong with it."""
    result = parts.check_fmu(
        file,
        binding,
        cycles=cycles,
        step_size=step_size,
        step_timeout=step_timeout,
        memory_limit=memory_limit,
    )
    findings = [asdict(finding) for finding in result.findings]
    answer("fmu check", {"file": str(file), "passed": result.passed, "findings": findings}, json=json)
    if not result.passed:
        raise refused(f"{file}: {counted(len(result.problems), 'problem')}.")


def build(
    *,
    out: Path | None = None,
    design: Path | None = None,
    kind: Literal["python", "compiled", "source"] = "python",
    fmi: int = 2,
    interface: Literal["co-simulation", "model-exchange"] = "co-simulation",
    windows: bool = False,
    calibration: Path | None = None,
    script: str | None = None,
    patch: Path | None = None,
    activate: bool = False,
    replace: bool = False,
) -> None:
    """Pack a wing, a structure or a model script as an FMU; equal input gives equal bytes."""
    if script is None and calibration is None and design is not None and names_structure(design):
        if patch is not None or activate or interface != "co-simulation" or windows:
            raise typer.BadParameter(said("fmu.of_wings"))
        build_structure(design, out=out, kind=kind, fmi=fmi, replace=replace)
        return
    out = out or Path("uav_wing.fmu")
    if calibration is not None and design is not None:
        raise typer.BadParameter("the calibration holds its design: give either it or --design.")
    if activate and patch is None:
        raise typer.BadParameter("there is no --patch whose effects could be switched on.")
    form: dict[str, Any] = {"kind": kind, "fmi": fmi, "interface": interface}
    if script is not None:
        if any((design, calibration, patch, windows)) or [*form.values()] != ["python", 2, "co-simulation"]:
            raise typer.BadParameter(said("fmu.of_the_wing"), param_hint="--script")
        source = asset_scripts().get(script, Path(script))
        show("packed", info=parts.build_script_fmu(source, out, replace=replace))
        return
    out = parts.checked_target(out, replace=replace)
    if windows and kind != "compiled":
        raise typer.BadParameter("--windows is for --kind compiled.")
    form["platforms"] = ("linux64", "win64") if windows else ("linux64",)
    effects = None if patch is None else parts.load_patch(patch)
    parts.check_form(**form, patched=effects is not None)
    if calibration is not None:
        wing = parts.load_calibration(calibration)
        shape, form = wing.wing_design, form | parts.tailoring(wing)
        asset = wing.asset
    else:
        shape, asset = parts.load_design(design), None
    info = parts.pack_wing(shape, out, patch=effects, activate=activate, replace=replace, **form)
    show("packed", info=info, asset=asset)


def info(file: Path, *, variables: bool = True, json: bool = False) -> None:
    """Say what an FMU is: version, capabilities, variables with units and ranges."""
    description, obstacle = parts.inspect_fmu(file)
    described = parts.describe_fmu(description)
    facts = [
        (name.replace("_", " "), str(value))
        for name, value in described.items()
        if isinstance(value, str | int | float | bool) and value != ""
    ]
    facts.append(("platforms", ", ".join(described.get("platforms", ()))))
    switches = [row for row in described["variables"] if _SWITCH.fullmatch(row["name"])]
    effects = (f"{row['name'].split('.')[1]} ({'on' if float(row['start']) else 'off'})" for row in switches)
    facts += [("effects", ", ".join(effects))] * bool(switches)
    keys = ("name", "causality", "unit", "minimum", "maximum", "start", "description")
    rows = [["" if row.get(key) is None else str(row[key]) for key in keys] for row in described["variables"]]
    record = {"file": str(file)} | described | {"obstacle": obstacle}
    answer("fmu info", record, json=json, facts=facts, rows=rows if variables else ())
