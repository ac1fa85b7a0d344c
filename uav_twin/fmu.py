"""`uav-twin fmu ...`."""

import re
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import typer

from reporting import terminal
from reporting.files import atomic_write_text, refuse_existing
from reporting.words import counted
from scenarios import asset_scripts
from uav_twin.options import say_packed, told
from uav_twin.sentences import said
from uav_twin.simulated import simulate
from uav_twin.structure import fmu as build_structure
from uav_twin.structure import names_structure

if TYPE_CHECKING:
    from fmu_asset.packing.contents import FmuInfo


@told("fmu bind")
def bind(
    file: Path, *, out: Path | None = None, step_size: float | None = None, replace: bool = False
) -> None:
    """Draft a binding for an FMU: which variable is which role, in which unit."""
    import gc

    from fmu_asset.archive.fmu_file import read_fmu
    from fmu_asset.door.draft import draft_binding

    refuse_existing(out, replace=replace)
    gc.disable()  # of 100,000 variables nothing is garbage, and looking for it takes a third of the time
    try:
        text = draft_binding(read_fmu(file), step_size=step_size)
    finally:
        gc.enable()
    if out is None:
        typer.echo(text, nl=False)
        return
    atomic_write_text(out, text)
    terminal.say(f"{out}: drafted; correct the roles, then run `uav-twin fmu check {file} --binding {out}`.")


_COLOURS = {"ok": "green", "warning": "yellow", "problem": "red", "skipped": "dim"}


@told("fmu check")
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
    from fmu_asset.check import check_fmu

    result = check_fmu(
        file,
        binding,
        cycles=cycles,
        step_size=step_size,
        step_timeout=step_timeout,
        memory_limit=memory_limit,
        progress=terminal.progress(),
    )
    if json:
        findings = [asdict(finding) for finding in result.findings]
        terminal.print_json({"file": str(file), "passed": result.passed, "findings": findings})
    else:
        terminal.say(str(file))
        rows = [(found.check, found.verdict, found.text) for found in result.findings]
        colours = [_COLOURS[found.verdict] for found in result.findings]
        terminal.print_table(("check", "verdict", "found"), rows, colours)
    if not result.passed:
        typer.secho(f"{file}: {counted(len(result.problems), 'problem')}.", fg="red", err=True)
        raise typer.Exit(1)
    if not json:
        terminal.say(f"{file}: no problem found.")


_SWITCH = re.compile(r"effect\.[A-Za-z0-9_]+\.active")
"""The switch of a missing effect among the variables of an FMU."""

fmu_app = typer.Typer(no_args_is_help=True, help="Build, describe, bind, check and simulate FMUs.")


@fmu_app.command("build")
@told("fmu build")
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
    if script is None:
        form = {"kind": kind, "fmi": 3 if fmi == 3 else 2, "interface": interface}
        info = _packed_wing(
            out, design, calibration, patch, form, windows=windows, activate=activate, replace=replace
        )
        say_packed(info)
        return
    if any((design, calibration, patch, windows)) or (kind, fmi, interface) != ("python", 2, "co-simulation"):
        raise typer.BadParameter(said("fmu.of_the_wing"), param_hint="--script")
    from fmu_asset.packing.contents import build_script_fmu

    built = build_script_fmu(asset_scripts().get(script, Path(script)), out, replace=replace)
    terminal.say(f"{built.path}: {built.size / 1024:.0f} KiB, GUID {built.guid}")


def _packed_wing(
    out: Path,
    design: Path | None,
    calibration: Path | None,
    patch: Path | None,
    form: dict[str, Any],
    *,
    windows: bool,
    activate: bool,
    replace: bool,
) -> "FmuInfo":
    """Pack a wing, tailored where it was calibrated; `form`: its kind, version of FMI and interface."""
    from fe.wing.design import load_design
    from fmu_asset.packing.contents import checked_target
    from fmu_asset.packing.patch_file import load_patch
    from fmu_asset.packing.structure_fmu import check_form, pack_wing

    out = checked_target(out, replace=replace)
    if windows and form["kind"] != "compiled":
        raise typer.BadParameter("--windows is for --kind compiled.")
    form["platforms"] = ("linux64", "win64") if windows else ("linux64",)
    effects = None if patch is None else load_patch(patch)
    check_form(**form, patched=effects is not None)
    if calibration is None:
        shape = load_design(design)
    else:
        from calibration.result.file import load_calibration, tailoring

        wing = load_calibration(calibration)
        shape = wing.wing_design
        form |= tailoring(wing)
    progress = terminal.progress()
    info = pack_wing(shape, out, patch=effects, activate=activate, replace=replace, progress=progress, **form)
    if calibration is not None:
        terminal.say(f"Calibrated for {wing.asset}.")
    return info


@fmu_app.command("info")
@told("fmu info")
def info(file: Path, *, variables: bool = True, json: bool = False) -> None:
    """Say what an FMU is: version, capabilities, variables with units and ranges."""
    from fmu_asset.archive.declared import describe_fmu
    from fmu_asset.archive.fmu_file import inspect_fmu

    description, obstacle = inspect_fmu(file)
    record = describe_fmu(description)
    if json:
        terminal.print_json({"file": str(file)} | record | {"obstacle": obstacle})
        return
    if obstacle:
        terminal.say(f"It cannot be flown here: {obstacle}")
    terminal.say(str(file))
    facts = [
        (name.replace("_", " "), str(value))
        for name, value in record.items()
        if isinstance(value, str | int | float | bool) and value != ""
    ]
    facts.append(("platforms", ", ".join(record.get("platforms", ()))))
    switches = [row for row in record["variables"] if _SWITCH.fullmatch(row["name"])]
    if switches:
        effects = (
            f"{row['name'].split('.')[1]} ({'on' if float(row['start']) else 'off'})" for row in switches
        )
        facts.append(("effects", ", ".join(effects)))
    terminal.print_table(("fact", "value"), facts)
    if variables:
        keys = ("name", "causality", "unit", "minimum", "maximum", "start", "description")
        rows = [
            tuple("" if row.get(key) is None else str(row[key]) for key in keys)
            for row in record["variables"]
        ]
        headings = ("variable", "causality", "unit", "least", "largest", "start", "description")
        terminal.print_table(headings, rows)


fmu_app.command("bind")(bind)
fmu_app.command("check")(check)
fmu_app.command("simulate")(simulate)
