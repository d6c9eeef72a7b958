"""Whatever is installed, a benchmark measures the checkout that it stands in: import this first.

So do the processes that it starts.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

_HERE = str(Path(__file__).resolve().parents[1])
_AFTER = os.environ.get("PYTHONPATH")

sys.path.insert(0, _HERE)
os.environ["PYTHONPATH"] = os.pathsep.join([_HERE, _AFTER] if _AFTER else [_HERE])
