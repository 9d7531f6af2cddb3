import io

from rich.console import Console

from fmuid import TerminalProgress, identify
from fmuid.identification.solvers import StopRules


def test_a_terminal_shows_stage_evaluations_cost_and_what_stays(msd):
    screen = io.StringIO()
    console = Console(file=screen, force_terminal=True, width=100)
    with TerminalProgress(console) as progress:
        identify(msd(), solver="nelder_mead", observer=progress)
    text = screen.getvalue()
    assert "msd, nelder_mead" in text
    assert "evaluations, cost" in text
    assert "msd: converged (parameters no longer change) by nelder_mead" in text


def test_a_log_file_gets_one_line_a_stage(msd):
    screen = io.StringIO()
    with TerminalProgress(Console(file=screen, width=100)) as progress:
        identify(msd(), solver="nelder_mead", observer=progress)
    assert screen.getvalue().count("\n") == 1


def test_a_warning_is_left_to_the_result(msd):
    screen = io.StringIO()
    with TerminalProgress(Console(file=screen, width=100)) as progress:
        result = identify(msd(), solver="nelder_mead", stop=StopRules(evaluations=30), observer=progress)
    warnings = [w for stage in result.stages for w in stage.warnings]
    assert warnings
    assert not any(w in screen.getvalue() for w in warnings)
    assert all(str(result).count(w) == 1 for w in warnings)
