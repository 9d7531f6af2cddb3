"""Helper process of `save_figures`: reads pickled figures from its parent and draws them."""

import pickle
import sys
from pathlib import Path

from fmuid.core.errors import FmuidError
from fmuid.report.plots import save_figure

try:
    for figure in pickle.load(sys.stdin.buffer):
        save_figure(figure, Path(sys.argv[1]), sys.argv[2:])  # type: ignore[arg-type]
except FmuidError as error:
    sys.exit(str(error))
