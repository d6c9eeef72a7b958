"""Probabilities as log-odds, in which independent evidence adds up."""

from __future__ import annotations

import math


def log_odds(probability: float) -> float:
    """Return ``ln(p / (1 - p))`` of a probability in (0, 1)."""
    return math.log(probability / (1.0 - probability))
