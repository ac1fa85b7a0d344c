"""What a verdict is worth, against the sealed truth."""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any


class Outcome(StrEnum):
    """What came out of a case."""

    RIGHT = "right"  # exactly what is hidden was named; nothing, where nothing is hidden
    GROUP = "group"  # a group or family that holds the truth
    OPEN = "open"  # unexplained, below detectability, or a data error
    MISSED = "missed"  # nothing missing, though something is
    PART = "part"  # one of two effects, and nothing wrong
    WRONG = "wrong"  # something that is not there


FAMILIES = {
    "coulomb_friction": "damping",
    "structural_damping": "damping",
    "quadratic_damping": "damping",
    "cubic_stiffness": "stiffness",
    "breathing_crack": "stiffness",
    "joint_micro_slip": "hysteresis",
    "bouc_wen_hysteresis": "hysteresis",
    "gauge_gain": "gain",
    "gauge_misalignment": "gain",
    "point_mass": "mass",
    "high_pass": "filter",
    "free_play": "dead zone",
    "washout": "lift",
    "inertia_relief": "lift",
    "load_place": "load",
    "load_cell": "load",
    "thermal_strain": "zero",
    "gauge_zero_drift": "zero",
    "seating_offset": "zero",
    "mains_hum": "line",
    "unmodelled_mode": "line",
    "clock_error": "clock",
    "stiffness_drift": "time",
    "support_compliance": "compliance",
    "local_stiffness_loss": "compliance",
    "temperature_dependent_modulus": "temperature",
}
"""A word that the family's name holds, by identifier."""


@dataclass(frozen=True)
class Scored:
    """A case, its verdict and what came out.

    Attributes
    ----------
    truth, verdict : mapping
        Contents of the two files.
    outcome : Outcome
        See there.
    covered : mapping of str to bool or None
        By parameter of a rightly named effect: whether the 90 % interval holds the truth; None if
        it cannot be compared (acts at another port than the truth).
    """

    truth: Mapping[str, Any]
    verdict: Mapping[str, Any]
    outcome: Outcome
    covered: Mapping[str, bool | None]


def outcome(truth: Mapping[str, Any], verdict: Mapping[str, Any]) -> Outcome:
    """Return what came out.

    Parameters
    ----------
    truth : mapping
        `identifiers`, `kind`, `accepted`.
    verdict : mapping
        `kind`, `identifiers`, `group`, `family`.
    """
    hidden = set(truth["identifiers"])
    kind, named = str(verdict["kind"]), set(verdict.get("identifiers") or ())
    if kind in truth.get("accepted", ()):
        return Outcome.RIGHT
    outside = truth["kind"] == "outside"
    if kind == "named":
        if named and named == hidden and not outside:
            return Outcome.RIGHT
        return Outcome.PART if named and named < hidden and not outside else Outcome.WRONG
    if kind == "group":
        if not hidden or outside:
            return Outcome.OPEN
        # members may be sets, written "one + other": none of a set's effects may be foreign to the
        # truth
        members = [set(str(effects).split(" + ")) for effects in verdict.get("group") or ()]
        members += [{effects} for effects in named]
        return Outcome.GROUP if any(member <= hidden for member in members) else Outcome.WRONG
    if kind == "family":
        word = str(verdict.get("family", ""))
        families = {FAMILIES.get(name, name) for name in hidden}
        return Outcome.GROUP if any(family in word for family in families) else Outcome.WRONG
    if kind == "nothing missing":
        return Outcome.MISSED if hidden else Outcome.RIGHT
    return Outcome.OPEN


def coverage(truth: Mapping[str, Any], verdict: Mapping[str, Any]) -> dict[str, bool | None]:
    """Return, by parameter, whether the interval of a rightly named effect holds the truth."""
    estimates = verdict.get("estimates") or {}
    places = verdict.get("places") or {}
    covered: dict[str, bool | None] = {}
    for name, (low, _, high) in estimates.items():
        identifier = name.split(".")[0]
        true_place, port = truth["places"].get(identifier), places.get(identifier, "")
        true_value = truth["truth"].get(f"{name}@{port}", truth["truth"].get(name))
        if identifier not in truth["identifiers"]:
            continue
        if true_value is None or (
            f"{name}@{port}" not in truth["truth"] and true_place and port and true_place != port
        ):
            covered[name] = None
            continue
        covered[name] = low <= true_value <= high
    return covered


def load_cases(folder: Path) -> tuple[list[Scored], int]:
    """Read and score all cases that have a verdict; the second value counts those without."""
    cases = []
    missing = 0
    for file in sorted((folder / "sealed").glob("*.json")):
        path = folder / "verdicts" / file.name
        if not path.is_file():
            missing += 1
            continue
        truth = json.loads(file.read_text(encoding="utf-8"))
        verdict = json.loads(path.read_text(encoding="utf-8"))
        result = outcome(truth, verdict)
        covered = (
            coverage(truth, verdict) if result is Outcome.RIGHT and truth["identifiers"] else {}
        )
        cases.append(Scored(truth, verdict, result, covered))
    return cases, missing


def wilson(hits: int, count: int, quantile: float = 1.959964) -> tuple[float, float]:
    """95 % interval of a share (Wilson 1927, J. Am. Stat. Assoc. 22, 209-212)."""
    if count == 0:
        return 0.0, 1.0
    share, square = hits / count, quantile**2
    middle = (share + square / (2 * count)) / (1 + square / count)
    half = (
        quantile
        / (1 + square / count)
        * math.sqrt(share * (1 - share) / count + square / (4 * count**2))
    )
    return max(0.0, middle - half), min(1.0, middle + half)
