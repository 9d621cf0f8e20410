"""CRC-32 of joined pieces from the CRC-32 of each, as zlib's ``crc32_combine``.

A stored chunk has a checksum of its own and is part of the checksum of the data section; this
saves the second pass over its bytes. Python's zlib module does not offer it.
"""

from __future__ import annotations

from functools import lru_cache

_POLYNOMIAL = 0xEDB88320  # of CRC-32, bits reversed: bit 31 is x^0
_ONE = 1 << 31


def crc32_combine(first: int, second: int, second_bytes: int) -> int:
    """Return the CRC-32 of two joined pieces.

    Parameters
    ----------
    first, second
        CRC-32 of each piece.
    second_bytes
        Length of the second piece [bytes].

    Returns
    -------
    int
        crc(a b) = crc(a)·x^(8·len(b)) + crc(b) modulo the polynomial, over GF(2).
    """
    return _multiply(_power_of_x(8 * second_bytes), first) ^ second


@lru_cache(maxsize=64)
def _power_of_x(exponent: int) -> int:
    """Raise x to a power modulo the polynomial, by squaring."""
    result, square = _ONE, _ONE >> 1
    while exponent:
        if exponent & 1:
            result = _multiply(square, result)
        square = _multiply(square, square)
        exponent >>= 1
    return result


def _multiply(a: int, b: int) -> int:
    """Multiply two polynomials over GF(2) modulo the polynomial."""
    product = 0
    while a:
        if a & _ONE:
            product ^= b
        a = (a << 1) & 0xFFFFFFFF
        b = (b >> 1) ^ (_POLYNOMIAL if b & 1 else 0)
    return product
