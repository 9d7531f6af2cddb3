from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

_spec = importlib.util.spec_from_file_location("chain", Path(__file__).with_name("chain.py"))
assert _spec is not None
assert _spec.loader is not None
chain = importlib.util.module_from_spec(_spec)
sys.modules["chain"] = chain
_spec.loader.exec_module(chain)
