import pytest

from fmuid.core.errors import ProblemError
from fmuid.core.formulas import parse


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("2 * a + 1", 7.0),
        ("-a ** 2", -9.0),
        ("lossTable[2, 4] / load.mgr", 0.25),
        ("sqrt(a + 1) * a", 6.0),
        ("max(a, 10, load.mgr)", 10.0),
    ],
)
def test_arithmetic_over_names_as_campaigns_write_them(text, value):
    expression = parse(text)
    assert expression({"a": 3.0, "lossTable[2,4]": 2.0, "load.mgr": 8.0}) == pytest.approx(value)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "a +",
        "__import__('os')",
        "a.b()",
        "lambda: 1",
        "[a]",
        "a if a else 1",
        "True",
        "'a'",
        "a; b",
        "open(a)",
    ],
)
def test_anything_but_arithmetic_is_refused(text):
    with pytest.raises(ProblemError, match="not an arithmetic expression"):
        parse(text)


def test_division_by_zero_is_said_in_one_line():
    with pytest.raises(ProblemError, match="'1 / a' has no value"):
        parse("1 / a")({"a": 0.0})


@pytest.mark.parametrize(
    "text",
    [
        "2 * a - b + 1",
        "-a / b",
        "a ** 2 * b ** a",
        "b ** 3",
        "sqrt(a) + exp(-b) - log(a * b)",
        "sin(a) * cos(b) / tan(b)",
        "abs(b - a) + max(a, 2 * b, 1) - min(a * a, b)",
    ],
)
def test_slopes_are_those_of_differences(text):
    expression, at, slopes = parse(text), {"a": 3.0, "b": 0.7}, {"a": 0.5, "b": -2.0}
    ends = [expression({name: v + h * slopes[name] for name, v in at.items()}) for h in (1e-6, -1e-6)]
    assert expression.slope(at, slopes) == pytest.approx((ends[0] - ends[1]) / 2e-6, rel=1e-8)
    assert expression.slope(at, {}) == 0.0


def test_a_slope_that_does_not_exist_is_said_in_one_line():
    with pytest.raises(ProblemError, match=r"'sqrt\(a\)' has no derivative"):
        parse("sqrt(a)").slope({"a": 0.0}, {"a": 1.0})


def test_a_long_formula_is_shortened_in_messages():
    with pytest.raises(ProblemError) as error:
        parse("1 +" * 20_000)
    assert "...' (60000 characters) is not an arithmetic expression" in str(error.value)
    assert len(str(error.value)) < 400
