"""How full the pages of a printed report are."""

from pathlib import Path

import numpy as np
import pytest

from docs.pictures import screenshots


def filled(report: Path) -> list[float]:
    """Return, for each page on paper, the share of its height down to the last mark."""
    pdfium = pytest.importorskip("pypdfium2", reason="needs the package pypdfium2")
    if screenshots.program() is None:
        pytest.skip("needs Chromium: apt-get install chromium")
    with screenshots.browser() as shown:
        shown.open(report, 1080)
        printed = shown.printed()
    pages = [page.render(scale=0.5, grayscale=True).to_numpy().squeeze() for page in pdfium.PdfDocument(printed)]
    return [float(np.flatnonzero((page < 245).any(axis=1)).max(initial=-1) + 1) / len(page) for page in pages]
