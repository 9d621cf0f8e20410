from __future__ import annotations

import zlib

from hypothesis import given
from hypothesis import strategies as st

from hiersched.log.container import crc32_combine


@given(st.binary(max_size=300), st.binary(max_size=300))
def test_combined_checksum_is_that_of_the_joined_pieces(a: bytes, b: bytes) -> None:
    assert crc32_combine(zlib.crc32(a), zlib.crc32(b), len(b)) == zlib.crc32(a + b)


def test_long_pieces() -> None:
    a, b = bytes(1_000_003), b"\xff" * 2_000_001
    assert crc32_combine(zlib.crc32(a), zlib.crc32(b), len(b)) == zlib.crc32(a + b)
