"""A wing design as a TOML file with its sources, as a user would write it."""

from collections.abc import Mapping, Sequence

import numpy as np

from fe.wing.design import WingDesign

DIGITS = 6
"""Significant digits of identified numbers; finer ones lie below the tolerance of the fit."""

HEADER = (
    "The half-wing of the UAV of Kapteyn et al. 2021, as a thin-walled box.",
    "SI units: m, Pa, kg/m^3, kg, N, N/m, N m/rad. "
    "Places along the chord are fractions of the local",
    "chord; ribs, stations and point masses are placed by fractions of the semi-span.",
    "",
    "Written by `python -m evidence.identification`. "
    "Lengths of the planform are those of the wing as built.",
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


def rounded(design: WingDesign) -> dict[str, object]:
    """Return the content of a design with its numbers at `DIGITS` significant digits."""
    tables = design.model_dump(mode="python")
    return {name: _with_rounded_numbers(table) for name, table in tables.items()}


def _with_rounded_numbers(value: object) -> object:
    """Return a value of a design with rounded numbers, and lists for tuples, at every depth."""
    if isinstance(value, float):
        return float(f"{value:.{DIGITS}g}")
    if isinstance(value, dict):
        return {key: _with_rounded_numbers(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_with_rounded_numbers(entry) for entry in value]
    return value


def design_toml(
    design: WingDesign, identified: Mapping[str, str], header: Sequence[str] = HEADER
) -> str:
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
    lines += ["", f"name = {_toml_value(design.name)}"]
    for key, content in rounded(design).items():
        note = f" # {_NOTES[key]}" if key in _NOTES else ""
        if isinstance(content, list):
            for number, entry in enumerate(content):
                note_of_item = note if number == 0 else ""
                lines += ["", f"[[{key}]]{note_of_item}"]
                lines += _key_lines(entry, (key, str(number)), identified)
        elif isinstance(content, dict):
            lines += ["", f"[{key}]{note}"]
            lines += _key_lines(content, (key,), identified)
    return "\n".join(lines) + "\n"


def _key_lines(
    table: Mapping[str, object], place: tuple[str, ...], identified: Mapping[str, str]
) -> list[str]:
    """Return the lines of a table's keys, without those that are empty.

    Parameters
    ----------
    table : mapping
        The table.
    place : tuple of str
        Keys that lead to the table.
    identified : mapping of str to str
        Remark beside each identified number, by its dotted place.
    """
    lines = []
    for key, value in table.items():
        if value is None or value == []:
            continue
        remark = _remark((*place, key), identified)
        comment = f" # {remark}" if remark else ""
        if isinstance(value, list):
            rows = [f"    {_toml_value(entry)}," for entry in value]
            lines += [f"{key} = [{comment}", *rows, "]"]
        else:
            lines.append(f"{key} = {_toml_value(value)}{comment}")
    return lines


def _remark(place: tuple[str, ...], identified: Mapping[str, str]) -> str:
    """Return the remark on a place, or on an identified number below it; empty if there is none."""
    for dotted_place, remark in identified.items():
        keys = dotted_place.split(".")[: len(place)]
        if len(keys) == len(place) and _matches(keys, place):
            return remark
    return ""


def _matches(pattern: Sequence[str], place: Sequence[str]) -> bool:
    """Return whether keys are those of a pattern, in which "*" stands for any key."""
    return all(expected in ("*", key) for expected, key in zip(pattern, place, strict=True))


def _toml_value(value: object) -> str:
    """Return a value as TOML."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        escaped = value.replace("\\", "\\\\").replace('"', '\\"')
        return f'"{escaped}"'
    if isinstance(value, dict):
        pairs = ", ".join(f"{key} = {_toml_value(entry)}" for key, entry in value.items())
        return f"{{ {pairs} }}"
    if isinstance(value, list | tuple):
        items = ", ".join(_toml_value(entry) for entry in value)
        return f"[{items}]"
    if isinstance(value, float):
        return _toml_number(value)
    return str(value)


def _toml_number(value: float) -> str:
    """Return a number as TOML: in engineering notation if it is very large or very small."""
    if value == 0.0 or 1e-4 <= abs(value) < 1e6:
        return np.format_float_positional(value, trim="0")
    mantissa, exponent = f"{value:.{DIGITS - 1}e}".split("e")
    power = int(exponent)
    shift = power % 3  # engineering notation: 9.2e9, 10.1e9
    shifted_mantissa = float(mantissa) * 10.0**shift
    rounded_mantissa = float(f"{shifted_mantissa:.{DIGITS}g}")
    return f"{rounded_mantissa!r}e{power - shift}"
