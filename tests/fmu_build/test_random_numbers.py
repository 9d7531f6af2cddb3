"""The Standard Library's random numbers: the same bits as generators on integers of 64 bits."""

from __future__ import annotations

import casadi as ca
import pytest

from fmu_build import compile_modelica
from fmu_build.algebra import Array, scalars
from fmu_build.errors import ModelicaError
from fmu_build.random_numbers import EXTERNAL
from tests.fmu_build.simulate import Instance, find, values

MASK = 2**64 - 1


def signed(word: int) -> list[int]:
    """Two Integers of 32 bits, the low one first."""
    return [half - (half >> 31) * 2**32 for half in (word & 0xFFFFFFFF, word >> 32)]


def uniform(word: int) -> float:
    return (word - (word >> 63) * 2**64) * 2.0**-64 + 0.5


def xorshift64(s: list[int]) -> tuple[list[int], float]:
    x = s[0]
    x ^= x >> 12
    x ^= (x << 25) & MASK
    x ^= x >> 27
    x = x * 2685821657736338717 & MASK
    return [x], uniform(x)


def xorshift128(s: list[int]) -> tuple[list[int], float]:
    a, b = s
    a ^= (a << 23) & MASK
    new = ((a ^ b ^ (a >> 17) ^ (b >> 26)) + b) & MASK
    return [b, new], uniform(new)


def xorshift1024(s: list[int]) -> tuple[list[int], float]:
    *words, p = s
    a, p = words[p], (p + 1) % 16
    b = words[p]
    b ^= (b << 31) & MASK
    b ^= b >> 11
    words[p] = a ^ (a >> 30) ^ b
    return [*words, p], uniform(words[p] * 1181783497276652981 & MASK)


GENERATORS = {
    "ModelicaRandom_xorshift64star": (xorshift64, [0x9E3779B97F4A7C15]),
    "ModelicaRandom_xorshift128plus": (xorshift128, [0x9E3779B97F4A7C15, 0xFEDCBA9876543210]),
    "ModelicaRandom_xorshift1024star": (
        xorshift1024,
        [*(0x9E3779B97F4A7C15 * (k + 1) & MASK for k in range(16)), 14],
    ),
}


def integers(name: str, state: list[int]) -> list[int]:
    words, rest = (state[:-1], state[-1:]) if "1024" in name else (state, [])
    return [i for word in words for i in signed(word)] + rest


@pytest.mark.parametrize("name", GENERATORS)
@pytest.mark.parametrize("symbolic", [False, True])
def test_generators_draw_the_same_numbers(name, symbolic):
    step, words = GENERATORS[name]
    given = integers(name, words)
    draw = EXTERNAL[name]
    if symbolic:
        seed = ca.SX.sym("seed", len(given))
        outputs = scalars(draw(Array((len(given),), tuple(seed.elements()))))
        function = ca.Function("draw", [seed], [ca.vertcat(*outputs)])
        following = lambda state: values(function(state)).tolist()  # noqa: E731
    else:
        following = lambda state: [float(v) for v in scalars(draw(Array((len(state),), tuple(state))))]  # noqa: E731
    for _ in range(5):
        words, number = step(words)
        *given, drawn = following(given)
        given = [int(i) for i in given]
        assert given == integers(name, words)
        assert drawn == number


NOISE = """package P
  pure function random input Integer s[4]; output Real r; output Integer new[4];
    external "C" ModelicaRandom_xorshift128plus(s, new, r); end random;
  function hash input String s; output Integer h; external "C" h = ModelicaStrings_hashString(s); end hash;
  impure function clock output Integer s; external "C" s = ModelicaRandom_automaticGlobalSeed(0.0); end clock;
  model M
    parameter Boolean automatic = false;
    parameter Integer fixedSeed = 5;
    final parameter Integer seed(fixed = false);
    parameter Integer offset = 2*seed + 1;
    parameter Real begin(fixed = false);
    parameter Real later = max(begin, 0.5);
    Integer state[4];
    discrete Real r;
    Real y = r + later;
  initial equation
    seed = if automatic then clock() else fixedSeed;
    begin = time;
    pre(state) = {seed, offset, hash("M.a"), -seed};
    r = random(pre(state));
  equation
    when sample(0, 1) then
      (r, state) = random(pre(state));
    end when;
  end M;
end P;
"""


def test_noise_of_a_model_follows_its_seeds(tmp_path):
    file = tmp_path / "P.mo"
    file.write_text(NOISE)
    model = compile_modelica(file, "P.M")
    for seed in (5, -7):
        instance = Instance.of(model, {"fixedSeed": seed})
        words = [
            (low & 0xFFFFFFFF) | (high & 0xFFFFFFFF) << 32
            for low, high in ((seed, 2 * seed + 1), (EXTERNAL["ModelicaStrings_hashString"]("M.a"), -seed))
        ]
        env = instance.env(0.0, instance.start())
        for number, time in enumerate((0.0, 0.0, 1.0, 2.0)):
            env[0] = time
            z, m, _ = instance.settle(env, init=0.0 if number else 1.0)
            env[5], env[6], env[7] = z, z, m
            if number != 1:  # a sample at the start draws once, for the start's own equation too
                following, drawn = xorshift128(words)
            if number:
                words = following
            assert z[find(model, "r").location.index] == drawn


def test_a_seed_from_the_clock_is_refused(tmp_path):
    file = tmp_path / "P.mo"
    file.write_text(NOISE.replace("automatic = false", "automatic = true"))
    with pytest.raises(ModelicaError, match=r"P\.mo:17: impure function 'P\.clock' is not supported"):
        compile_modelica(file, "P.M")
