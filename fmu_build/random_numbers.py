"""The Standard Library's random numbers: the generators xorshift64*, xorshift128+ and xorshift1024*, and its hash.

The library implements them in C, on unsigned 64-bit integers (S. Vigna, "An experimental exploration of
Marsaglia's xorshift generators, scrambled", 2014). Here they are expressions: a word is its 64 bits, lowest first,
and doubles hold the sums and products exactly. So seeds may be parameters, and a simulation may be repeated or
restored.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import casadi as ca

from fmu_build import algebra
from fmu_build.algebra import Array, Scalar, Value
from fmu_build.graph import SX

Bits = list[Scalar]

_HALF = 2**32
_FACTOR_64, _FACTOR_1024 = 2685821657736338717, 1181783497276652981


def _xor(a: Bits, b: Bits) -> Bits:
    def one(p: Scalar, q: Scalar) -> Scalar:
        if isinstance(p, SX) and isinstance(q, SX):
            return SX.binary(ca.OP_NE, p, q)
        if isinstance(p, SX) or isinstance(q, SX):
            number, other = (q, p) if isinstance(p, SX) else (p, q)
            return algebra.NOT(other) if number else other
        return int(p != q)

    return [one(p, q) for p, q in zip(a, b, strict=True)]


def _left(a: Bits, by: int) -> Bits:
    return [0] * by + a[:-by]


def _right(a: Bits, by: int) -> Bits:
    return a[by:] + [0] * by


def _number(bits: Sequence[Scalar]) -> Scalar:
    out: Scalar = 0
    for k, bit in enumerate(bits):
        if isinstance(bit, SX) or bit:
            out = out + bit * 2**k
    return out


def _split(x: Scalar, unit: int) -> tuple[Scalar, Scalar]:
    """Whole multiples of a unit, and the remainder."""
    high = algebra.FLOOR(x * (1 / unit)) if isinstance(x, SX) else int(x) // unit
    return high, x - high * unit


def _bits_of_half(x: Scalar) -> Bits:
    """Bits of an Integer of 32 bits, negative ones in two's complement."""
    rest = x + algebra.LESS(x, 0) * _HALF
    out: Bits = []
    for _ in range(32):
        rest, bit = _split(rest, 2)
        out.append(bit)
    return out


def _word(low: Scalar, high: Scalar) -> Bits:
    return _bits_of_half(low) + _bits_of_half(high)


def _signed(half: Scalar) -> Scalar:
    return half - algebra.LESS_EQUAL(_HALF // 2, half) * _HALF


def _added(a: Bits, b: Bits) -> tuple[Scalar, Scalar]:
    """Halves of a sum modulo 2^64, the low one first."""
    carry, low = _split(_number(a[:32]) + _number(b[:32]), _HALF)
    return low, _split(_number(a[32:]) + _number(b[32:]) + carry, _HALF)[1]


def _times(a: Bits, factor: int) -> tuple[Scalar, Scalar]:
    """Halves of a product modulo 2^64, the low one first, by limbs of 16 bits."""
    limbs = [_number(a[k : k + 16]) for k in range(0, 64, 16)]
    factors = [factor >> k & 0xFFFF for k in range(0, 64, 16)]
    carry: Scalar = 0
    digits: list[Scalar] = []
    for place in range(4):
        total = carry
        for k in range(place + 1):
            total = total + limbs[k] * factors[place - k]
        carry, digit = _split(total, 2**16)
        digits.append(digit)
    return digits[0] + digits[1] * 2**16, digits[2] + digits[3] * 2**16


def _uniform(low: Scalar, high: Scalar) -> Scalar:
    """Map the word to (0, 1] as a signed one: w 2^-64 + 1/2."""
    return (_signed(high) * float(_HALF) + low) * 2.0**-64 + 0.5


def _xorshift64(state: Value) -> tuple[Value, ...]:
    word = _word(*algebra.scalars(state))
    word = _xor(word, _right(word, 12))
    word = _xor(word, _left(word, 25))
    low, high = _times(_xor(word, _right(word, 27)), _FACTOR_64)
    return Array((2,), (_signed(low), _signed(high))), _uniform(low, high)


def _xorshift128(state: Value) -> tuple[Value, ...]:
    a, b, *second = algebra.scalars(state)
    one, zero = _word(a, b), _word(*second)
    one = _xor(one, _left(one, 23))
    mixed = _xor(_xor(one, zero), _xor(_right(one, 17), _right(zero, 26)))
    low, high = _added(mixed, zero)
    return Array((4,), (*second, _signed(low), _signed(high))), _uniform(low, high)


def _xorshift1024(state: Value) -> tuple[Value, ...]:
    *halves, position = algebra.scalars(state)
    position = _split(position, 16)[1]
    following = _split(position + 1, 16)[1]

    def at(place: Scalar) -> Bits:
        out: Value = Array((2,), (halves[0], halves[1]))
        for k in range(1, 16):
            out = algebra.choose(algebra.EQUAL(place, k), Array((2,), (halves[2 * k], halves[2 * k + 1])), out)
        return _word(*algebra.scalars(out))

    zero, one = at(position), at(following)
    one = _xor(one, _left(one, 31))
    one = _xor(one, _right(one, 11))
    word = _xor(_xor(zero, _right(zero, 30)), one)
    new = [_signed(_number(word[:32])), _signed(_number(word[32:]))]
    items = [algebra.choose(algebra.EQUAL(following, k // 2), new[k % 2], halves[k]) for k in range(32)]
    out = tuple(i for item in items for i in algebra.scalars(item))
    return Array((33,), (*out, following)), _uniform(*_times(word, _FACTOR_1024))


def _hash(text: Value) -> Value:
    """Return A. Partow's hash of a String, as a signed integer of 32 bits."""
    value = 0xAAAAAAAA
    for place, byte in enumerate(str(text).encode()):
        if place % 2 == 0:
            value ^= (value << 7) ^ byte * (value >> 3)
        else:
            value ^= ~((value << 11) + (byte ^ (value >> 5)))
        value &= 0xFFFFFFFF
    return value - (value >> 31) * _HALF


def _nothing(*_: Value) -> Value:
    """Prepare the hidden generator, which nothing can read, because drawing from it is refused."""
    return ()


# By the names of the C functions, with several results in the order of the C function's arguments.
EXTERNAL: dict[str, Callable[..., Value]] = {
    "ModelicaRandom_xorshift64star": _xorshift64,
    "ModelicaRandom_xorshift128plus": _xorshift128,
    "ModelicaRandom_xorshift1024star": _xorshift1024,
    "ModelicaRandom_setInternalState_xorshift1024star": _nothing,
    "ModelicaStrings_hashString": _hash,
}
