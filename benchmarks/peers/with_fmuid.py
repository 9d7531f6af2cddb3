"""The race with fmuid: its default solver for least squares."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict
from pathlib import Path

import lxml.etree  # noqa: F401  imports do not count
import scipy.optimize  # noqa: F401

sys.path.insert(0, str(Path(__file__).parents[1]))
from identification_speed import Race, with_fmuid

finish = asdict(with_fmuid(Race(**json.loads(Path(sys.argv[1]).read_text()))))
print(json.dumps({name: finish[name] for name in ("seconds", "simulations", "cost", "reached")}))
