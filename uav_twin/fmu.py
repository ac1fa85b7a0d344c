"""`uav-twin fmu build`, `info`, `bind` and `check`, and `uav-twin ssp export` and `check`."""

import gc
import re
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import typer

from fmu_asset.errors import SspError, visible
from reporting import terminal
from reporting.errors import ReportingError
from reporting.files import atomic_write_text, refuse_existing
from reporting.words import counted
from scenarios import asset_scripts
from uav_twin import parts
from uav_twin.options import answer, show
from uav_twin.structure import fmu as build_structure
from uav_twin.structure import names_structure

if TYPE_CHECKING:
    pass

_SWITCH = re.compile(r"effect\.[A-Za-z0-9_]+\.active")
"""The switch of a missing effect among the variables of an FMU."""


def bind(
    file: Path, *, out: Path | None = None, step_size: float | None = None, replace: bool = False
) -> None:
    """Draft a binding for an FMU: which variable is which role, in which unit."""
    refuse_existing(out, replace=replace)
    # nothing of 100,000 variables is garbage, and looking for it takes a third of the time
    gc.disable()
    try:
        text = parts.draft_binding(parts.read_fmu(file), step_size=step_size)
    finally:
        gc.enable()
    if out is None:
        typer.echo(text, nl=False)
        return
    atomic_write_text(out, text)
    terminal.say(
        f"{out}: drafted; correct the roles, then run `uav-twin fmu check {file} --binding {out}`."
    )


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
    answer(
        "fmu check",
        record={"file": str(file), "passed": result.passed, "findings": findings},
        json=json,
    )
    if not result.passed:
        raise terminal.error_exit(f"{file}: {counted(len(result.problems), 'problem')}.")


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
            raise typer.BadParameter(
                "--patch, --activate, --interface and --windows are for wings; the design is a "
                "structure."
            )
        build_structure(design, out=out, kind=kind, fmi=fmi, replace=replace)
        return
    target = out or Path("uav_wing.fmu")
    if calibration is not None and design is not None:
        raise typer.BadParameter("the calibration holds its design: give either it or --design.")
    if activate and patch is None:
        raise typer.BadParameter("there is no --patch whose effects could be switched on.")
    if script is not None:
        is_default_form = kind == "python" and fmi == 2 and interface == "co-simulation"
        if any((design, calibration, patch, windows)) or not is_default_form:
            raise typer.BadParameter(
                "--design, --calibration, --patch, --kind, --fmi, --interface and --windows are "
                "for the wing.",
                param_hint="--script",
            )
        source = asset_scripts().get(script, Path(script))
        show("packed", info=parts.build_script_fmu(source, target, replace=replace))
        return
    target = parts.checked_target(target, replace=replace)
    if windows and kind != "compiled":
        raise typer.BadParameter("--windows is for --kind compiled.")
    form: dict[str, Any] = {
        "kind": kind,
        "fmi": fmi,
        "interface": interface,
        "platforms": ("linux64", "win64") if windows else ("linux64",),
    }
    effects = None if patch is None else parts.load_patch(patch)
    parts.check_form(**form, patched=effects is not None)
    asset = None
    if calibration is None:
        wing_design = parts.load_design(design)
    else:
        calibrated_wing = parts.load_calibration(calibration)
        wing_design = calibrated_wing.wing_design
        asset = calibrated_wing.asset
        form |= parts.tailoring(calibrated_wing)
    packed = parts.pack_wing(
        wing_design, target, patch=effects, activate=activate, replace=replace, **form
    )
    show("packed", info=packed, asset=asset)


def info(file: Path, *, variables: bool = True, json: bool = False) -> None:
    """Say what an FMU is: version, capabilities, variables with units and ranges."""
    description, obstacle = parts.inspect_fmu(file)
    fmu_record = parts.describe_fmu(description)
    facts = [
        (name.replace("_", " "), str(value))
        for name, value in fmu_record.items()
        if isinstance(value, str | int | float | bool) and value != ""
    ]
    facts.append(("platforms", ", ".join(fmu_record.get("platforms", ()))))
    effects = []
    for row in fmu_record["variables"]:
        if _SWITCH.fullmatch(row["name"]):
            _, effect, _ = row["name"].split(".")
            effects.append(f"{effect} ({'on' if float(row['start']) else 'off'})")
    if effects:
        facts.append(("effects", ", ".join(effects)))
    rows = [_variable_row(variable) for variable in description.variables] if variables else []
    record = {"file": str(file)} | fmu_record | {"obstacle": obstacle}
    answer("fmu info", record=record, json=json, facts=facts, rows=rows)


def _variable_row(variable: "parts.VariableInfo") -> list[str]:
    """Return the cells of a variable in the table of variables.

    The items of an enumeration stand with its description.
    """
    about = variable.description
    if variable.items:
        items = f"items: {variable.item_list}"
        about = f"{about}; {items}" if about else items
    cells = (
        variable.name,
        variable.causality,
        variable.unit,
        variable.minimum,
        variable.maximum,
        variable.start,
        about,
    )
    return ["" if cell is None else visible(str(cell)) for cell in cells]


def export(what: str, *, out: Path, seed: int | None = None, replace: bool = False) -> None:
    """Write what a scenario flies, or the wing of a design, as an SSP 1.0 file: SSD, SSV, SSM and FMUs."""  # noqa: E501
    parts.checked_target(
        out, replace=replace, file_kind="An SSP file", suffix=".ssp", error=SspError
    )
    if _is_design(what):
        design = None if what == "uav_wing" else Path(what)
        path = parts.export_design(design, out, replace_file=replace)
    else:
        scenario = parts.load_scenario(what)
        path = parts.export_scenario(scenario, out, seed=seed, replace_file=replace)
    terminal.say(f"{path}: {path.stat().st_size / 1024:.0f} KiB")


def _is_design(what: str) -> bool:
    """Return whether a name or path is that of a wing design: a TOML file without a mission."""
    try:
        return what == "uav_wing" or "planform" in parts.read_toml(what, ReportingError)
    except ReportingError:
        return False


def check_system(file: Path, *, json: bool = False) -> None:
    """Check an SSP file: archive, schemas, FMUs, connections, one step; exit code 1 if anything is wrong."""  # noqa: E501
    result = parts.check_ssp(file)
    for problem in result.problems:
        typer.secho(f"problem: {problem}", fg="red", err=True)
    answer(
        "ssp check", record={"passed": not result.problems} | asdict(result), json=json, file=file
    )
    if result.problems:
        raise typer.Exit(1)
