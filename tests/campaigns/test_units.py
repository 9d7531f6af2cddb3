"""Units: converted by the factors of SI, or refused in one line."""

from __future__ import annotations

import math
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fmuid.core.errors import UnitError
from fmuid.core.units import Conversion, check_unit, conversion, convert_factor


@pytest.mark.parametrize(
    ("source", "target", "factor", "offset"),
    [
        ("N.m", "N.m", 1, 0),
        ("Nm", "N.m", 1, 0),
        ("mNm", "N.m", 1e-3, 0),
        ("N.m.s", "N.m.s/rad", 1, 0),
        ("A.s/rad", "A.s", 1, 0),
        ("kg.m2", "kg.m^2", 1, 0),
        ("kg*m**2", "kg.m2", 1, 0),
        ("g.cm2", "kg.m2", 1e-7, 0),
        ("kg.m2/s2", "N.m", 1, 0),
        ("N.m/(rad.s)", "N.m/rad/s", 1, 0),
        ("m.s-2", "mm/s2", 1e3, 0),
        ("", "1", 1, 0),
        ("%", "1", 0.01, 0),
        ("rpm", "rad/s", 2 * math.pi / 60, 0),
        ("1/min", "1/s", 1 / 60, 0),
        ("-", "1", 1, 0),
        ("U/min", "rad/s", 2 * math.pi / 60, 0),
        ("deg", "rad", math.pi / 180, 0),
        ("deg/s", "rad/s", math.pi / 180, 0),
        ("kHz", "1/s", 1e3, 0),
        ("kOhm", "Ohm", 1e3, 0),
        ("ms", "s", 1e-3, 0),
        ("N/mV", "N/V", 1e3, 0),
        ("degC", "K", 1, 273.15),
        ("K", "degC", 1, -273.15),
        ("degF", "degC", 5 / 9, -160 / 9),
        ("W/degC", "W/K", 1, 0),
        ("furlongs per fortnight", None, 1, 0),
    ],
)
def test_conversion(source: str, target: str | None, factor: float, offset: float) -> None:
    converted = conversion(source, target)
    assert converted.factor == pytest.approx(factor, rel=1e-12)
    assert converted.offset == pytest.approx(offset, rel=1e-12, abs=1e-12)


@pytest.mark.parametrize(
    ("source", "target", "line"),
    [
        ("N", "m", "'N' cannot be converted to 'm'; they measure different things ([mass] * [length] / [time] ** 2 and [length])"),
        ("Hz", "rad/s", "'Hz' cannot be converted to 'rad/s'; convert the values by 2 pi and write the unit"),
        ("1/min", "rad/s", "'1/min' may count turns or radians: '1/min' is not converted to 'rad/s'; write rpm, or rad/min"),
        ("deg/s", "min-1", "'min-1' may count turns or radians: 'deg/s' is not converted to 'min-1'; write rpm, or rad/min"),
        ("rpm", "Hz", "'rpm' cannot be converted to 'Hz'; convert the values by 2 pi and write the unit"),
        ("Nwt", "N", "unit 'Nwt' is unknown; write it as in 'N.m' or 'kg.m2/s'"),
        ("N", "Nwt", "unit 'Nwt' is unknown; write it as in 'N.m' or 'kg.m2/s'"),
        ("N.m)", "N", "unit 'N.m)' has an extra ')'; write it as in 'N.m/(rad.s)'"),
        ("(N.m", "N", "unit '(N.m' is not understood; write it as in 'N.m/(rad.s)'"),
        ("3 N", "N", "unit '3 N' is not understood; write it as in 'N.m' or 'kg.m2/s'"),
        ("m99", "m", "unit 'm99' is not understood; write it as in 'N.m/(rad.s)'"),
        ("__import__('os')", "m", "unit '__import__('os')' is not understood; write it as in 'N.m' or 'kg.m2/s'"),
    ],
)  # fmt: skip
def test_refused(source: str, target: str, line: str) -> None:
    with pytest.raises(UnitError) as error:
        conversion(source, target)
    assert str(error.value) == line


def test_values() -> None:
    values = np.array([0.0, np.nan, 100.0])
    np.testing.assert_allclose(conversion("degC", "K")(values), [273.15, np.nan, 373.15])
    assert conversion("N.m", "N.m")(values) is values
    assert Conversion().is_identity


def test_a_factor_alone_is_refused_where_there_is_an_offset() -> None:
    assert convert_factor("mm", "m") == 1e-3
    with pytest.raises(UnitError) as error:
        convert_factor("degC", "K", where="x")
    assert str(error.value) == "x: 'degC' and 'K' differ by an offset; write the values in 'K'"


def test_usual_units_need_no_pint() -> None:
    script = "import sys; from fmuid.core.units import conversion; conversion('N.m.s', 'N.m.s/rad'); print('pint' in sys.modules)"
    ran = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, timeout=600)
    assert ran.stdout.strip() == "False"


@settings(derandomize=True, max_examples=300, deadline=None, database=None)
@given(unit=st.one_of(st.text(max_size=8), st.text("Nmskgrad.*/^()123-% ", max_size=10)))
def test_any_text_is_a_unit_or_is_refused(unit: str) -> None:
    try:
        check_unit(unit)
    except UnitError as error:
        complaint = str(error)
    else:
        return
    assert "\n" not in complaint
