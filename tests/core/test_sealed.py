"""Files that vouch for themselves: every flip of a bit is noticed, whatever it does to the text."""

from __future__ import annotations

import hashlib
import json
import random

import pytest

from hiersched.core.sealed import SealError, seal, seal_json, unseal, unseal_json

DOCUMENT = {"format": "some 1", "numbers": [0.1, 1e-300, 3], "text": "é\n", "nothing": None}
OTHER_FILES = (
    b"",
    b"{}",
    b"\n",
    b"PK\x03\x04",
    b"[1]\n",
    b"sha256\n",
    b'{"sha256": "' + b"a" * 500,
)


def test_what_is_sealed_comes_back():
    assert unseal(seal(b"")) == b""
    assert unseal(seal(bytes(range(256)))) == bytes(range(256))
    text = seal_json(DOCUMENT)
    assert unseal_json(text.encode()) == DOCUMENT
    assert json.loads(text) == {"sha256": json.loads(text)["sha256"], **DOCUMENT}


@pytest.mark.parametrize("sealed", [seal(bytes(range(100))), seal_json(DOCUMENT).encode()])
def test_every_flip_cut_and_addition_is_noticed(sealed):
    open_it = unseal_json if sealed.startswith(b"{") else unseal
    damaged = [sealed[:length] for length in range(len(sealed))]
    damaged += [sealed + more for more in (b"\n", b" ", b"\x00", sealed)]
    for place in range(len(sealed)):
        for bit in range(8):
            data = bytearray(sealed)
            data[place] ^= 1 << bit
            damaged.append(bytes(data))
    for data in damaged:
        with pytest.raises(SealError):
            open_it(data)


@pytest.mark.parametrize("other", OTHER_FILES)
def test_other_files_are_refused(other):
    for open_it in (unseal, unseal_json):
        with pytest.raises(SealError):
            open_it(other)


def test_sealed_text_that_is_no_json_is_refused():
    rng = random.Random(1)
    bodies = ["", "1]", '"a": }', "[" * 100_000, '"a": ' + "[" * 100_000]
    bodies += ["".join(chr(rng.randrange(1, 256)) for _ in range(50)) for _ in range(20)]
    for body in bodies:
        below = f"{body}\n"
        text = f'{{"sha256": "{hashlib.sha256(below.encode()).hexdigest()}",\n{below}'
        with pytest.raises(SealError):
            unseal_json(text.encode())


def test_numbers_that_json_lacks_are_refused():
    with pytest.raises(ValueError, match="Out of range float"):
        seal_json({"a": float("nan")})
