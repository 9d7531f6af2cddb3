"""Results in a notebook: their tables, with pictures below them."""

from __future__ import annotations

import base64
import html

import numpy as np

from fmuid.diagnosis.diagnose import Found
from fmuid.identification.result import Result
from fmuid.identification.validate import Validation
from fmuid.report.diagnosis_figures import effects_figure, gap_figure
from fmuid.report.figures import correlation_figure, fit_figure, overlay_figure
from fmuid.report.plots import render
from fmuid.report.plots.figure_data import Figure
from fmuid.report.predicted import overlays

_DRAWN = 4  # largest number of runs drawn


def as_html(shown: Result | Validation | Found) -> str:
    """Return the tables of a result as HTML, with pictures of its contents; nothing is simulated for them."""
    return shown._repr_html_() + "".join(map(_picture, figures_of(shown)))


def figures_of(shown: Result | Validation | Found) -> list[Figure]:
    """Return the figures of a result.

    For an identification: the correlations of its estimates. For a validation: the runs with the largest errors,
    and the error of every run. For a diagnosis: the gap and the effects.
    """
    if isinstance(shown, Found):
        answer = shown.diagnosis.to_dict()
        return [f for f in (gap_figure(answer), effects_figure(answer)) if f is not None]
    if isinstance(shown, Validation):
        return _of_validation(shown)
    return list(filter(None, map(correlation_figure, shown.stages)))


def _of_validation(validation: Validation) -> list[Figure]:
    if all(s.failure is not None for s in validation.scores):
        return []
    error = {s.experiment: s.nrmse for s in sorted(validation.scores, key=lambda s: np.nan_to_num(s.nrmse))}
    predicted = [
        (case, p) for case, p in zip(validation.cases, validation.predictions, strict=True) if p is not None
    ]
    worst = sorted(predicted, key=lambda pair: -error.get(pair[0].id, 0.0))[:_DRAWN]
    drawn = [o for case, p in worst for o in overlays(None, case, [("model", "final", p)])]
    figures: list[Figure] = [fit_figure("fit", validation.scores)]
    return [overlay_figure("runs", "Runs with the largest errors", drawn), *figures] if drawn else figures


def _picture(figure: Figure) -> str:
    data = base64.b64encode(render(figure)).decode()
    return f'<img alt="{html.escape(figure.title)}" style="max-width: 100%" src="data:image/png;base64,{data}">'
