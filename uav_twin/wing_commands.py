"""`uav-twin wing` and `wing verify`: the wing as a finite element model."""

import json
import tempfile
from dataclasses import asdict
from pathlib import Path

from fe.runtime.state import DigitalState
from reporting import terminal
from reporting.files import atomic_write_text, refuse_filled
from uav_twin import parts
from uav_twin.options import answer, show
from uav_twin.structure import end_with


def wing(*, design: Path | None = None, vtu: Path | None = None, as_json: bool = False) -> None:
    """Say what the wing weighs, how it vibrates and how stiff its tip is."""
    wing_design = parts.load_design(design)
    state = DigitalState()
    model = parts.reduced_model(wing_design)
    modes = model.modes(state.values, state.stiffness_loss)
    bendings = ("first flapwise bending", "second flapwise bending")
    name_of_mode = dict(zip(modes.followed, bendings, strict=True))
    structural_mass = parts.structural_mass(wing_design)
    written = [] if vtu is None else _write_wing_fields(vtu, wing_design, state)
    record = {
        "design": wing_design.name,
        "design_hash": wing_design.hash,
        "structural_mass": structural_mass,
        "mass": structural_mass + 2 * state.servo_mass + state.pitot_mass,
        "tip_stiffness": float(model.tip_stiffness(state.young_modulus_factor)),
        "modes": [
            {
                "number": index + 1,
                "frequency": float(frequency),
                "shape": name_of_mode.get(index, ""),
            }
            for index, frequency in enumerate(modes.frequency)
        ],
        "written": [str(path) for path in written],
    }
    answer("wing", record=record, json=as_json)


def _write_wing_fields(
    path: Path, wing_design: "parts.WingDesign", state: DigitalState
) -> tuple[Path, Path]:
    """Write the fields of a wing in a 3 g turn, and its modes beside them; return both files."""
    fields = parts.wing_fields(wing_design)
    vector = fields.vector(state.values, state.stiffness_loss, load_factor=3.0)
    path_of_modes = path.with_name(f"{path.stem}-modes{path.suffix}")
    parts.write_wing_vtu(path, fields, vector)
    parts.write_modes_vtu(path_of_modes, fields, vector)
    return path, path_of_modes


def verify_wing(
    *, design: Path | None = None, out: Path | None = None, quick: bool = False
) -> None:
    """Check a wing's finite element model: balances, convergence, and CalculiX where it is installed."""  # noqa: E501
    wing_design = parts.load_design(design)
    refuse_filled(out)
    with tempfile.TemporaryDirectory(prefix="uav-twin-") as scratch:
        checks = parts.all_checks(wing_design, (out or Path(scratch)) / "calculix", quick=quick)
    show("checks", checks=checks)
    if parts.calculix_program() is None:
        terminal.say(
            "CalculiX is not installed (apt-get install calculix-ccx): its checks are left out."
        )
    if out is not None:
        rows = [asdict(check) | {"passed": check.passed} for check in checks]
        record = parts.plain(
            {"design": wing_design.name, "design_hash": wing_design.hash, "checks": rows}
        )
        path = atomic_write_text(out / "verification.json", json.dumps(record, indent=2) + "\n")
        terminal.say(f"Wrote {path}")
    end_with(checks)
