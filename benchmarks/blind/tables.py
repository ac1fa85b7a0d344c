"""The score as a page of markdown tables."""

from collections import Counter
from collections.abc import Iterable, Sequence

import numpy as np

from benchmarks.blind.scoring import Outcome, Scored, wilson

TITLES = {
    "catalogue": "One effect of the catalogue",
    "null": "Nothing hidden",
    "outside": "One effect, left out of the catalogue",
    "pair": "Two effects",
    "trap": "Traps",
}


def _row(cells: Iterable[object]) -> str:
    return "| " + " | ".join(str(cell) for cell in cells) + " |"


def _table(header: Sequence[str], rows: Iterable[Sequence[object]]) -> list[str]:
    return [_row(header), _row("---" for _ in header), *(_row(row) for row in rows), ""]


def _share(hits: int, count: int) -> str:
    low, high = wilson(hits, count)
    return f"{100 * hits / count:.1f} % ({100 * low:.1f} to {100 * high:.1f})" if count else ""


def _shown(case: Scored) -> str:
    """Return what the verdict says, in a word or two."""
    kind = str(case.verdict["kind"])
    if kind == "named":
        return " + ".join(sorted(case.verdict.get("identifiers") or ()))
    return kind


def _outcomes(cases: Sequence[Scored], label: str, key: str) -> list[str]:
    groups: dict[str, list[Scored]] = {}
    for case in cases:
        name = (
            case.truth.get(key)
            if key == "trap"
            else " + ".join(case.truth["identifiers"]) or "nothing"
        )
        groups.setdefault(str(name), []).append(case)
    rows = [
        [name, len(group), *(sum(c.outcome is o for c in group) for o in Outcome)]
        for name, group in sorted(groups.items())
    ]
    return _table([label, "cases", *(o.value for o in Outcome)], rows)


def _median(values: Iterable[float | None]) -> str:
    finite = [value for value in values if value is not None and np.isfinite(value)]
    if not finite:
        return ""
    low, middle, high = np.quantile(finite, [0.05, 0.5, 0.95])
    return f"{middle:.3g} ({low:.3g} to {high:.3g})"


def report(cases: Sequence[Scored], missing: int = 0) -> str:
    """Return the score page: outcomes by kind and effect, confusion, coverage and proof."""
    lines = ["# Score of the blind test", ""]
    if missing:
        lines += [f"{missing} campaigns have no verdict and are not counted.", ""]
    rows = []
    for kind in TITLES:
        for rig in ("wing", "lumped"):
            group = [c for c in cases if c.truth["kind"] == kind and c.truth["rig"] == rig]
            if group:
                counts = Counter(c.outcome for c in group)
                rows.append(
                    [
                        TITLES[kind],
                        rig,
                        len(group),
                        *(_share(counts[o], len(group)) for o in Outcome),
                    ]
                )
    lines += ["## Shares, with 95 % intervals", ""]
    lines += _table(["cases", "rig", "number", *(o.value for o in Outcome)], rows)
    lines += [
        "right: exactly what is hidden (a trap: also an accepted verdict); "
        "group: a group or family that holds it; "
        "open: unexplained, below detectability or data error; "
        "missed: 'nothing missing'; part: one of two; wrong: anything else.",
        "",
    ]
    for kind, title in TITLES.items():
        group = [c for c in cases if c.truth["kind"] == kind]
        if group and kind != "null":
            label = "trap" if kind == "trap" else "hidden"
            lines += [f"## {title}", "", *_outcomes(group, label, label)]
    lines += ["## Said where it is not right", ""]
    confused = Counter(
        (
            c.truth.get("trap") or " + ".join(c.truth["identifiers"]) or "nothing",
            c.truth["kind"],
            _shown(c),
        )
        for c in cases
        if c.outcome is not Outcome.RIGHT
    )
    lines += _table(
        ["hidden", "kind", "said", "cases"], [[*key, n] for key, n in confused.most_common()]
    )
    lines += _coverage(cases)
    lines += _proof(cases)
    return "\n".join(lines)


def _coverage(cases: Sequence[Scored]) -> list[str]:
    hits: Counter[str] = Counter()
    counts: Counter[str] = Counter()
    elsewhere = 0
    for case in cases:
        for name, covered in case.covered.items():
            if covered is None:
                elsewhere += 1
                continue
            counts[name] += 1
            hits[name] += covered
    rows = [[name, counts[name], _share(hits[name], counts[name])] for name in sorted(counts)]
    total = sum(counts.values())
    if total:
        rows.append(["all", total, _share(sum(hits.values()), total)])
    lines = ["## 90 % intervals of rightly named effects that hold the truth", ""]
    lines += _table(["parameter", "cases", "share"], rows)
    if elsewhere:
        lines += [f"{elsewhere} intervals cannot be compared: no truth is known at that place.", ""]
    return lines


def _proof(cases: Sequence[Scored]) -> list[str]:
    rows = []
    for kind, title in TITLES.items():
        group = [c for c in cases if c.truth["kind"] == kind]
        named = [c for c in group if c.outcome is Outcome.RIGHT and c.verdict["kind"] == "named"]
        seconds = _median(c.verdict.get("seconds") for c in group)
        if group:
            rows.append(
                [
                    title,
                    len(named),
                    _median(c.verdict.get("held_out_chi_square_per_sample_after") for c in named),
                    _median(c.verdict.get("share_closed") for c in named),
                    seconds,
                ]
            )
    lines = ["## Proof on held-out trials where the name is right: median (5 to 95 %)", ""]
    header = [
        "cases",
        "named right",
        "χ² per sample after",
        "share of the error closed",
        "seconds a case",
    ]
    return lines + _table(header, rows)
