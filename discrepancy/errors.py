"""Errors of the discrepancy workflow, named by cause, and the sentences that it says."""

from reporting.errors import StandsForOthersError
from reporting.sentences import Sentences

SENTENCES = Sentences(__file__)
said = SENTENCES.said
"""A sentence by "table.name" with its values."""


class DiscrepancyError(StandsForOthersError):
    """Any error that the discrepancy workflow raises on purpose."""


class CampaignFileError(DiscrepancyError, ValueError):
    """A campaign cannot be read: a missing file, key or column, or something that is not of its kind."""


class CampaignDataError(DiscrepancyError, ValueError):
    """Measured data are not fit for use: gaps, NaN, a clipped channel, a unit slip, swapped channels."""


class ModelError(DiscrepancyError, ValueError):
    """The model lacks an input, an output or a parameter that the campaign needs."""


class CatalogueError(DiscrepancyError, ValueError):
    """An effect of the catalogue, or a user's own entry, cannot be built."""


class FitError(DiscrepancyError, RuntimeError):
    """A fit did not reach what was asked for."""


class VerdictFileError(DiscrepancyError, ValueError):
    """A stored verdict or patch is damaged, incomplete or of another format."""
