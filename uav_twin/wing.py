"""`uav-twin wing` and `uav-twin wing verify`."""

import json
import math
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from fe.runtime.state import DigitalState
from reporting import terminal
from reporting.files import atomic_write_text, refuse_filled
from uav_twin.options import refuse_before, show, told

if TYPE_CHECKING:
    from fe.runtime.reduced import Modes, ReducedModel
    from fe.wing.design import WingDesign
    from fe.wing.operators import AffineOperators
    from reporting.progress import Progress

DAMAGED = (0.4, 0.6)
REFINEMENTS = (0.5, 1.0, 2.0)
QUICK_REFINEMENTS = (0.25, 0.5, 1.0)

wing_app = typer.Typer(no_args_is_help=False)


@wing_app.callback(invoke_without_command=True)
@told("wing")
def wing(
    context: typer.Context, *, design: Path | None = None, vtu: Path | None = None, as_json: bool = False
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
    if as_json:
        terminal.print_json(record | {"written": written})
    else:
        show("wing", record=record, written=written)


def wing_record(design: "WingDesign", model: "ReducedModel") -> dict[str, Any]:
    """Return mass [kg], stiffness [N/m] and frequencies [Hz] of the undamaged wing by name."""
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

    state = DigitalState()
    fields = wing_fields(design, progress=terminal.progress())
    path.parent.mkdir(parents=True, exist_ok=True)
    vector = fields.vector(state.values, state.stiffness_loss, load_factor=3.0)
    write_wing_vtu(path, fields, vector)
    modes = path.with_name(f"{path.stem}-modes{path.suffix}")
    write_modes_vtu(modes, fields, vector)
    return path, modes


@dataclass(frozen=True)
class Check:
    """One line of the verification: what, what came, and the limit that it must keep, if it has one.

    Attributes
    ----------
    group, name : str
        What is checked.
    value : float
        What came.
    limit : float, optional
        Largest allowed value; None for a figure that is only reported.
    note : str
        What stands beside the figure.
    """

    group: str
    name: str
    value: float
    limit: float | None = None
    note: str = ""

    @property
    def passed(self) -> bool:
        """Whether the limit is kept."""
        return self.limit is None or self.value <= self.limit


@wing_app.command("verify")
@told("wing verify")
def verify(*, design: Path | None = None, out: Path | None = None, quick: bool = False) -> None:
    """Check a wing's finite element model: balances, convergence, and CalculiX where it is installed."""
    from fe.verification.calculix_comparison import calculix_program
    from fe.wing.design import load_design

    wing_design = load_design(design)
    refuse_filled(out)
    with tempfile.TemporaryDirectory(prefix="uav-twin-") as scratch:
        jobs = (out or Path(scratch)) / "calculix"
        checks = all_checks(wing_design, jobs, terminal.progress(), quick=quick)
    print_checks(checks)
    if calculix_program() is None:
        terminal.say("CalculiX is not installed (apt-get install calculix-ccx): its checks are left out.")
    if out is not None:
        terminal.say(f"Wrote {write_record(out, wing_design, checks)}")
    end_with(checks)


def print_checks(checks: Sequence[Check]) -> None:
    """Print every check beside its limit."""
    rows = []
    for check in checks:
        limit = "" if check.limit is None else f"{check.limit:.3g}"
        verdict = "" if check.limit is None else "kept" if check.passed else "BROKEN"
        found = f"{check.value:.3g}" + (f" {check.note}" if check.note else "")
        rows.append((check.group, check.name, found, limit, verdict))
    terminal.print_table(("check", "figure", "found", "limit", "verdict"), rows)


def end_with(checks: Sequence[Check]) -> None:
    """End with 1, and say which limits are broken, if any is."""
    broken = [check for check in checks if not check.passed]
    if broken:
        names = "; ".join(f"{check.group}, {check.name}" for check in broken)
        typer.echo(f"{len(broken)} of {len(checks)} checks broke their limit: {names}.", err=True)
        raise typer.Exit(1)


def write_record(folder: Path, design: "WingDesign", checks: Sequence[Check]) -> Path:
    """Write `verification.json`: each check with its value and limit."""
    rows = [
        {**asdict(check), "value": check.value if math.isfinite(check.value) else None}
        | {"passed": check.passed}
        for check in checks
    ]
    record = {"design": design.name, "design_hash": design.hash, "checks": rows}
    return atomic_write_text(folder / "verification.json", json.dumps(record, indent=2) + "\n")


def all_checks(design: "WingDesign", jobs: Path, progress: "Progress", *, quick: bool = False) -> list[Check]:
    """Return every check of a design; those against CalculiX where it is installed.

    Parameters
    ----------
    design : WingDesign
        The wing.
    jobs : Path
        Where CalculiX works.
    progress : Progress
        Where each group of checks is announced.
    quick : bool
        Coarser meshes.
    """
    from fe.verification.calculix_comparison import calculix_program
    from fe.wing.operators import assemble

    checks: list[Check] = []

    def run(title: str, found: Iterable[Check]) -> None:
        with progress.stage(title) as stage:
            for check in found:
                checks.append(check)
                stage.advance(detail=check.name)

    with progress.stage("Meshing the wing"):
        mesh = assemble(design.changed(mesh={"refinement": QUICK_REFINEMENTS[0]}) if quick else design)
    run("Balances of the wing", balance_checks(mesh))
    refinements = QUICK_REFINEMENTS if quick else REFINEMENTS
    run("Convergence of the mesh", convergence_checks(design, refinements, limited=not quick))
    if calculix_program() is not None:
        run("CalculiX on the same mesh", calculix_checks(mesh, jobs))
    return checks


def balance_checks(operators: "AffineOperators") -> Iterator[Check]:
    """Yield the sums that must agree for the wing at the load factor of its lift."""
    from fe.verification.wing_checks import rigid_body_residual, wing_balance

    yield Check("wing", "force of a rigid motion", rigid_body_residual(operators), 1e-12)
    balance = wing_balance(operators, operators.wing_mesh.design.lift.load_factor)
    for name, (found, expected, unit) in balance.items():
        limit = 1e-10 if name == "mass" else 1e-5
        yield Check("wing", name, abs(found / expected - 1.0), limit, f"({found:.5g} {unit})")


def convergence_checks(
    design: "WingDesign", refinements: tuple[float, ...], *, limited: bool = True
) -> Iterator[Check]:
    """Yield the change between the two finest meshes and the observed order of every result.

    Parameters
    ----------
    design : WingDesign
        The wing.
    refinements : tuple of float
        At least three, from coarse to fine, with equal ratios.
    limited : bool
        Hold the changes to their bars, which are made for `REFINEMENTS`.
    """
    import numpy as np

    from fe.verification.wing_checks import mesh_convergence, observed_order

    columns = mesh_convergence(design, refinements)
    middle, fine = refinements[-2:]
    group = f"mesh x{middle:g} to x{fine:g}"

    def order(values: list[float]) -> str:
        found = observed_order(fine / middle, values)
        return "not monotone" if math.isnan(found) else f"order {found:.2f}"

    limit = 0.01 if limited else None
    for name, unit in (("tip stiffness", "N/m"), ("first bending", "Hz"), ("second bending", "Hz")):
        values = columns[name].tolist()
        note = f"({values[-1]:.5g} {unit}, {order(values)})"
        yield Check(group, name, abs(values[-1] / values[-2] - 1.0), limit, note)
    strain = columns["strain"]
    change = np.abs(strain[-1] / strain[-2] - 1.0)
    yield Check(group, "gauges, rms", float(np.sqrt(np.mean(change**2))), limit)
    for gauge, value in enumerate(change, start=1):
        own = strain[:, gauge - 1].tolist()
        note = f"({1e6 * own[-1]:.0f} microstrain, {order(own)})"
        yield Check(group, f"gauge {gauge}", float(value), None, note)
    yield Check(group, "unknowns of the finest mesh", int(columns["unknowns"][-1]))


def calculix_checks(operators: "AffineOperators", jobs: Path) -> Iterator[Check]:
    """Yield the differences to CalculiX on the identical mesh: statics and six modes."""
    from fe.verification.calculix_comparison import agreement, wing_deck

    damaged = tuple(DAMAGED[number % 2] for number in range(len(operators.regions)))
    for health, loss in (("healthy", ()), ("damaged", damaged)):
        group = f"CalculiX, {health}"
        found = agreement(wing_deck(operators, DigitalState(stiffness_loss=loss)), jobs / health)
        for load, differences in found.loads.items():
            for what, value in differences.items():
                yield Check(group, f"{load}: {what}", value, 1e-5)
        yield Check(group, f"frequencies 1 to {len(found.ours)}", found.modal, 1e-5)
