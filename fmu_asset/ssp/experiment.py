"""Reads the default experiment of an SSP file: its times, and the step of the system."""

from math import isfinite

from lxml import etree
from lxml.etree import _Element as XmlElement

from fmu_asset.errors import SspError

from .package import NAMESPACES, SSD_NAME


def time_of(experiment: XmlElement | None, attribute: str) -> float | None:
    """Return a time of the default experiment [s]; None if it is not declared."""
    if experiment is None or attribute not in experiment.attrib:
        return None
    return float(experiment.attrib[attribute])


_STEP_ATTRIBUTES = {"FixedStepAlgorithm": "baseStepSize", "FixedStepMaster": "stepSize"}
"""Annotations by which other tools declare the step of a system [s]: OSP and OMSimulator."""


def base_step_of(root: XmlElement, path: str) -> float | None:
    """Return the step that annotations declare for the outermost system [s]; None without one.

    Parameters
    ----------
    path : str
        The SSP file, for the message.

    Raises
    ------
    SspError
        If the step is not a positive number.
    """
    experiment = root.find("ssd:DefaultExperiment", NAMESPACES)
    system = root.find("ssd:System", NAMESPACES)
    for owner in (experiment, system, root):
        annotations = None if owner is None else owner.find("ssd:Annotations", NAMESPACES)
        if annotations is None:
            continue
        for element in annotations.iter(etree.Element):
            attribute = _STEP_ATTRIBUTES.get(etree.QName(element).localname)
            if attribute is not None and attribute in element.attrib:
                return _positive_step(str(element.get(attribute)), attribute, path)
    return None


def _positive_step(text: str, attribute: str, path: str) -> float:
    """Return the step size [s] in an attribute."""
    try:
        step = float(text)
    except ValueError:
        step = 0.0
    if not (isfinite(step) and step > 0.0):
        raise SspError(
            f"{SSD_NAME} in {path}: {attribute} must be a positive number of seconds, but {text!r} "
            "was given."
        )
    return step
