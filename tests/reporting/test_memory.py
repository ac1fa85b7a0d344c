"""Results that are kept: the least recently used are forgotten first, and another process gets none."""

import pickle

from reporting.memory import Memory


def test_the_least_recently_used_are_forgotten_where_there_is_no_room():
    ended = list[str]()
    kept = Memory(6, weight=len, end=ended.append)
    for text in ("one", "two", "one", "four"):  # seven letters do not fit
        assert kept.get(text, lambda text=text: text) == text
    assert ended == ["two", "one"]
    kept.get("a", lambda: "a")
    assert kept.get("four", lambda: "made anew") == "four"
    kept.clear()
    assert ended == ["two", "one", "a", "four"]


def test_another_process_is_handed_nothing():
    kept = Memory(2)
    kept.get("x", lambda: 1)
    assert pickle.loads(pickle.dumps(kept)).get("x", lambda: 2) == 2
