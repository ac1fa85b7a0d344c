"""Verdicts and models as a watch writes them to its journal, in JSON."""

from typing import NotRequired, TypedDict

from reporting.json_file import JsonObject


class VerdictRecord(TypedDict):
    """The verdict of a search for the cause of an alarm, in the line `verdict` of a journal.

    Attributes
    ----------
    step : int
        The step after which the verdict came.
    of_many : bool
        Whether many gauges raised the alarm together.
    from_step, to_step : int
        The first and the last step that were searched.
    tried : bool
        Whether the patch of the verdict is tested beside the model.
    kind : str
        The kind of the verdict, such as "named".
    folder : str
        The folder of the verdict, relative to that of the watch.
    notice : dict
        The notice of the verdict to the operator.
    """

    step: NotRequired[int]
    of_many: NotRequired[bool]
    from_step: int
    to_step: int
    tried: bool
    kind: str
    folder: str
    notice: JsonObject


class ModelRecord(TypedDict):
    """A patched model that was adopted, in the line `model` of a journal.

    Attributes
    ----------
    patch : str
        The file of the patch, relative to the folder of the watch.
    from_step : int
        The first step that is filtered with the patched model.
    alarms : list of dict
        The alarms that the patched model raises in the steps that were filtered again.
    before, after : dict
        The residual and the log evidence without and with the patch.
    policy_change : str
        How the policy changes, in a sentence; empty if it does not.
    notice : dict, optional
        The notice to the operator at the end of the trial.
    verdict : str, optional
        The folder of the verdict, relative to that of the watch, if a user gave the patch.
    """

    patch: str
    from_step: int
    alarms: list[JsonObject]
    before: JsonObject
    after: JsonObject
    policy_change: str
    notice: NotRequired[JsonObject]
    verdict: NotRequired[str]
