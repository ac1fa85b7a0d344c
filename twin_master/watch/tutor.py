"""The tutor of a watch: between two steps it searches for a cause, and tests and adopts patches."""

import time
from concurrent.futures import Future, ThreadPoolExecutor

from twin_master.network.estimator import Notice
from twin_master.run_folder import PATCH, TEACHING, VERDICT
from twin_master.watch.cause_search import CauseSearch, RunningSearch, SearchRequest
from twin_master.watch.folder import Watch
from twin_master.watch.patch_trial import PATCH_ERRORS, ComparedSteps, PatchOutcome
from twin_master.watch.records import VerdictRecord
from twin_master.watch.verdicts import TRIAL_STEPS, is_adopted, read_verdict, trial_sentence

POLL_SECONDS = 0.05
"""Seconds between two looks at a search whose verdict is waited for."""


class Tutor:
    """Searches for causes, tests patches and adopts them between two steps of a watch.

    Parameters
    ----------
    cause_search : CauseSearch
        Starts the searches.
    wait : bool
        Whether the next step waits for the verdict and for the patched model, as in a recording. A
        live watch continues beside the search and beside a thread that builds the model.

    Attributes
    ----------
    outcome : Future of PatchOutcome, or None
        The outcome of the patch that is tried, once its computation has begun.
    """

    def __init__(self, watch: Watch, cause_search: CauseSearch, *, wait: bool) -> None:
        self._watch = watch
        self._cause_search = cause_search
        self._wait = wait
        self._running_search: RunningSearch | None = None
        self.outcome: Future[PatchOutcome] | None = None

    def teach(self) -> None:
        """Search for a cause, or decide on a patch, if that is due after the last step.

        The journal of the watch must be open.
        """
        teaching = self._watch.teaching
        if teaching.steps_to_search is not None:
            first_step, last_step = teaching.steps_to_search
            self._search(first_step, last_step)
        verdict = teaching.verdict_on_trial
        if verdict is not None and teaching.step >= verdict["step"] + TRIAL_STEPS:
            self._judge(verdict)

    def _search(self, first_step: int, last_step: int) -> None:
        """Start or continue the search for the cause of an alarm in some steps.

        Once the search has ended, its verdict is written into the journal.
        """
        watch = self._watch
        folder = watch.folder / TEACHING / f"steps_{first_step}_to_{last_step}"
        request = SearchRequest(
            run_folder=watch.folder,
            first_step=first_step,
            last_step=last_step,
            verdict_folder=folder,
            log=folder.with_name(folder.name + ".log"),
            seed=watch.scenario.mission.seed,
            low_priority=not self._wait,
        )
        if not self._search_has_ended(request):
            return
        step_name = watch.scenario.mission.step_name
        verdict = read_verdict(folder, request.log, first_step, last_step, step_name)
        verdict["step"] = watch.teaching.step
        verdict["of_many"] = watch.teaching.is_alarm_of_many
        watch.write_event(verdict=verdict)

    def _search_has_ended(self, request: SearchRequest) -> bool:
        """Return whether a search has ended; start it if it was not started yet.

        If the steps of the watch wait for the verdict, this waits until the search has ended, or
        until the end of the watch is requested.
        """
        request.log.parent.mkdir(exist_ok=True)
        while not (request.verdict_folder / VERDICT).is_file():
            if self._running_search is None:
                self._running_search = self._cause_search.start(request)
            elif self._running_search.has_ended():
                break
            if not self._wait or self._watch.intake.end_is_requested:
                return False
            time.sleep(POLL_SECONDS)
        self.close()
        return True

    def _judge(self, verdict: VerdictRecord) -> None:
        """Adopt the patch of a verdict at the end of its trial, or record why not.

        The outcome of the trial is computed in a thread, which the first call starts. If the watch
        does not wait for it, a later call finds it.
        """
        if self.outcome is None:
            patch = self._watch.folder / verdict["folder"] / PATCH
            compared = ComparedSteps(first=verdict["step"] + 1, count=TRIAL_STEPS)
            worker = ThreadPoolExecutor(1)
            self.outcome = worker.submit(
                self._watch.trial_of(patch, verdict["from_step"], compared)
            )
            worker.shutdown(wait=self._wait)
        if not self.outcome.done():
            return
        computed_outcome = self.outcome
        self.outcome = None
        try:
            outcome = computed_outcome.result()
        except PATCH_ERRORS as error:
            self._reject(verdict, f"The patch cannot be believed by this twin: {error}")
            return
        sentence = trial_sentence(verdict, outcome, self._watch.scenario.mission.step_name)
        if is_adopted(verdict, outcome):
            self._watch.adopt(outcome, Notice("trial", sentence).as_record())
        else:
            self._reject(verdict, sentence)

    def _reject(self, verdict: VerdictRecord, sentence: str) -> None:
        """Record in the journal that the patch of a verdict is not adopted, and why."""
        rejected: VerdictRecord = {
            **verdict,
            "tried": False,
            "notice": Notice("trial", sentence).as_record(),
        }
        self._watch.write_event(verdict=rejected)

    def close(self) -> None:
        """Stop the search, if one is running; a resumed watch starts it again."""
        if self._running_search is not None:
            self._running_search.stop()
        self._running_search = None
