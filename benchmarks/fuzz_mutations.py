"""Ways in which a file of a user is wrong: by accident, by an editor, by another locale, by intent."""

import io
import re
import zipfile
from collections.abc import Callable

import numpy as np

NUMBER = re.compile(rb"(?<![\w.])[-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?(?![\w.])")
REPLACEMENTS = (
    *(b"nan", b"inf", b"-inf", b"NaN", b"Infinity", b"1e400", b"1" + b"0" * 40, b"-1", b"0", b"1e-320"),
    *(b"true", b'"text"', b"null", b"9,81", b"", "\u0663\u0664".encode(), b"1_000", b"[]", b"{}"),
)
"""What comes in the place of a number."""

Mutation = Callable[[bytes, np.random.Generator], bytes]


def _flip(content: bytes, draw: np.random.Generator) -> bytes:
    damaged = bytearray(content)
    for _ in range(int(draw.integers(1, 9))):
        damaged[draw.integers(len(damaged))] ^= 1 << int(draw.integers(8))
    return bytes(damaged)


def _overwrite(content: bytes, draw: np.random.Generator) -> bytes:
    begin = int(draw.integers(len(content)))
    end = min(begin + int(draw.integers(1, 65)), len(content))
    return content[:begin] + draw.bytes(end - begin) + content[end:]


def _cut(content: bytes, draw: np.random.Generator) -> bytes:
    return content[: int(draw.integers(len(content)))]


def _delete_line(content: bytes, draw: np.random.Generator) -> bytes:
    lines = content.splitlines(keepends=True)
    del lines[draw.integers(len(lines))]
    return b"".join(lines)


def _double_line(content: bytes, draw: np.random.Generator) -> bytes:
    lines = content.splitlines(keepends=True)
    where = int(draw.integers(len(lines)))
    return b"".join([*lines[: where + 1], *lines[where:]])


def _replace_number(content: bytes, draw: np.random.Generator) -> bytes:
    numbers = list(NUMBER.finditer(content))
    if not numbers:
        return _flip(content, draw)
    found = numbers[draw.integers(len(numbers))]
    return content[: found.start()] + REPLACEMENTS[draw.integers(len(REPLACEMENTS))] + content[found.end() :]


def _nest(content: bytes, draw: np.random.Generator) -> bytes:
    opening, closing = ((b"[", b"]"), (b'{"a":', b"}"), (b"{a=", b"}"), (b"<a>", b"</a>"))[draw.integers(4)]
    deep = opening * 3000 + b"1" + closing * 3000
    numbers = list(NUMBER.finditer(content))
    if not numbers or draw.integers(4) == 0:
        return content + b"\nnested = " + deep
    found = numbers[draw.integers(len(numbers))]
    return content[: found.start()] + deep + content[found.end() :]


def _mark(content: bytes, draw: np.random.Generator) -> bytes:
    return b"\xef\xbb\xbf" * int(draw.integers(1, 3)) + content


def _sixteen_bits(content: bytes, draw: np.random.Generator) -> bytes:
    return content.decode("latin-1").encode(("utf-16", "utf-16-le", "utf-32")[draw.integers(3)])


def _empty(content: bytes, draw: np.random.Generator) -> bytes:
    return (b"", b"\n", b" ", b"\0" * 16, b"{}", b"[]", b"null")[draw.integers(7)]


def _swap_columns(content: bytes, draw: np.random.Generator) -> bytes:
    separator = b"\t" if content.count(b"\t") > content.count(b",") else b","
    rows = [line.split(separator) for line in content.split(b"\n")]
    width = max(len(row) for row in rows)
    if width < 2:
        return _double_line(content, draw)
    first, second = draw.choice(width, 2, replace=False)
    for row in rows[int(draw.integers(2)) :]:
        if len(row) == width:
            row[first], row[second] = row[second], row[first]
    return b"\n".join(separator.join(row) for row in rows)


PIECES = (
    *(bytes([sign]) for sign in b"*,+=.$#-\n\t \"'[]{}"),
    *(
        b"1e999",
        b"1.5-3",
        b"7" * 5000,
        b"\0",
        "\u00e9".encode(),
        b"1, 99999999",
        b"a.a.a",
        b'"""',
        b"[[load]]",
    ),
    *(b"*NODE", b"*TIE", b"*RIGID BODY", b"GENERATE", b"ELSET=BODY", b"GRID", b"RBE2", b"CELAS1"),
)
"""What comes into the middle of a text: signs, numbers, words of decks."""


def _insert(content: bytes, draw: np.random.Generator) -> bytes:
    begin = int(draw.integers(len(content) + 1))
    end = min(begin + int(draw.choice((0, 0, 0, 1, 1, 2, 10))), len(content))
    return content[:begin] + PIECES[draw.integers(len(PIECES))] + content[end:]


BINARY: dict[str, Mutation] = {"flip": _flip, "overwrite": _overwrite, "cut": _cut, "empty": _empty}
TEXT: dict[str, Mutation] = {
    **BINARY,
    **dict.fromkeys(("insert", "insert too", "replace", "replace too"), _insert),
    "delete line": _delete_line,
    "double line": _double_line,
    "number": _replace_number,
    "number twice": lambda content, draw: _replace_number(_replace_number(content, draw), draw),
    "nest": _nest,
    "mark": _mark,
    "16 bits": _sixteen_bits,
    "swap columns": _swap_columns,
}


def _mutate_member(content: bytes, draw: np.random.Generator) -> bytes:
    """Damage one member of an archive whose own checksums stay right."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    described = [name for name in members if name.endswith((".xml", ".ssd", ".ssv", ".ssm", ".npy"))]
    name = described[draw.integers(len(described))]
    kinds = BINARY if name.endswith(".npy") else TEXT
    kind = list(kinds)[draw.integers(len(kinds))]
    part = members[name][:256] if name.endswith(".npy") and draw.integers(2) else members[name]
    members[name] = kinds[kind](part, draw) + members[name][len(part) :]
    if draw.integers(8) == 0:
        del members[name]
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        for member, data in members.items():
            archive.writestr(member, data)
    return packed.getvalue()


ARCHIVE: dict[str, Mutation] = {**BINARY, **dict.fromkeys([f"member {n}" for n in range(6)], _mutate_member)}
