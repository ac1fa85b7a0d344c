"""`uav-twin wing` and `uav-twin wing verify`, and how checks end."""

import json
import tempfile
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from fe.runtime.state import DigitalState
from reporting import terminal
from reporting.files import atomic_write_text, refuse_filled
from uav_twin import parts
from uav_twin.options import answer, refused, show


def wing(*, design: Path | None = None, vtu: Path | None = None, as_json: bool = False) -> None:
    """Say what the wing weighs, how it vibrates and how stiff its tip is."""
    drawn, state, written = parts.load_design(design), DigitalState(), list[Path]()
    model = parts.reduced_model(drawn)
    modes, structure = model.modes(state.values, state.stiffness_loss), parts.structural_mass(drawn)
    shapes = dict(zip(modes.followed, ("first flapwise bending", "second flapwise bending"), strict=True))
    if vtu is not None:
        fields = parts.wing_fields(drawn)
        vtu.parent.mkdir(parents=True, exist_ok=True)
        vector = fields.vector(state.values, state.stiffness_loss, load_factor=3.0)
        written = [vtu, vtu.with_name(f"{vtu.stem}-modes{vtu.suffix}")]
        parts.write_wing_vtu(written[0], fields, vector)
        parts.write_modes_vtu(written[1], fields, vector)
    record = {
        "design": drawn.name,
        "design_hash": drawn.hash,
        "structural_mass": structure,
        "mass": structure + 2 * state.servo_mass + state.pitot_mass,
        "tip_stiffness": float(model.tip_stiffness(state.young_modulus_factor)),
        "modes": [
            {"number": index + 1, "frequency": float(frequency), "shape": shapes.get(index, "")}
            for index, frequency in enumerate(modes.frequency)
        ],
        "written": [*map(str, written)],
    }
    answer("wing", record, json=as_json)


def verify(*, design: Path | None = None, out: Path | None = None, quick: bool = False) -> None:
    """Check a wing's finite element model: balances, convergence, and CalculiX where it is installed."""
    drawn = parts.load_design(design)
    refuse_filled(out)
    with tempfile.TemporaryDirectory(prefix="uav-twin-") as scratch:
        checks = parts.all_checks(drawn, (out or Path(scratch)) / "calculix", quick=quick)
    show("checks", checks=checks)
    if parts.calculix_program() is None:
        terminal.say("CalculiX is not installed (apt-get install calculix-ccx): its checks are left out.")
    if out is not None:
        rows = [asdict(check) | {"passed": check.passed} for check in checks]
        record = parts.plain({"design": drawn.name, "design_hash": drawn.hash, "checks": rows})
        path = atomic_write_text(out / "verification.json", json.dumps(record, indent=2) + "\n")
        terminal.say(f"Wrote {path}")
    end_with(checks)


def end_with(checks: "Sequence[parts.Check]") -> None:
    """End with 1, and say which limits are broken, if any is."""
    broken = [f"{check.group}, {check.name}" for check in checks if not check.passed]
    if broken:
        raise refused(f"{len(broken)} of {len(checks)} checks broke their limit: {'; '.join(broken)}.")
