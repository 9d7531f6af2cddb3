"""The library that draws figures in the browser: plotly.js (MIT licence), as released, compressed.

The Python package ``plotly``, 64 MB, contains it, but nothing else of that package would be used.
"""

from __future__ import annotations

import gzip
from importlib.resources import files


def plotly_js() -> str:
    """Return the source of plotly.js."""
    packed = files("fmuid.report").joinpath("templates", "plotly.min.js.gz").read_bytes()
    return gzip.decompress(packed).decode()


def plotly_js_version() -> str:
    """Return the version of plotly.js, as stated in its first lines."""
    return plotly_js().partition("plotly.js v")[2].partition("\n")[0]
