"""Errors of the discrepancy workflow, named by cause, and its tables of sentences."""

from reporting.errors import StandsForOthersError
from reporting.sentences import Sentences

SENTENCES = Sentences(__file__)
"""Proposals of experiments and rules of a verdict, by table."""


class DiscrepancyError(StandsForOthersError):
    """Any error that the discrepancy workflow raises on purpose."""


class CampaignFileError(DiscrepancyError, ValueError):
    """A campaign cannot be read: something is missing or is not of its kind."""


class CampaignDataError(DiscrepancyError, ValueError):
    """Measured data are not fit for use: gaps, a clipped channel, a unit slip, swapped channels."""


class ModelError(DiscrepancyError, ValueError):
    """The model lacks an input, an output or a parameter that the campaign needs."""


class CatalogueError(DiscrepancyError, ValueError):
    """An effect of the catalogue, or a user's own entry, cannot be built."""


class FitError(DiscrepancyError, RuntimeError):
    """A fit did not reach what was asked for."""


class VerdictFileError(DiscrepancyError, ValueError):
    """A stored verdict or patch is damaged, incomplete or of another format."""
