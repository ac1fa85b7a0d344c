"""`uav-twin fmu build`, `info`, `bind` and `check`, and `uav-twin ssp export` and `check`."""

import gc
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from fmu_asset.errors import SspError, visible
from reporting import terminal
from reporting.errors import ReportingError
from reporting.files import atomic_write_text, refuse_existing
from reporting.terminal import JsonOption
from reporting.words import counted, in_one_line
from scenarios import asset_scripts
from twin_master.command_options import complete_scenario
from uav_twin.options import (
    FmiOption,
    FmuArgument,
    FmuKind,
    FmuKindOption,
    PlatformsOption,
    ReplaceOption,
    SspArgument,
    StepSizeOption,
    StepTimeoutOption,
    split_platforms,
)
from uav_twin.structure import fmu as build_structure
from uav_twin.structure import is_structure_file, print_packed_fmu

if TYPE_CHECKING:
    from fmu_asset.archive.declared import VariableInfo
    from fmu_asset.compiled.platforms import Platform
    from fmu_asset.ssp.check import SspCheck

_SWITCH = re.compile(r"effect\.[A-Za-z0-9_]+\.active")
"""The name `effect.NAME.active` of the FMU variable that switches an effect of a patch on."""

_COLOUR_OF_VERDICT = {"ok": "green", "warning": "yellow", "problem": "red", "skipped": "dim"}
"""Colours of the rows of `fmu check`."""


def bind(
    file: FmuArgument,
    *,
    out: Annotated[
        Path | None,
        typer.Option("--out", help="The binding file to write; on the terminal by default."),
    ] = None,
    step_size: StepSizeOption = None,
    replace: ReplaceOption = False,
) -> None:
    """Draft a binding for an FMU: the role and the unit of each variable.

    Example: `uav-twin fmu bind pump.fmu --out pump.toml`
    """
    from fmu_asset.archive.fmu_file import read_fmu
    from fmu_asset.client.draft import draft_binding
    from uav_twin.formats import schema_line

    refuse_existing(out, replace=replace)
    # The objects of up to 100,000 variables all stay in use: garbage collection would free nothing
    # and take a third of the time
    gc.disable()
    try:
        text = draft_binding(read_fmu(file), step_size=step_size)
    finally:
        gc.enable()
    if out is None:
        typer.echo(text, nl=False)
        return
    atomic_write_text(out, schema_line("binding") + text)
    terminal.say(
        f"{out}: drafted; correct the roles, then run `uav-twin fmu check {file} --binding {out}`."
    )


def check(
    file: FmuArgument,
    *,
    binding: Annotated[
        Path | None,
        typer.Option(
            "--binding", help="A binding file; drafted from the model description by default."
        ),
    ] = None,
    cycles: Annotated[
        int,
        typer.Option(
            "--cycles",
            min=0,
            help="Instances to make and free in one process; 0 for none.",
        ),
    ] = 2000,
    step_size: Annotated[
        float | None,
        typer.Option(
            "--step-size",
            min=0.0,
            help="Communication step size in seconds of a drafted binding.",
        ),
    ] = None,
    step_timeout: StepTimeoutOption = None,
    memory_limit: Annotated[
        float | None,
        typer.Option("--memory-limit", min=0.0, help="Limit of a worker's memory in MiB."),
    ] = None,
    json: JsonOption = False,
) -> None:
    """Check the file, units and behaviour of an FMU; exit code 1 if a problem is found.

    Example: `uav-twin fmu check pump.fmu --binding pump.toml`
    """
    from fmu_asset.checks.fmu_check import check_fmu

    result = check_fmu(
        file,
        binding,
        cycles=cycles,
        step_size=step_size,
        step_timeout=step_timeout,
        memory_limit=memory_limit,
    )
    if json:
        findings = [asdict(finding) for finding in result.findings]
        terminal.print_json({"file": str(file), "passed": result.passed, "findings": findings})
    else:
        terminal.say(str(file))
        terminal.print_table(
            ("check", "verdict", "found"),
            [
                (finding.check, finding.verdict, in_one_line(finding.text))
                for finding in result.findings
            ],
            [_COLOUR_OF_VERDICT[finding.verdict] for finding in result.findings],
        )
        if result.passed:
            terminal.say(f"{file}: no problem found.")
    if not result.passed:
        raise terminal.error_exit(f"{file}: {counted(len(result.problems), 'problem')}.")


Interface = Literal["co-simulation", "model-exchange"]


def build(
    *,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            help="The file to write: by default uav_wing.fmu, of a structure beside its file.",
        ),
    ] = None,
    design: Annotated[
        Path | None,
        typer.Option(
            "--design",
            help="Wing design, or a structure file beside its mesh; the shipped wing by default.",
        ),
    ] = None,
    kind: FmuKindOption = "python",
    fmi: FmiOption = 2,
    interface: Annotated[
        Interface,
        typer.Option(
            "--interface",
            help="How it is run; in model exchange a compiled wing has its modes as states.",
        ),
    ] = "co-simulation",
    platforms: PlatformsOption = None,
    windows: Annotated[bool, typer.Option("--windows", hidden=True)] = False,
    calibration: Annotated[
        Path | None,
        typer.Option(
            "--calibration",
            help="Tailor it to a wing: the calibration.nc of `uav-twin calibrate`.",
        ),
    ] = None,
    script: Annotated[
        str | None,
        typer.Option(
            "--script", help="Pack this model script instead of a wing: gear_pump, or a file."
        ),
    ] = None,
    patch: Annotated[
        Path | None,
        typer.Option(
            "--patch",
            help="A patch file: missing effects that the FMU carries as tunable parameters.",
        ),
    ] = None,
    activate: Annotated[
        bool,
        typer.Option("--activate", help="Switch the effects of --patch on from the start."),
    ] = False,
    replace: ReplaceOption = False,
) -> None:
    """Pack a wing, a structure or a model script as an FMU; equal input gives equal bytes.

    Example: `uav-twin fmu build --kind compiled --out wing.fmu`
    """
    if windows:
        raise typer.BadParameter(
            "--windows is now --platforms linux64,win64, compiled by zig: pip install "
            "'uav-twin[cross]'."
        )
    if script is None and calibration is None and design is not None and is_structure_file(design):
        if patch is not None or activate or interface != "co-simulation":
            raise typer.BadParameter(
                "--patch, --activate and --interface are for wings; the design is a structure."
            )
        build_structure(design, out=out, kind=kind, fmi=fmi, platforms=platforms, replace=replace)
        return
    target = out or Path("uav_wing.fmu")
    if calibration is not None and design is not None:
        raise typer.BadParameter("the calibration holds its design: give either it or --design.")
    if activate and patch is None:
        raise typer.BadParameter("there is no --patch whose effects could be switched on.")
    if script is not None:
        is_default_form = kind == "python" and fmi == 2 and interface == "co-simulation"
        if any((design, calibration, patch, platforms)) or not is_default_form:
            raise typer.BadParameter(
                "--design, --calibration, --patch, --kind, --fmi, --interface and --platforms are "
                "for the wing.",
                param_hint="--script",
            )
        _build_script(script, target, replace=replace)
        return
    _build_wing(
        target,
        design,
        calibration,
        patch,
        kind=kind,
        fmi=fmi,
        interface=interface,
        platforms=split_platforms(platforms),
        activate=activate,
        replace=replace,
    )


def _build_script(script: str, target: Path, *, replace: bool) -> None:
    """Pack a model script, shipped or of the user, as an FMU, and print the file."""
    from fmu_asset.packing.script import build_script_fmu

    source = asset_scripts().get(script, Path(script))
    print_packed_fmu(build_script_fmu(source, target, replace=replace))


def _build_wing(
    out: Path,
    design: Path | None,
    calibration: Path | None,
    patch: Path | None,
    *,
    kind: FmuKind,
    fmi: int,
    interface: Interface,
    platforms: "Sequence[Platform] | None",
    activate: bool,
    replace: bool,
) -> None:
    """Pack a wing as an FMU, and print the file; see `fmu build` for the options.

    All options are checked before the wing is reduced, which can take minutes.
    """
    from calibration.result.file import Tailoring, load_calibration, tailoring
    from fe.wing.design import load_design
    from fmu_asset.packing.contents import checked_target
    from fmu_asset.packing.patch_file import load_patch
    from fmu_asset.packing.structure_fmu import check_form, pack_wing

    target = checked_target(out, replace=replace)
    version: Literal[2, 3] = 3 if fmi == 3 else 2
    effects = None if patch is None else load_patch(patch)
    check_form(kind, version, interface, patched=effects is not None, platforms=platforms)
    tailored: Tailoring = {}
    if calibration is None:
        wing_design = load_design(design)
    else:
        calibrated_wing = load_calibration(calibration)
        wing_design = calibrated_wing.wing_design
        tailored = tailoring(calibrated_wing)
    packed_fmu = pack_wing(
        wing_design,
        target,
        kind=kind,
        fmi=version,
        interface=interface,
        platforms=platforms,
        patch=effects,
        activate=activate,
        replace=replace,
        **tailored,
    )
    if calibration is not None:
        terminal.say(f"Calibrated for {calibrated_wing.asset}.")
    print_packed_fmu(packed_fmu)


def info(
    file: FmuArgument,
    *,
    variables: Annotated[
        bool, typer.Option("--variables/--no-variables", help="List the variables.")
    ] = True,
    json: JsonOption = False,
) -> None:
    """Print version, capabilities and variables of an FMU, with units and ranges.

    Example: `uav-twin fmu info pump.fmu --no-variables`
    """
    from fmu_asset.archive.declared import describe_fmu
    from fmu_asset.archive.fmu_file import inspect_fmu

    description, obstacle = inspect_fmu(file)
    fmu_record = describe_fmu(description)
    if json:
        terminal.print_json({"file": str(file)} | fmu_record | {"obstacle": obstacle})
        return
    if obstacle:
        terminal.say(f"It cannot be flown here: {obstacle}")
    terminal.say(str(file))
    terminal.print_table(("fact", "value"), _fact_rows(fmu_record))
    if variables and description.variables:
        headings = ("variable", "causality", "unit", "least", "largest", "start", "description")
        rows = [_variable_row(variable) for variable in description.variables]
        terminal.print_table(headings, rows)


def _fact_rows(record: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return the rows (name, value) of the table of facts about an FMU.

    They are the single values of the record, then the platforms, then the effects that a patch has
    added, each with "on" or "off".
    """
    rows = [
        (name.replace("_", " "), str(value))
        for name, value in record.items()
        if isinstance(value, str | int | float | bool) and value != ""
    ]
    rows.append(("platforms", ", ".join(record.get("platforms", ()))))
    effects = []
    for variable in record["variables"]:
        if _SWITCH.fullmatch(variable["name"]):
            _, effect, _ = variable["name"].split(".")
            is_on = bool(float(variable["start"]))
            effects.append(f"{effect} ({'on' if is_on else 'off'})")
    if effects:
        rows.append(("effects", ", ".join(effects)))
    return rows


def _variable_row(variable: "VariableInfo") -> list[str]:
    """Return the cells of a variable; the items of an enumeration are added to its description."""
    description = variable.description
    if variable.items:
        items = f"items: {variable.item_list}"
        description = f"{description}; {items}" if description else items
    cells = (
        variable.name,
        variable.causality,
        variable.unit,
        variable.minimum,
        variable.maximum,
        variable.start,
        description,
    )
    return ["" if cell is None else visible(str(cell)) for cell in cells]


def export(
    what: Annotated[
        str,
        typer.Argument(
            show_default=False,
            metavar="SCENARIO|DESIGN",
            autocompletion=complete_scenario,
            help="A shipped scenario, the path of a scenario, `uav_wing`, or the path of a wing "
            "design.",
        ),
    ],
    *,
    out: Annotated[Path, typer.Option("--out", show_default=False, help="The file to write.")],
    seed: Annotated[
        int | None,
        typer.Option("--seed", min=0, help="Seed of the run; by default that of the scenario."),
    ] = None,
    kind: Annotated[
        Literal["python", "compiled"] | None,
        typer.Option(
            "--kind",
            show_default="as the scenario says, or python",
            help="What evaluates the FMUs that are packed from a design: Python, which other tools "
            "need as well, or compiled C.",
        ),
    ] = None,
    replace: ReplaceOption = False,
) -> None:
    """Write the system of a scenario, or the wing of a design, as an SSP 1.0 file.

    Example: `uav-twin ssp export level_turns --out level_turns.ssp`
    """
    from fmu_asset.packing.contents import checked_target
    from twin_master.assets.system_export import export_design, export_scenario
    from twin_master.scenario.reading import load_scenario

    checked_target(out, replace=replace, file_kind="An SSP file", suffix=".ssp", error=SspError)
    _refuse_what_is_no_system(what)
    is_design = what == "uav_wing" or "planform" in _table_of_file(what)
    if is_design:
        design = None if what == "uav_wing" else Path(what)
        path = export_design(design, out, kind=kind or "python", replace_file=replace)
    else:
        scenario = load_scenario(what)
        path = export_scenario(scenario, out, seed=seed, kind=kind, replace_file=replace)
    terminal.say(f"{path}: {path.stat().st_size / 1024:.0f} KiB")


def _refuse_what_is_no_system(what: str) -> None:
    """Raise an error if an FMU, an SSP file or a structure is given instead of a scenario."""
    from fe.structure.design import is_structure

    takes = "`ssp export` takes a scenario, which says what is connected, or a wing design"
    suffix = Path(what).suffix.lower()
    if suffix == ".fmu":
        raise SspError(
            f'{what} is an FMU, and {takes}: write a scenario with `[asset]`, `kind = "fmu"`, '
            f'`file = "{what}"` and a `binding` of `uav-twin fmu bind {what}`, and export that '
            "scenario."
        )
    if suffix == ".ssp":
        raise SspError(
            f"{what} is an SSP file already, and {takes}: see `uav-twin ssp check {what}`."
        )
    if is_structure(_table_of_file(what)):
        raise SspError(
            f"{what} is a structure, and {takes}: write a scenario with `[asset]`, `kind = "
            f'"structure"` and `structure = "{what}"`, and export that scenario.'
        )


def _table_of_file(path: str) -> Mapping[str, object]:
    """Return the content of a TOML file; empty if there is none, or it is not TOML."""
    from reporting.formats.toml_file import read_toml

    try:
        return read_toml(path, ReportingError)
    except ReportingError:
        return {}


def check_system(file: SspArgument, *, json: JsonOption = False) -> None:
    """Check an SSP file by schemas, FMUs, connections and one step; exit code 1 for a problem.

    Example: `uav-twin ssp check level_turns.ssp`
    """
    from fmu_asset.ssp.check import check_ssp

    result = check_ssp(file)
    for problem in result.problems:
        typer.secho(f"problem: {problem}", fg="red", err=True)
    if json:
        terminal.print_json({"passed": not result.problems} | asdict(result))
    else:
        _print_system(file, result)
    if result.problems:
        raise typer.Exit(1)


def _print_system(file: Path, result: "SspCheck") -> None:
    """Print the warnings about a system of FMUs, and its content if there is no problem."""
    if result.left_out:
        terminal.say(f"warning: {result.left_out}")
    for loop in result.loops:
        terminal.say(
            f"warning: {loop} `uav-twin ssp simulate` does so by --delay, --iterations, "
            "--algorithm jacobi."
        )
    if result.problems:
        return
    order = ", ".join(f"{name} ({model})" for name, model in result.components)
    terminal.say(
        f"{file}: no problem found; {counted(result.connections, 'connection')}, "
        f"{counted(result.parameters, 'parameter')}, one step of {result.step:g} s, evaluated in "
        f"the order {order}."
    )
