"""The search for what a model lacks in a record of 25,000 samples, beside one of 3,000 samples."""

import resource
import time

from benchmarks.measurement import Measurement
from benchmarks.pushed_axis import axis_model, pushed_axis
from discrepancy.catalogue.library import library
from discrepancy.verdict import VerdictKind
from discrepancy.workflow import Investigation, investigate

SAMPLES, SHORT_SAMPLES = 25_000, 3_000
"""Numbers of samples of the two trials of an axis together."""


def run() -> list[Measurement]:
    """Measure processor time and memory of a whole search, after compilation."""
    investigation_of(600)  # compiles
    short_seconds, _ = timed_investigation(SHORT_SAMPLES)
    long_seconds, investigation = timed_investigation(SAMPLES)
    verdict = investigation.verdict
    assert verdict.kind in (VerdictKind.NAMED, VerdictKind.NAMED_IN_PART)
    assert [effect.identifier for effect in verdict.effects] == ["coulomb_friction"]
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    return [
        Measurement(
            "all effects in 25,000 samples, processor",
            long_seconds,
            "s",
            60.0,
            "3,000 samples",
            short_seconds,
        ),
        Measurement("largest memory of the process", memory, "MiB", 700.0),
    ]


def investigation_of(samples: int) -> Investigation:
    """Return the investigation of an axis whose two trials have so many samples together."""
    return investigate(pushed_axis(samples // 2), axis_model(), library(), thorough=False)


def timed_investigation(samples: int) -> tuple[float, Investigation]:
    """Return the processor seconds of an investigation, and the investigation."""
    campaign = pushed_axis(samples // 2)
    begin = time.process_time()
    investigation = investigate(campaign, axis_model(), library(), thorough=False)
    return time.process_time() - begin, investigation
