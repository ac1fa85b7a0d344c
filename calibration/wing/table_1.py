"""Table 1 of the paper with our figures beside it: prior and posterior of the whole digital state."""

import io
from dataclasses import dataclass
from pathlib import Path

from calibration.static.summary import PAPER_MEAN, PAPER_STANDARD_DEVIATION
from reporting.files import atomic_write_text

from .three_steps import WingCalibration

PRINTED = "Kapteyn et al. 2021, Table 1"
SAMPLES = "the authors' published samples (step 3), mean over 100"
EQ_25 = "the authors' published frequencies (step 3) by eq. (25), mean over 100"


@dataclass(frozen=True)
class PaperFigure:
    """Posterior of a figure in the paper: mean and, where it is given, standard deviation, and the source."""

    mean: float
    standard_deviation: float | None
    source: str


PAPER = {
    "semi_span": PaperFigure(1.8280, None, PRINTED),
    "root_chord": PaperFigure(0.4330, None, PRINTED),
    "tip_chord": PaperFigure(0.2600, None, PRINTED),
    "young_modulus_factor": PaperFigure(PAPER_MEAN, PAPER_STANDARD_DEVIATION, PRINTED),
    "servo_mass": PaperFigure(0.1691, 0.0039, SAMPLES),
    "pitot_mass": PaperFigure(0.1337, 0.0077, SAMPLES),
    "damping_alpha": PaperFigure(1.0300, 0.0008, EQ_25),
    "damping_beta": PaperFigure(7.658e-4, 0.006e-4, EQ_25),
}
"""What the authors found on their wing, SI."""


@dataclass(frozen=True)
class Shown:
    """How a figure is printed: its title, the factor from SI, the unit and the digits behind the point."""

    title: str
    scale: float
    unit: str
    digits: int


SHOWN = {
    "semi_span": Shown("semi-span", 1e3, "mm", 2),
    "root_chord": Shown("root chord", 1e3, "mm", 2),
    "tip_chord": Shown("tip chord", 1e3, "mm", 2),
    "young_modulus_factor": Shown("modulus factor e", 1.0, "", 4),
    "servo_mass": Shown("servo mass", 1e3, "g", 1),
    "pitot_mass": Shown("pitot mass", 1e3, "g", 1),
    "damping_alpha": Shown("alpha", 1.0, "1/s", 4),
    "damping_beta": Shown("beta", 1e3, "ms", 4),
    "tip_stiffness": Shown("tip stiffness", 1e-3, "N/mm", 4),
    "frequency_1": Shown("f1", 1.0, "Hz", 3),
    "frequency_2": Shown("f2", 1.0, "Hz", 2),
    "damping_ratio_1": Shown("damping ratio 1", 100.0, "%", 2),
    "damping_ratio_2": Shown("damping ratio 2", 100.0, "%", 2),
}
"""How the figures of a calibration are printed."""


@dataclass(frozen=True)
class TableRow:
    """One figure of Table 1, SI.

    Attributes
    ----------
    name : str
        Figure.
    prior, found : (float, float)
        Mean and standard deviation before, and in the samples that are kept.
    paper_way : (float, float)
        The same by the paper's own procedure: the particle filter on its stiffness line for e, its eqs.
        (19), (20) and (25) on our model for masses and damping.
    paper : PaperFigure
        What the authors found.
    """

    name: str
    prior: tuple[float, float]
    found: tuple[float, float]
    paper_way: tuple[float, float]
    paper: PaperFigure

    @property
    def difference(self) -> float:
        """The mean of the kept samples less the paper's."""
        return self.found[0] - self.paper.mean

    @property
    def paper_way_difference(self) -> float:
        """The mean by the paper's own procedure less the paper's."""
        return self.paper_way[0] - self.paper.mean


def table_1(calibration: WingCalibration) -> tuple[TableRow, ...]:
    """Return the rows of Table 1."""
    result = calibration.result
    rows = [
        TableRow(
            length.name,
            (length.prior.mean, length.prior.standard_deviation),
            posterior := (length.posterior.mean, length.posterior.standard_deviation),
            posterior,
            PAPER[length.name],
        )
        for length in result.geometry.lengths
    ]
    prior = {update.name: update for update in result.step(3).state}
    by_the_paper = next(step for step in result.steps if step.procedure.startswith("the paper's"))
    means = {
        update.name: (update.posterior_mean, update.posterior_standard_deviation)
        for update in by_the_paper.state
    }
    particle = calibration.static_published.particle
    means["young_modulus_factor"] = (particle.mean, particle.standard_deviation)
    for name, update in prior.items():
        before = (update.prior_mean, update.prior_standard_deviation)
        if name == "young_modulus_factor":
            before = (calibration.static.prior.mean, calibration.static.prior.standard_deviation)
        rows.append(
            TableRow(
                name,
                before,
                (update.posterior_mean, update.posterior_standard_deviation),
                means[name],
                PAPER[name],
            )
        )
    return tuple(rows)


def printed(name: str, mean: float, deviation: float | None = None) -> str:
    """Return a figure as printed, without its unit."""
    shown = SHOWN[name]
    text = f"{mean * shown.scale:.{shown.digits}f}"
    if deviation is not None:
        text += f"\u00a0±\u00a0{deviation * shown.scale:.{shown.digits}f}"
    return text.replace("-", "−")


def signed(name: str, difference: float) -> str:
    """Return a difference as printed, with its sign."""
    shown = SHOWN[name]
    return signed_number(difference * shown.scale, shown.digits)


def signed_number(value: float, digits: int) -> str:
    """Return a number with its sign, or zero without one."""
    text = f"{value:+.{digits}f}"
    return text.replace("-", "−") if text.strip("+-0.") else f"{0.0:.{digits}f}"


def write_table_1(rows: tuple[TableRow, ...], path: Path) -> Path:
    """Write the table as CSV, in SI.

    Raises
    ------
    reporting.errors.FileNotWrittenError
        If the file cannot be written.
    """
    text = io.StringIO()
    text.write(
        "figure,prior_mean,prior_standard_deviation,mean,standard_deviation,"
        "paper_procedure_mean,paper_procedure_standard_deviation,paper_mean,paper_standard_deviation,"
        "difference,paper_procedure_difference,source_of_the_papers\n"
    )
    for row in rows:
        deviation = "" if row.paper.standard_deviation is None else f"{row.paper.standard_deviation:.10g}"
        figures = [*row.prior, *row.found, *row.paper_way, row.paper.mean]
        text.write(
            f"{row.name},{','.join(f'{value:.10g}' for value in figures)},{deviation},{row.difference:.10g},"
            f"{row.paper_way_difference:.10g},"
            f'"{row.paper.source}"\n'
        )
    return atomic_write_text(path, text.getvalue())
