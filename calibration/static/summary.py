"""The figures of calibration step 2 beside the paper's."""

from typing import NamedTuple

from .record import StaticCalibration
from .stiffness_curve import PUBLISHED_LINE

PAPER_MEAN = 1.0073
"""Posterior mean of e (Kapteyn et al. 2021, Table 1)."""

PAPER_STANDARD_DEVIATION = 0.0103
"""Posterior standard deviation of e (Kapteyn et al. 2021, Table 1)."""

_PAPER_STIFFNESS = float(PUBLISHED_LINE.stiffness(PAPER_MEAN)) * 1e-3
_PAPER_STIFFNESS_DEVIATION = PUBLISHED_LINE.gradient * PAPER_STANDARD_DEVIATION * 1e-3


class SummaryRow(NamedTuple):
    """One figure: what it is, ours, the paper's (None where it gives none), its unit."""

    name: str
    ours: float
    paper: float | None
    unit: str


def summary_rows(result: StaticCalibration) -> list[SummaryRow]:
    """Return the figures of a calibration beside the paper's; stiffness in N/mm, as printed there.

    The paper's figures belong to the published measurements; for other measurements they are still what
    the paper found on its wing. Its tip stiffness is eq. (14) at its mean and standard deviation of e.
    """
    particle, exact = result.particle, result.exact
    lower, upper = exact.interval(0.95)
    stiffness = result.tip_stiffness_particle
    return [
        SummaryRow("e, prior mean", result.prior.mean, 1.0, "1"),
        SummaryRow("e, prior standard deviation", result.prior.standard_deviation, 0.05 / 1.96, "1"),
        SummaryRow("e, particle filter, mean", particle.mean, PAPER_MEAN, "1"),
        SummaryRow(
            "e, particle filter, standard deviation",
            particle.standard_deviation,
            PAPER_STANDARD_DEVIATION,
            "1",
        ),
        SummaryRow("effective particles", float(particle.effective_sample_size[-1]), None, "1"),
        SummaryRow("e, exact, mean", exact.mean, PAPER_MEAN, "1"),
        SummaryRow("e, exact, standard deviation", exact.standard_deviation, PAPER_STANDARD_DEVIATION, "1"),
        SummaryRow("e, exact, 2.5 % quantile", lower, None, "1"),
        SummaryRow("e, exact, 97.5 % quantile", upper, None, "1"),
        SummaryRow("tip stiffness, particle filter, mean", stiffness.mean * 1e-3, _PAPER_STIFFNESS, "N/mm"),
        SummaryRow(
            "tip stiffness, particle filter, standard deviation",
            stiffness.standard_deviation * 1e-3,
            _PAPER_STIFFNESS_DEVIATION,
            "N/mm",
        ),
        SummaryRow(
            "tip stiffness, exact, mean", result.tip_stiffness_exact.mean * 1e-3, _PAPER_STIFFNESS, "N/mm"
        ),
        SummaryRow("χ²/dof", _reduced_chi_square(result), None, "1"),
        SummaryRow("uncertainty taken away", result.reward.uncertainty_reduction, None, "1"),
    ]


def _reduced_chi_square(result: StaticCalibration) -> float:
    return result.quality.chi_square / max(result.quality.degrees_of_freedom, 1)
