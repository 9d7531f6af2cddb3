import io

from rich.console import Console

from fmuid import TerminalProgress, identify


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
