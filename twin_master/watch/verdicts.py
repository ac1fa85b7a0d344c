"""Verdicts of searches for the cause of an alarm: which patch is tested, and which adopted."""

from pathlib import Path

from fe.runtime.patch import SensorSaturation
from reporting.errors import DamagedFileError
from reporting.json_file import JsonRecord, read_json
from twin_master.network.estimator import Notice
from twin_master.run_folder import PATCH, TEACHING, VERDICT
from twin_master.watch.patch_trial import PatchOutcome
from twin_master.watch.records import VerdictRecord

TRIAL_STEPS = 10
"""Steps after a verdict, not used by its search, in which model and patched model are compared."""
LEAST_GAIN = 3.0
"""Least log evidence [nats] that a patch must gain in these steps to be adopted.

The search asks for as much before it names a cause.
"""
GROUP = "group"
TRIED = ("named", "named in part", GROUP)
"""The kinds of verdict whose patch is tried.

The patch of a group is that of its most probable member. All members explain the misfit alike, so
that the state is estimated alike whichever is true, and the steps of the trial must confirm it. A
group of which only some members saturate is not tried: its members agree at the loads of the search
and at no other.
"""
ABSOLUTE_FIT = "absolute fit"
"""The gate of a verdict that says whether only noise is left unexplained by the named cause."""

VerdictJson = JsonRecord
"""The object `verdict` of `verdict.json`; `docs/reference/verdict.md` lists its keys."""


def read_verdict(
    folder: Path, log: Path, first_step: int, last_step: int, step_name: str
) -> VerdictRecord:
    """Return the record of a verdict for the journal, with the notice to the operator.

    The record says that the patch is tried if the verdict names a cause, has a patch, and gives no
    reason against its trial (`caveats_of`).

    Parameters
    ----------
    folder : Path
        The folder of the verdict, in that of the watch. If there is no verdict in it, the kind of
        the verdict is "none", and the notice says why.
    log : Path
        The messages of the search, whose last line is the reason if there is no verdict.
    first_step, last_step : int
        The first and the last step that were searched.
    step_name : str
        The word for a step.
    """
    try:
        verdict = read_json(folder / VERDICT, DamagedFileError)["verdict"]
        kind = str(verdict["kind"])
        result = f": {kind}. {verdict['sentence']}"
        caveats = caveats_of(verdict)
    except (DamagedFileError, KeyError, TypeError) as error:
        kind = "none"
        result = f", and the search ended without a verdict: {_last_line(log) or error}"
        caveats = []
    has_patch = (folder / PATCH).is_file()
    is_tried = kind in TRIED and has_patch and not caveats
    relative_folder = f"{TEACHING}/{folder.name}"
    sentence = (
        f"{step_name.capitalize()}s {first_step} to {last_step} were searched for the cause{result}"
    )
    if kind in TRIED:
        new_caveats = [caveat for caveat in caveats if caveat not in sentence]
        sentence = " ".join([sentence, *new_caveats])
    if is_tried:
        patch = "patch of the most probable of these" if kind == GROUP else "patch"
        sentence += f" The {patch} is tried beside the model for {TRIAL_STEPS} {step_name}s."
    elif has_patch:
        command = command_to_believe(relative_folder, first_step)
        sentence += f" To believe it none the less: {command}"
    return {
        "from_step": first_step,
        "to_step": last_step,
        "tried": is_tried,
        "kind": kind,
        "folder": relative_folder,
        "notice": Notice("verdict", sentence).as_record(),
    }


def _last_line(log: Path) -> str:
    """Return the last line of a file that is not blank; empty if there is none."""
    lines = log.read_text(encoding="utf-8", errors="replace").split("\n")
    nonblank_lines = [line.strip() for line in lines if line.strip()]
    return nonblank_lines[-1] if nonblank_lines else ""


def caveats_of(verdict: VerdictJson) -> list[str]:
    """Return why the patch of a verdict must not be tried.

    Parameters
    ----------
    verdict : dict
        The object `verdict` of `verdict.json`.

    Returns
    -------
    list of str
        The reasons of the gates that failed; a sentence if the absolute fit was not tested; and a
        sentence if only some members of a group are sensors that saturate. Empty if the patch may
        be tried.
    """
    gates = verdict["gates"]
    caveats = [str(gate["reason"]) for gate in gates if gate["passed"] is False]
    # A gate that was not tested has null as `passed`.
    if not any(gate["name"] == ABSOLUTE_FIT and gate["passed"] is not None for gate in gates):
        caveats.append("It was not tested whether the residuals are noise.")
    if verdict["kind"] == GROUP and has_some_saturating_members(verdict):
        caveats.append(
            "A sensor that saturates and the other effects of the group differ at other loads, and "
            "these steps do not tell them apart; more steps at more than one load may."
        )
    return caveats


def has_some_saturating_members(verdict: VerdictJson) -> bool:
    """Return whether some effects of a group are sensors that saturate, and others are not."""
    is_saturating = []
    for effect in verdict["effects"]:
        kinds = {primitive["kind"] for primitive in effect["patch"]}
        is_saturating.append(SensorSaturation.kind in kinds)
    return any(is_saturating) and not all(is_saturating)


def command_to_believe(folder: str, first_step: int) -> str:
    """Return the command with which a user makes the watch believe a patch.

    Parameters
    ----------
    folder : str
        The folder of the verdict, relative to that of the watch.
    first_step : int
        The first step that is filtered with the patched model.
    """
    return (
        f"uav-twin watch --resume --out DIR --model-patch DIR/{folder}/{PATCH} "
        f"--from-step {first_step}"
    )


def is_adopted(verdict: VerdictRecord, outcome: PatchOutcome) -> bool:
    """Return whether a patch is adopted after its trial.

    It is adopted if it gained at least `LEAST_GAIN` of log evidence, unless many gauges raised the
    alarm. In that case the search names the closest effect of its catalogue, and any effect that
    moves all gauges gains evidence over a model that explains none of them.
    """
    has_gained = outcome.gained_evidence >= LEAST_GAIN
    return has_gained and not verdict.get("of_many", False)


def trial_sentence(verdict: VerdictRecord, outcome: PatchOutcome, step_name: str) -> str:
    """Return the message to the operator at the end of the trial of a patch.

    It says how much evidence the patch gained, and whether it is adopted. If the alarm of many
    gauges keeps it from being adopted, the message has the command to adopt it by hand.
    """
    first_step = verdict["from_step"]
    comparison = (
        f"Beside the model for {TRIAL_STEPS} {step_name}s the patch gained "
        f"{outcome.gained_evidence:.3g} nats of evidence"
    )
    if outcome.gained_evidence < LEAST_GAIN:
        return f"{comparison}, but {LEAST_GAIN:g} are needed: it is not adopted."
    if not is_adopted(verdict, outcome):
        command = command_to_believe(verdict["folder"], first_step)
        return (
            f"{comparison}, and is not adopted from its name alone, because many gauges raised the "
            "alarm: any effect that moves all of them explains more than the model does. Look at "
            f"the asset first. To believe it: {command}"
        )
    sentence = (
        f"{comparison}: it is believed from {step_name} {first_step} on, and these {step_name}s "
        "were filtered again."
    )
    if verdict["kind"] == GROUP:
        sentence += " It is one of a group, and these data cannot tell which of them is true."
    return f"{sentence} {outcome.record['policy_change']}".rstrip()
