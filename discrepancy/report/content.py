"""What the report shows, and a figure with its words."""

from collections.abc import Sequence
from dataclasses import dataclass

from matplotlib.figure import Figure

from discrepancy.files.document import Origin
from discrepancy.files.patch import PrimitiveInterval
from discrepancy.judgement.separability import Separability
from discrepancy.self_calibration import SelfCalibration
from discrepancy.workflow import Investigation
from fe.wing.design import WingDesign


@dataclass(frozen=True)
class ReportInput:
    """All that the report shows.

    Attributes
    ----------
    investigation : Investigation
        What came out.
    origin : Origin
        What it came from.
    separability : Separability or None
        What the campaign can decide.
    self_calibration : SelfCalibration or None
        Where it was asked for.
    design : WingDesign or None
        Of a wing, for the map.
    intervals : sequence of sequence of PrimitiveInterval
        Of the patch, by effect; empty without a patch.
    fmu : str
        Name of the patched FMU, or why there is none; empty if none is due.
    """

    investigation: Investigation
    origin: Origin
    separability: Separability | None = None
    self_calibration: SelfCalibration | None = None
    design: WingDesign | None = None
    intervals: Sequence[Sequence[PrimitiveInterval]] = ()
    fmu: str = ""


@dataclass(frozen=True)
class ReportFigure:
    """A figure with its words; `name` is that of its file."""

    name: str
    figure: Figure
    title: str
    caption: str
