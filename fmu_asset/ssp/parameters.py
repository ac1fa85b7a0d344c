"""Reads the parameter sets and mappings of an SSP file, and other values in its XML."""

from dataclasses import replace
from math import isfinite
from typing import NamedTuple

from lxml import etree
from lxml.etree import _Element as XmlElement

from fmu_asset.archive.declared import UnitInfo
from fmu_asset.client.units import IDENTITY, Conversion
from fmu_asset.coupling.structure import ComponentSetting, SettingValue
from fmu_asset.errors import SspError
from reporting.units import BASE_UNITS

from .package import NAMESPACES, OWN_NAMESPACE, SSD_NAME, SspPackage


class _RequiredAttribute(NamedTuple):
    """An attribute with its only supported value, and what is wrong with any other."""

    name: str
    value: str
    reason: str


_NO_SOURCE_BASE = _RequiredAttribute(
    "sourceBase", "SSD", "it lies inside a component, which is not supported; move it out"
)
_REQUIRED_ATTRIBUTES = {
    "Component": [
        _RequiredAttribute("type", "application/x-fmu-sharedlibrary", "only FMUs are supported")
    ],
    "ParameterBinding": [
        _RequiredAttribute(
            "type", "application/x-ssp-parameter-set", "only parameter sets are read"
        ),
        _NO_SOURCE_BASE,
    ],
    "ParameterMapping": [
        _RequiredAttribute(
            "type", "application/x-ssp-parameter-mapping", "only parameter mappings are read"
        ),
        _NO_SOURCE_BASE,
    ],
}
"""The required attributes by element."""


class ParameterReader:
    """Reads the parameter sets and mappings that a system structure refers to."""

    def __init__(self, package: SspPackage) -> None:
        self.package = package

    def check_required_attributes(self, element: XmlElement, label: str) -> None:
        """Raise an error if an attribute of an element has an unsupported value."""
        for attribute in _REQUIRED_ATTRIBUTES[etree.QName(element).localname]:
            value = element.get(attribute.name, attribute.value)
            if value != attribute.value:
                raise package_error(
                    self.package, f"{label} has the {attribute.name} {value!r}: {attribute.reason}."
                )

    def transformation(self, element: XmlElement, label: str) -> Conversion:
        """Return the linear transformation of a connection or mapping entry."""
        transformation_element = element.find("ssc:LinearTransformation", NAMESPACES)
        if transformation_element is None:
            return IDENTITY
        factor = self._finite(transformation_element.get("factor", "1"), f"the factor of {label}")
        offset = self._finite(transformation_element.get("offset", "0"), f"the offset of {label}")
        return Conversion(factor, offset)

    def _finite(self, text: str, label: str) -> float:
        """Return a finite number; the schemas also allow NaN and INF, which are refused."""
        value = float(text)
        if not isfinite(value):
            raise package_error(
                self.package, f"{label} must be a finite number, but {text} was given."
            )
        return value

    def _parameter_document(
        self, element: XmlElement, inline: str, kind: str, label: str
    ) -> XmlElement:
        """Return the parameter set or mapping that an element refers to or contains.

        `inline` is the path of the document inside the element, `label` the element's name in
        messages.
        """
        self.check_required_attributes(element, label)
        source = element.get("source")
        if source:
            return self.package.parse(kind, self.package.resolve(source, label))
        root = element.find(inline, NAMESPACES)
        if root is None:
            raise package_error(self.package, f"{label} has neither a source nor content.")
        return self.package.parse(kind, label, etree.tostring(root))

    def parameter_set(self, binding: XmlElement, label: str) -> dict[str, ComponentSetting]:
        """Return the values of a parameter set by name, with the prefix of its binding."""
        root = self._parameter_document(
            binding, "ssd:ParameterValues/ssv:ParameterSet", "ssv", label
        )
        units = unit_definitions(root, "ssv")
        prefix = binding.get("prefix", "")
        values: dict[str, ComponentSetting] = {}
        for parameter in root.iterfind("ssv:Parameters/ssv:Parameter", NAMESPACES):
            name = prefix + parameter.get("name")
            if name in values:
                raise package_error(
                    self.package, f"{label} gives {name!r} twice; keep one of the two."
                )
            type_element = parameter.find("*")  # the schema puts it first
            value = self._parameter_value(type_element, f"the value of {name!r} of {label}")
            values[name] = ComponentSetting(value, type_element.get("unit"), units=units)
        return values

    def _parameter_value(self, type_element: XmlElement, label: str) -> SettingValue:
        """Return the value of a parameter in a parameter set, by its type."""
        kind = etree.QName(type_element).localname
        text: str = type_element.get("value")
        if kind == "Real":
            return self._finite(text, label)
        if kind == "Integer":
            return int(text)
        if kind == "Boolean":
            return flag(type_element, "value")
        if kind == "Binary":
            return bytes.fromhex(text)
        return text

    def mapped_values(
        self,
        values: dict[str, ComponentSetting],
        mapping: XmlElement,
        binding_label: str,
        unmapped_names: list[str],
    ) -> dict[str, ComponentSetting]:
        """Return the values of a parameter set under the names that a mapping gives them.

        A mapping has entries "source name, target name", and may scale the value. Values that it
        does not name are dropped.

        Parameters
        ----------
        binding_label : str
            The name of the parameter binding in messages.
        unmapped_names : list of str
            Extended by the mapped names of values that the set does not have, which is allowed: one
            mapping may serve several sets.
        """
        label = f"the mapping of {binding_label}"
        root = self._parameter_document(mapping, "ssm:ParameterMapping", "ssm", label)
        mapped: dict[str, ComponentSetting] = {}
        for entry in root.iterfind("ssm:MappingEntry", NAMESPACES):
            source, target = entry.get("source"), entry.get("target")
            scale = self.transformation(entry, f"{source!r} in {label}")
            if source not in values:
                unmapped_names.append(target)
                continue
            if target in mapped:
                raise package_error(
                    self.package, f"{label} maps two parameters to {target!r}; keep one of the two."
                )
            setting = values[source]
            if scale != IDENTITY:
                if isinstance(setting.value, bool | str | bytes):
                    raise package_error(
                        self.package, f"{label} scales {source!r}, which is not a number."
                    )
                setting = replace(setting, scale=scale)
            if flag(entry, "suppressUnitConversion"):
                setting = replace(setting, unit=None)
            mapped[target] = setting
        return mapped


def package_error(package: SspPackage, sentence: str) -> SspError:
    """Return the error for a fault in the system structure of an SSP file."""
    return SspError(f"{SSD_NAME} in {package.path}: {sentence}")


def unit_definitions(root: XmlElement, kind: str) -> tuple[UnitInfo, ...]:
    """Return the unit definitions of a document of the kind "ssd" or "ssv"."""
    units = []
    for element in root.iterfind(f"{kind}:Units/ssc:Unit", NAMESPACES):
        base = element.find("ssc:BaseUnit", NAMESPACES)
        unit = UnitInfo(
            name=element.get("name"),
            exponents=tuple(int(base.get(symbol, "0")) for symbol in BASE_UNITS),
            factor=float(base.get("factor", "1")),
            offset=float(base.get("offset", "0")),
        )
        units.append(unit)
    return tuple(units)


def flag(attributes: XmlElement | dict[str, str], name: str) -> bool:
    """Return a Boolean attribute, by default false."""
    return str(attributes.get(name, "false")).strip() in ("true", "1")


def coupling_attributes(element: XmlElement) -> dict[str, str]:
    """Return the attributes of our own annotation of a component or connection, if any."""
    path = f"ssd:Annotations/ssc:Annotation/{{{OWN_NAMESPACE}}}Coupling"
    annotation = element.find(path, NAMESPACES)
    return {} if annotation is None else dict(annotation.attrib)
