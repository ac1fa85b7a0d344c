"""Exceptions of scenarios, missions and run folders, one for each cause."""

from twin_master.errors import TwinMasterError


class ScenarioError(TwinMasterError, ValueError):
    """A scenario file cannot be read or does not keep to the schema."""


class UnknownScenarioError(ScenarioError):
    """No shipped scenario and no file has the name that was asked for."""


class MissionError(TwinMasterError, RuntimeError):
    """A mission cannot be flown on."""


class MissingObservationModelError(MissionError):
    """The twin cannot be given predicted observations for the scenario's asset."""


class ObservationInvalidError(MissionError):
    """The asset returned something that is no observation."""


class RunFolderError(TwinMasterError, RuntimeError):
    """A run folder cannot be used as asked."""


class RunFolderExistsError(RunFolderError):
    """The folder that a run was to be written to exists already."""


class NotResumableError(RunFolderError):
    """A run cannot be continued from the folder."""


class MissionInputError(MissionError, ValueError):
    """Something that a mission was told to use is not there or does not fit."""
