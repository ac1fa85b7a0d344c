"""A wing design as a TOML file with its sources, as a user would write it."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from fe.wing.design import WingDesign

DIGITS = 6
"""Significant digits of identified numbers; coarser than a step that `least_squares.CONVERGED` allows."""

HEADER = (
    "The half-wing of the UAV of Kapteyn et al. 2021, as a thin-walled box.",
    "SI units: m, Pa, kg/m^3, kg, N, N/m, N m/rad. Places along the chord are fractions of the local",
    "chord; ribs, stations and point masses are placed by fractions of the semi-span.",
    "",
    "Written by `python -m evidence.identification`. Lengths of the planform are those of the wing as built.",
    "Numbers marked 'identified' were fitted together to outputs of the published model",
    "(docs/explanation/identification.md says which, how well, and what was held out).",
    "They are effective numbers of this idealisation, not measured properties of the wing.",
)

_NOTES = {
    "planform": "as built",
    "root": "rigid root rib on springs",
    "masses": "nominal; calibrated later",
    "gauges": "(distance from the root, chord fraction); row A is gauges 1-16, row B gauges 17-24",
    "lift": "net load on the half-wing at the load factor",
    "defects": "upper skin; the first loses z1, the second z2 and so on",
}


def rounded(design: WingDesign, names: Sequence[str] = ()) -> dict[str, Any]:
    """Return the content of a design with its numbers at `DIGITS` significant digits."""
    content: dict[str, Any] = _rounded(design.model_dump(mode="python"))
    return content


def _rounded(value: Any) -> Any:
    if isinstance(value, float):
        return float(f"{value:.{DIGITS}g}")
    if isinstance(value, dict):
        return {key: _rounded(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_rounded(item) for item in value]
    return value


def design_toml(design: WingDesign, identified: Mapping[str, str], header: Sequence[str] = HEADER) -> str:
    """Return a design as TOML.

    Parameters
    ----------
    design : WingDesign
        The design; numbers are written with `DIGITS` significant digits.
    identified : mapping of str to str
        Dotted place of each identified number, "*" for every item of a list, to a remark beside it.
    header : sequence of str
        Comment at the head.
    """
    lines = [f"# {line}".rstrip() for line in header]
    lines += ["", f"name = {_value(design.name)}"]
    for key, content in rounded(design).items():
        if key == "name" or (isinstance(content, list) and not content):
            continue
        note = f" # {_NOTES[key]}" if key in _NOTES else ""
        if isinstance(content, list):
            for number, item in enumerate(content):
                lines += ["", f"[[{key}]]{note if number == 0 else ''}"]
                lines += _items(item, (key, str(number)), identified)
        else:
            lines += ["", f"[{key}]{note}", *_items(content, (key,), identified)]
    return "\n".join(lines) + "\n"


def _items(content: Mapping[str, Any], place: tuple[str, ...], identified: Mapping[str, str]) -> list[str]:
    lines = []
    for key, value in content.items():
        if value is None or value == []:
            continue
        remark = _remark((*place, key), identified)
        tail = f" # {remark}" if remark else ""
        if isinstance(value, list):
            rows = [f"    {_value(item)}," for item in value]
            lines += [f"{key} = [{tail}", *rows, "]"]
        else:
            lines.append(f"{key} = {_value(value)}{tail}")
    return lines


def _remark(place: tuple[str, ...], identified: Mapping[str, str]) -> str:
    for given, remark in identified.items():
        parts = given.split(".")[: len(place)]
        if len(parts) == len(place) and all(a in ("*", b) for a, b in zip(parts, place, strict=True)):
            return remark
    return ""


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {_value(item)}" for key, item in value.items()) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_value(item) for item in value) + "]"
    if isinstance(value, float):
        return _number(value)
    return str(value)


def _number(value: float) -> str:
    if value == 0.0 or 1e-4 <= abs(value) < 1e6:
        return np.format_float_positional(value, trim="0")
    mantissa, exponent = f"{value:.{DIGITS - 1}e}".split("e")
    power = int(exponent)
    shift = power % 3  # engineering notation: 9.2e9, 10.1e9
    scaled = float(mantissa) * 10.0**shift
    return f"{float(f'{scaled:.{DIGITS}g}')!r}e{power - shift}"
