"""How modules that are commands end."""

import pytest

from benchmarks.study_command import ended
from fmuid.core.errors import FmuidError


@pytest.mark.parametrize(
    ("raised", "resumes", "code", "message"),
    [
        (KeyboardInterrupt(), False, 130, "interrupted\n"),
        (KeyboardInterrupt(), True, 130, "interrupted; the same command continues\n"),
        (FmuidError("is empty", where="cases", fix="fill it"), True, 2, "error: cases: is empty; fill it\n"),
    ],
)
def test_what_is_said_at_the_end(raised, resumes, code, message, capsys):
    def work():
        raise raised

    assert ended(work, resumes=resumes) == code
    assert capsys.readouterr().err == message


def test_failures_are_told(capsys):
    assert ended(lambda: ["s01: failed"]) == 1
    assert capsys.readouterr().err == "s01: failed\n"
    assert ended(lambda: []) == 0
