"""Parameter sets (SSV) and mappings (SSM): read into plain values by target name."""

from dataclasses import replace
from math import isfinite
from typing import Any

from fmu_asset.archive.declared import BASE_UNITS, UnitInfo
from fmu_asset.coupling.structure import Setting, SettingValue
from fmu_asset.errors import SspError

from .package import MAPPING_TYPE, NAMESPACES, SET_TYPE, SspPackage, tag, validate

VALUE_TYPES = ("Real", "Integer", "Boolean", "Enumeration", "String", "Binary")
"""What SSP 1.0 knows; a text or a binary value is refused where something would take it."""


def read_units(root: Any, kind: str) -> tuple[UnitInfo, ...]:
    """Return the unit definitions of a document of a kind: "ssd" or "ssv"."""
    found = []
    for unit in root.findall(f"{kind}:Units/ssc:Unit", NAMESPACES):
        base = unit.find("ssc:BaseUnit", NAMESPACES)
        exponents = tuple(int(base.get(symbol, "0")) for symbol in BASE_UNITS)
        factor, offset = float(base.get("factor", "1")), float(base.get("offset", "0"))
        found.append(UnitInfo(unit.get("name"), exponents, factor, offset))
    return tuple(found)


def read_bindings(element: Any, package: SspPackage, where: str) -> dict[str, Setting]:
    """Return what the parameter bindings of a component or system give, by target name; the last one counts.

    Raises
    ------
    SspError
        If a set or mapping is missing, not valid, or uses what is not supported.
    """
    found: dict[str, Setting] = {}
    before = len(package.unused)
    for item in element.findall("ssd:ParameterBindings/ssd:ParameterBinding", NAMESPACES):
        found |= _read_binding(item, package, where)
    package.unused[before:] = [name for name in package.unused[before:] if name not in found]
    return found


def _read_binding(element: Any, package: SspPackage, where: str) -> dict[str, Setting]:
    what = f"a parameter binding of {where}"
    if element.get("type", SET_TYPE) != SET_TYPE:
        raise SspError(
            f"{what} in {package.path} is of the type {element.get('type')!r}; only parameter sets are read."
        )
    root = _content(element, "ssd:ParameterValues", "ssv", "ParameterSet", package, what)
    prefix = element.get("prefix", "")
    units = read_units(root, "ssv")
    values: dict[str, Setting] = {}
    for parameter in root.findall("ssv:Parameters/ssv:Parameter", NAMESPACES):
        name = prefix + parameter.get("name")
        if name in values:
            raise SspError(f"{what} in {package.path} gives {name!r} twice; keep one of the two.")
        values[name] = replace(_value(parameter, f"{what} in {package.path}"), units=units)
    mapping = element.find("ssd:ParameterMapping", NAMESPACES)
    if mapping is not None and (mapping.get("source") or len(mapping)):  # an empty one maps nothing
        if mapping.get("type", MAPPING_TYPE) != MAPPING_TYPE:
            raise SspError(f"{what} in {package.path} has a mapping of the type {mapping.get('type')!r}.")
        entries = _content(mapping, None, "ssm", "ParameterMapping", package, f"the mapping of {what}")
        values = _mapped(values, entries, package, f"{what} in {package.path}")
    return values


def _content(element: Any, inline: str | None, kind: str, name: str, package: SspPackage, what: str) -> Any:
    """Return the set or mapping that an element refers to or holds."""
    source = element.get("source")
    if source:
        if element.get("sourceBase", "SSD") != "SSD":
            raise SspError(
                f"{what} in {package.path} lies inside a component, which is not supported; move it out."
            )
        return package.parse(package.resolve(source, what), kind)
    holder = element if inline is None else element.find(inline, NAMESPACES)
    root = None if holder is None else holder.find(f"{kind}:{name}", NAMESPACES)
    if root is None:
        raise SspError(f"{what} in {package.path} has neither a source nor content.")
    validate(_detached(root), kind, f"{what} in {package.path}")
    return root


def _detached(element: Any) -> Any:
    """Return a copy that is a document of its own, as a schema wants it."""
    from lxml import etree

    return etree.fromstring(etree.tostring(element))


def _value(parameter: Any, where: str) -> Setting:
    name = parameter.get("name")
    item = parameter.find("*")  # by the schema, its type comes first
    value: SettingValue = item.get("value")
    if item.tag == tag("ssv:Real"):
        value = _finite(item.get("value"), f"the value of {name!r} of {where}")
    elif item.tag == tag("ssv:Integer"):
        value = int(item.get("value"))
    elif item.tag == tag("ssv:Boolean"):
        value = flag(item, "value")
    return Setting(value, item.get("unit"))


def flag(element: Any, name: str) -> bool:
    """Return a Boolean attribute; false where it is absent."""
    return str(element.get(name, "false")).strip() in ("true", "1")


def read_transformation(element: Any, where: str) -> tuple[float, float]:
    """Return factor and offset of a connection or mapping entry.

    Raises
    ------
    SspError
        If it has a transformation of another kind.
    """
    for kind in ("Boolean", "Integer", "Enumeration"):
        if element.find(f"ssc:{kind}MappingTransformation", NAMESPACES) is not None:
            raise SspError(
                f"{where} has a {kind}MappingTransformation, which is not supported; only linear "
                "transformations are."
            )
    linear = element.find("ssc:LinearTransformation", NAMESPACES)
    if linear is None:
        return 1.0, 0.0
    factor, offset = (
        _finite(linear.get(name, default), f"the {name} of {where}")
        for name, default in (("factor", "1"), ("offset", "0"))
    )
    return factor, offset


def _finite(text: str, what: str) -> float:
    value = float(text)  # a number by its schema, in which NaN and INF are numbers
    if not isfinite(value):
        raise SspError(f"{what} must be a finite number, and {text} came.")
    return value


def _mapped(values: dict[str, Setting], root: Any, package: SspPackage, where: str) -> dict[str, Setting]:
    """Return the values under the names that a mapping gives them; what it does not name is not used."""
    found: dict[str, Setting] = {}
    for entry in root.findall("ssm:MappingEntry", NAMESPACES):
        source, target = entry.get("source"), entry.get("target")
        factor, offset = read_transformation(entry, f"the mapping of {source!r} of {where}")
        if source not in values:  # one mapping may serve several sets
            package.unused.append(target)
            continue
        if target in found:
            raise SspError(f"{where} maps two parameters to {target!r}; keep one of the two.")
        setting = values[source]
        if (factor, offset) != (1.0, 0.0):
            if isinstance(setting.value, bool | str):
                raise SspError(f"{where} scales {source!r}, which is no number.")
            setting = replace(setting, factor=factor, offset=offset)
        if flag(entry, "suppressUnitConversion"):
            setting = replace(setting, unit=None)
        found[target] = setting
    return found
