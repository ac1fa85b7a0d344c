"""`uav-twin wing` and `wing verify`: the wing as a finite element model."""

import json as json_text
import tempfile
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from reporting import terminal
from reporting.files import atomic_write_text, refuse_filled
from reporting.terminal import JsonOption
from uav_twin.options import DesignOption

if TYPE_CHECKING:
    from fe.runtime.state import DigitalState
    from fe.wing.design import WingDesign

PUBLISHED_FREQUENCIES = {
    "first flapwise bending": "5.632 (step 3, e = 1)",
    "second flapwise bending": "28.544 (step 3, e = 1)",
}
"""Frequencies of the published model [Hz], Kapteyn et al. 2021, by the shape of the mode."""


def wing(
    *,
    design: DesignOption = None,
    vtu: Annotated[
        Path | None,
        typer.Option(
            "--vtu",
            help="Write the undamaged wing at 3g for ParaView, and its modes beside it.",
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Print the mass, the modes and the tip stiffness of the wing.

    Example: `uav-twin wing --vtu wing.vtu`
    """
    from fe.reduction.model_cache import reduced_model
    from fe.runtime.state import DigitalState
    from fe.wing.design import load_design
    from fe.wing.operators import structural_mass

    wing_design = load_design(design)
    state = DigitalState()
    model = reduced_model(wing_design)
    modes = model.modes(state.values, state.stiffness_loss)
    bendings = ("first flapwise bending", "second flapwise bending")
    name_of_mode = dict(zip(modes.followed, bendings, strict=True))
    mass_of_structure = structural_mass(wing_design)
    written_files = [] if vtu is None else _write_wing_fields(vtu, wing_design, state)
    record = {
        "design": wing_design.name,
        "design_hash": wing_design.hash,
        "structural_mass": mass_of_structure,
        # The wing carries two servos and a pitot tube
        "mass": mass_of_structure + 2 * state.servo_mass + state.pitot_mass,
        "tip_stiffness": float(model.tip_stiffness(state.young_modulus_factor)),
        "modes": [
            {
                "number": index + 1,
                "frequency": float(frequency),
                "shape": name_of_mode.get(index, ""),
            }
            for index, frequency in enumerate(modes.frequency)
        ],
        "written": [str(path) for path in written_files],
    }
    if as_json:
        terminal.print_json(record)
    else:
        _print_wing(record)


def _write_wing_fields(
    path: Path, wing_design: "WingDesign", state: "DigitalState"
) -> tuple[Path, Path]:
    """Write the fields of a wing at a load factor of 3, and its modes, as two VTU files."""
    from fe.reduction.model_cache import wing_fields, write_modes_vtu, write_wing_vtu

    fields = wing_fields(wing_design)
    vector = fields.vector(state.values, state.stiffness_loss, load_factor=3.0)
    path_of_modes = path.with_name(f"{path.stem}-modes{path.suffix}")
    write_wing_vtu(path, fields, vector)
    write_modes_vtu(path_of_modes, fields, vector)
    return path, path_of_modes


def _print_wing(record: dict[str, Any]) -> None:
    """Print masses, stiffness and frequencies beside published values, and the written files."""
    rows = [
        ("mass of the structure", f"{record['structural_mass']:.4f}", "", "kg"),
        ("mass with two servos and pitot", f"{record['mass']:.4f}", "", "kg"),
        ("tip stiffness", f"{1e-3 * record['tip_stiffness']:.4f}", "0.6770 (eq. 14)", "N/mm"),
    ]
    for mode in record["modes"]:
        shape = mode["shape"]
        name = f"frequency {mode['number']}, {shape}" if shape else f"frequency {mode['number']}"
        published = PUBLISHED_FREQUENCIES.get(shape, "")
        rows.append((name, f"{mode['frequency']:.3f}", published, "Hz"))
    terminal.print_table(("figure", "this wing", "published model", "unit"), rows)
    terminal.say("The published figures are of Kapteyn et al. 2021 and belong to the shipped wing.")
    for path in record["written"]:
        terminal.say(f"Wrote {path}")


def verify_wing(
    *,
    design: DesignOption = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", help="Folder for the record and the jobs of CalculiX; it must be empty."
        ),
    ] = None,
    quick: Annotated[
        bool,
        typer.Option("--quick", help="Coarser meshes, and no limit on their convergence."),
    ] = False,
) -> None:
    """Check a wing's finite element model: balances, convergence, and CalculiX where it is installed.

    Example: `uav-twin wing verify --quick --out verification`
    """  # noqa: E501
    from fe.verification.calculix_run import calculix_program
    from fe.verification.wing_checks import all_checks
    from fe.wing.design import load_design
    from reporting.json_file import plain
    from uav_twin.check_table import exit_if_broken, print_checks

    wing_design = load_design(design)
    refuse_filled(out)
    with tempfile.TemporaryDirectory(prefix="uav-twin-") as scratch:
        checks = all_checks(wing_design, (out or Path(scratch)) / "calculix", quick=quick)
    print_checks(checks)
    if calculix_program() is None:
        terminal.say(
            "CalculiX is not installed (apt-get install calculix-ccx): its checks are left out."
        )
    if out is not None:
        rows = [asdict(check) | {"passed": check.passed} for check in checks]
        record = plain(
            {"design": wing_design.name, "design_hash": wing_design.hash, "checks": rows}
        )
        text = json_text.dumps(record, indent=2) + "\n"
        path = atomic_write_text(out / "verification.json", text)
        terminal.say(f"Wrote {path}")
    exit_if_broken(checks)
