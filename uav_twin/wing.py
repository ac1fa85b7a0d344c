"""`uav-twin wing`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from reporting import terminal
from uav_twin.options import Design, refuse_before
from uav_twin.verify import verify

if TYPE_CHECKING:
    from fe.runtime.reduced import Modes, ReducedModel
    from fe.wing.design import WingDesign

PUBLISHED = {
    "tip stiffness": "0.6770 (eq. 14)",
    "first flapwise bending": "5.632 (step 3, e = 1)",
    "second flapwise bending": "28.544 (step 3, e = 1)",
}


wing_app = typer.Typer(no_args_is_help=False)
wing_app.command("verify")(verify)


@wing_app.callback(invoke_without_command=True)
def wing(
    context: typer.Context,
    design: Design = None,
    vtu: Annotated[
        Path | None,
        typer.Option(help="Write the undamaged wing at 3g for ParaView, and its modes beside it."),
    ] = None,
    json: terminal.Json = False,
) -> None:
    """Say what the wing weighs, how it vibrates and how stiff its tip is."""
    if context.invoked_subcommand is not None:
        refuse_before(context)
        return
    from fe.reduction.model_cache import reduced_model
    from fe.wing.design import load_design

    wing_design = load_design(design)
    record = wing_record(wing_design, reduced_model(wing_design, progress=terminal.progress()))
    written = [] if vtu is None else [str(path) for path in write_fields(wing_design, vtu)]
    if json:
        terminal.print_json(record | {"written": written})
        return
    rows = [
        ("mass of the structure", f"{record['structural_mass']:.4f}", "", "kg"),
        ("mass with two servos and pitot", f"{record['mass']:.4f}", "", "kg"),
        ("tip stiffness", f"{1e-3 * record['tip_stiffness']:.4f}", PUBLISHED["tip stiffness"], "N/mm"),
    ]
    for mode in record["modes"]:
        title = f"frequency {mode['number']}" + (f", {mode['shape']}" if mode["shape"] else "")
        rows.append((title, f"{mode['frequency']:.3f}", PUBLISHED.get(mode["shape"], ""), "Hz"))
    terminal.print_table(("figure", "this wing", "published model", "unit"), rows)
    terminal.say("The published figures are of Kapteyn et al. 2021 and belong to the shipped wing.")
    for path in written:
        terminal.say(f"Wrote {path}")


def wing_record(design: "WingDesign", model: "ReducedModel") -> dict[str, Any]:
    """Return mass [kg], stiffness [N/m] and frequencies [Hz] of the undamaged wing by name."""
    from fe.runtime.state import DigitalState

    state = DigitalState()
    modes = model.modes(state.values, state.stiffness_loss)
    structure = structural_mass(design)
    return {
        "design": design.name,
        "design_hash": design.hash,
        "structural_mass": structure,
        "mass": structure + 2 * state.servo_mass + state.pitot_mass,
        "tip_stiffness": float(model.tip_stiffness(state.young_modulus_factor)),
        "modes": [
            {"number": index + 1, "frequency": float(frequency), "shape": mode_name(modes, index)}
            for index, frequency in enumerate(modes.frequency)
        ],
    }


def mode_name(modes: "Modes", index: int) -> str:
    """Return the name of a mode that is followed by its shape, or nothing."""
    names = ("first flapwise bending", "second flapwise bending")
    return dict(zip(modes.followed, names, strict=True)).get(index, "")


def structural_mass(design: "WingDesign") -> float:
    """Return the mass of the structure without its point masses, from the volumes of the cells [kg]."""
    import numpy as np

    from fe.wing.mesh import build_mesh
    from fe.wing.operators import cell_density

    mesh = build_mesh(design)
    return float(mesh.mass(np.arange(len(mesh.cells)), cell_density(mesh)).sum())


def write_fields(design: "WingDesign", path: Path) -> tuple[Path, Path]:
    """Write the undamaged wing in a 3g turn, and its modes in a file beside it; return both paths."""
    from fe.reduction.fields import write_modes_vtu, write_wing_vtu
    from fe.reduction.model_cache import wing_fields
    from fe.runtime.state import DigitalState

    state = DigitalState()
    fields = wing_fields(design, progress=terminal.progress())
    path.parent.mkdir(parents=True, exist_ok=True)
    vector = fields.vector(state.values, state.stiffness_loss, load_factor=3.0)
    write_wing_vtu(path, fields, vector)
    modes = path.with_name(f"{path.stem}-modes{path.suffix}")
    write_modes_vtu(modes, fields, vector)
    return path, modes
