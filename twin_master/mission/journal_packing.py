"""The short form of records in the lines of a journal, and their full form for readers.

A year of steps at 1 Hz is 32 million lines. So readings are written as doubles in base 64, which
are half as long as decimals and are read back to the same bits; beliefs leave out impossible
states; and the position in the stream leaves out usual values. Lines of earlier versions have the
full form already, and are read unchanged.
"""

import base64
import binascii
import math
import re
from collections.abc import Callable, Iterable, Mapping
from itertools import groupby

import numpy as np

from reporting.arrays import Float
from reporting.json_file import JsonObject
from twin_master.network.estimator import MOMENTS

PROBABILITY_DECIMALS = 10
"""Number of decimals of probabilities in a journal."""
_BINARY = "<f8"
"""The numbers in base 64: double precision, little-endian."""
_CHARACTERS_OF_A_DOUBLE = 32 / 3
"""Number of characters of a double in base 64, which has 6 bits a character."""
_STATE_COUNT = "of"
"""The key of a belief with the number of states, beside the keys of the states."""
_NONE_OF_THESE = "none of these"
_COUNTS = ("received", "missing", "late", "duplicates", "rejected")
_RUN_OF_STATUSES = re.compile(r"(\d)\*(\d+)")


def rounded(value: float) -> float | None:
    """Return a number rounded to ten significant digits, as journals have it; null if infinite."""
    return float(f"{value:.10g}") if math.isfinite(value) else None


def rounded_probabilities(probabilities: Iterable[float]) -> list[float]:
    """Return probabilities rounded to `PROBABILITY_DECIMALS`, as journals have them."""
    return [round(value, PROBABILITY_DECIMALS) for value in probabilities]


def array_from_json(values: Iterable[float | None]) -> Float:
    """Return the numbers of a JSON list as an array, with NaN for null."""
    return np.array([math.nan if value is None else value for value in values], dtype=np.float64)


def json_from_array(values: Float) -> list[float | None]:
    """Return the numbers of an array as a JSON list, with null for NaN and infinities."""
    return [value if math.isfinite(value) else None for value in values.tolist()]


def pack_numbers(values: Iterable[float | None]) -> str:
    """Return numbers as the bits of doubles in base 64, with NaN for null."""
    bits = array_from_json(values).astype(_BINARY).tobytes()
    return base64.b64encode(bits).decode("ascii")


def unpack_numbers(text: str) -> list[float | None]:
    """Return the numbers that `pack_numbers` wrote, with None for NaN.

    Raises
    ------
    ValueError
        If the text is something else.
    """
    return json_from_array(np.frombuffer(base64.b64decode(text, validate=True), _BINARY))


def _pack_belief(belief: list[float]) -> object:
    """Return the possible states by index; or all states in base 64, if that is shorter."""
    possible_states: dict[str, float] = {}
    length = 0
    for index, probability in enumerate(belief):
        if probability != 0.0:
            possible_states[str(index)] = probability
            length += len(f'"{index}":{probability},')
    if length > _CHARACTERS_OF_A_DOUBLE * len(belief):
        return pack_numbers(belief)
    return {_STATE_COUNT: len(belief), **possible_states}


def _unpack_belief(packed: Mapping[str, float] | str) -> list[float | None]:
    """Return each state's probability from a belief that `_pack_belief` packed."""
    if isinstance(packed, str):
        return unpack_numbers(packed)
    belief: list[float | None] = [0.0] * int(packed[_STATE_COUNT])
    for name, probability in packed.items():
        if name != _STATE_COUNT:
            belief[int(name)] = probability
    return belief


def _pack_learnt(learnt: Mapping[str, Mapping[str, object]]) -> JsonObject:
    """Return names, units and all numbers of the learnt quantities."""
    numbers = []
    for quantity in learnt.values():
        for name in MOMENTS:
            numbers.append(quantity[name])
    return {
        "names": list(learnt),
        "units": [quantity["unit"] for quantity in learnt.values()],
        "figures": pack_numbers(numbers),  # type: ignore[arg-type]
    }


def _unpack_learnt(packed: JsonObject) -> JsonObject:
    """Return the learnt quantities by name, as `_pack_learnt` packed them."""
    moments_of_quantities = (
        np.array(unpack_numbers(packed["figures"]), dtype=object).reshape(-1, len(MOMENTS)).tolist()
    )
    learnt = {}
    for name, unit, moments in zip(
        packed["names"], packed["units"], moments_of_quantities, strict=True
    ):
        learnt[name] = {**dict(zip(MOMENTS, moments, strict=True)), "unit": unit}
    return learnt


def _pack_suspicion(suspicion: JsonObject) -> JsonObject:
    """Return a suspicion without `none_of_these` if the same number is among its hypotheses."""
    if suspicion.get("hypotheses", {}).get(_NONE_OF_THESE) != suspicion.get("none_of_these"):
        return suspicion
    return {name: value for name, value in suspicion.items() if name != "none_of_these"}


def _unpack_suspicion(packed: JsonObject) -> JsonObject:
    """Return a suspicion with `none_of_these`."""
    if "none_of_these" in packed:
        return packed
    return {**packed, "none_of_these": packed["hypotheses"][_NONE_OF_THESE]}


def _pack_intake(intake: JsonObject) -> JsonObject:
    """Return the position in the stream of messages without values that are zero or unknown.

    The statuses of the last steps are written as runs, such as `2*50` for fifty times 2.
    """
    packed = {name: value for name, value in intake.items() if value is not None}
    packed["counts"] = {name: count for name, count in intake["counts"].items() if count}
    runs = [f"{digit}*{len(list(run))}" for digit, run in groupby(intake["given"])]
    packed["given"] = " ".join(runs)
    return packed


def _unpack_intake(packed: JsonObject) -> JsonObject:
    """Return the position in the message stream, as `_pack_intake` packed it."""
    if packed["given"] and "*" not in packed["given"]:
        return packed  # of an earlier version
    statuses = [digit * int(count) for digit, count in _RUN_OF_STATUSES.findall(packed["given"])]
    return {
        **{"clock": None, "counter": None, "source": None},
        **packed,
        "counts": dict.fromkeys(_COUNTS, 0) | packed["counts"],
        "given": "".join(statuses),
    }


_PACK: dict[str, Callable[..., object]] = {
    "observed": pack_numbers,
    "observation": pack_numbers,
    "filtered": _pack_belief,
    "learnt": _pack_learnt,
    "suspicion": _pack_suspicion,
    "intake": _pack_intake,
}
"""How the entries of a record are packed, by their keys."""


def packed_record(record: Mapping[str, object]) -> JsonObject:
    """Return the short form of a record, for a line of the journal.

    The step of an observation is left out if it is that of the line. A table `standing` with the
    key `begin` alone is replaced by that key.
    """
    packed: JsonObject = dict(record)
    for name, pack in _PACK.items():
        if name in packed:
            packed[name] = pack(packed[name])
    standing = packed.get("standing")
    if isinstance(standing, dict) and standing.keys() == {"begin"}:
        del packed["standing"]
        packed["begin"] = standing["begin"]
    if "observation_step" in packed and packed["observation_step"] == packed.get("step"):
        del packed["observation_step"]
    return packed


def full_record(packed: JsonObject) -> JsonObject:
    """Return the full form of a record from its short form in a line.

    An entry of another layout is returned as it is, to be refused where it is used.
    """
    record = dict(packed)
    for name, unpack, packed_type in (
        ("observed", unpack_numbers, str),
        ("observation", unpack_numbers, str),
        ("filtered", _unpack_belief, (str, dict)),
        ("suspicion", _unpack_suspicion, dict),
        ("intake", _unpack_intake, dict),
    ):
        if isinstance(record.get(name), packed_type):
            try:
                record[name] = unpack(record[name])
            except (KeyError, TypeError, ValueError, IndexError, binascii.Error):
                continue
    learnt = record.get("learnt")
    if isinstance(learnt, dict) and isinstance(learnt.get("figures"), str):
        record["learnt"] = _unpack_learnt(learnt)
    if "begin" in record:
        record["standing"] = {"begin": record.pop("begin")}
    if "intake" in record and "observed" in record:
        record.setdefault("observation_step", record.get("step"))
    return record
